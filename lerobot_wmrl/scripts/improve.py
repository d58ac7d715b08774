"""lerobot-wmrl-improve: from a policy and a dataset to a better policy, with one command.

    lerobot-wmrl-improve --policy.path=outputs/cloned --dataset.repo_id=user/episodes \\
        --output_dir=outputs/improve
    lerobot-wmrl-improve --policy.path=outputs/cloned --dataset.root=data/pusht --real_env.type=pusht \\
        --rollouts=200 --output_dir=outputs/improve

It looks at the data and says what it has and lacks; trains the policy further on the episodes that succeed,
which needs no world model: imagination has to beat it; trains a frame tokenizer and a world model; checks the
world model on held-out episodes; trains that policy in imagination; fits it to a planner there, if it is a
`cnn` (distillation); and compares the policies, in `--real_env` if there is one. There it also chooses the
policy to use, on other starts. With `--rollouts` it first records rollouts of the policy there, and learns
from them too. Every stage is one console command, which it prints. Running the same command again continues
where it stopped. It ends with a summary and `report.html`.
"""

import shlex

import draccus

from lerobot_wmrl.common.checkpoints import checkpoint_digest, resolved_name
from lerobot_wmrl.common.output_folders import Claim
from lerobot_wmrl.common.stages import MARKER, Stage, run_stage_command, run_stages
from lerobot_wmrl.data.dataset import fingerprint
from lerobot_wmrl.improve import commands
from lerobot_wmrl.improve.configuration_improve import ImproveConfig
from lerobot_wmrl.improve.plan import Plan
from lerobot_wmrl.improve.progress import Progress
from lerobot_wmrl.improve.report.page import Page
from lerobot_wmrl.improve.report.words import verdict
from lerobot_wmrl.improve.stages import list_stages


def improve(cfg: ImproveConfig) -> None:
    """Run every stage, write the report, and say what came of it."""
    cfg.validate()
    plan = Plan.of(cfg)
    print(f"{cfg.dataset.name}:\n{plan.findings}\n  {plan.duration}")
    progress = Progress(plan)
    stages = list_stages(progress)
    assert cfg.policy is not None
    content = {
        "dataset": fingerprint(plan.findings.root),
        "policy": checkpoint_digest(str(cfg.policy.pretrained_path)),
    }
    # the same data may be named by the commit where a name on the hub has moved on
    free = ("dataset.revision", "check.revision")
    with Claim(cfg.output_dir, settings(cfg, stages), free, content, MARKER).held():
        plan.copy_policy()
        run_stages(stages, cfg.output_dir)
        page = Page.of(progress)
        path = page.write(cfg.output_dir)
    print(f"\n{verdict(progress, page.places)}\n\nThe report: {path}")
    if again := commands.another_round_command(progress):
        print(f"Another round, with as many rollouts of this policy:\n{shlex.join(again)}")


def settings(cfg: ImproveConfig, stages: list[Stage]) -> dict[str, object]:
    """Return what decides the result, as JSON."""
    assert cfg.policy is not None
    settings = {name: value for name, value in draccus.encode(cfg).items() if name != "policy"}
    if cfg.policy_flags:
        settings["policy_flags"] = cfg.policy_flags
    return settings | {
        "policy": resolved_name(str(cfg.policy.pretrained_path)),
        "size": cfg.preset,
        "output_dir": str(cfg.output_dir),
        "selection_episodes": cfg.selection_episodes if cfg.selects else 0,
        "stages": [stage.name for stage in stages],
    }


def main() -> None:
    """Run the console command."""
    run_stage_command(improve, ImproveConfig, list)


if __name__ == "__main__":
    main()

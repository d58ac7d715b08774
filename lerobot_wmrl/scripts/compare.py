"""lerobot-wmrl-compare: compare the success of policies on the same starts of an environment.

    lerobot-wmrl-compare --policies=[outputs/cloned,outputs/improved] --env.type=wmrl_maniskill \\
        --env.task=push --n_episodes=200 --batch_size=2 --output_dir=outputs/comparison

Any LeRobot policy and any LeRobot environment will do. All policies run from the same seeds, a batch at a
time. By default the comparison stops when every pair is decided. A sequential test decides, which may be
looked at after every batch: it calls equal policies different with a probability of at most `--alpha`. With
`--stop_early=false` all `--n_episodes` run, and McNemar's exact test decides. Wilson's intervals of the
success rates hold for a number of starts that was fixed before; after an early stop they are approximate.

The results are in comparison.json and comparison.png. Running the same command again continues after the last
finished batch. With early stopping `--n_episodes` may then be higher: the test stays valid.
"""

import json
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import draccus
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.common.checkpoints import checkpoint_digest
from lerobot_wmrl.common.command_line import RunConfig, run_command
from lerobot_wmrl.common.errors import FieldError, require_at_least, require_choice, require_probability
from lerobot_wmrl.common.files import write_json, writing
from lerobot_wmrl.common.output_folders import Claim
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.envs.content import content_of
from lerobot_wmrl.evaluation.comparison import COMPARISON_FILE, Comparison, Episode, episodes_from_json
from lerobot_wmrl.evaluation.pictures import save_comparison
from lerobot_wmrl.evaluation.policy_rollouts import (
    load_policies,
    opened,
    read_policies,
    require_new_starts,
    run_comparison,
)


@dataclass
class CompareConfig(RunConfig):
    """Compare the success of policies on the same starts of an environment.

    Args:
        policies: checkpoints of policies, or output folders of trainings, of which the last checkpoint is
            taken. All of them are in memory at the same time.
        env: `--env.type=wmrl_maniskill`, `world_model` or one of LeRobot's environments, and its settings.
        against: pairs that are compared: every policy with the `first` one, or with `all` others.
        n_episodes: most episodes of each policy, in each task of the environment.
        batch_size: environments of one policy that run at once. If there are several, a single task of
            LeRobot's benchmarks runs in as many processes for each policy. After every batch it is checked
            whether all is decided.
        seed: seed of the first episode; each further one adds one.
        alpha: probability of calling equal policies different, for all pairs together (Bonferroni).
        stop_early: stop when every pair is decided. Then the sequential p-value decides, which is valid
            at any time of stopping; otherwise McNemar's.
        trust_remote_code: allow an environment of the hub to run its code here, as in lerobot-eval.
        output_dir: folder of comparison.json and comparison.png.
    """

    policies: list[str] = field(default_factory=list)
    env: EnvConfig | None = None
    against: str = "first"
    n_episodes: int = 200
    batch_size: int = 4
    seed: int = EVALUATION_SEED
    alpha: float = 0.05
    stop_early: bool = True
    trust_remote_code: bool = False
    output_dir: Path = Path("outputs/comparison")

    def validate(self) -> None:
        """Raise FieldError for a setting that cannot be."""
        if len(self.policies) < 2:
            raise FieldError(
                "policies", self.policies, "a comparison needs at least two", "give their checkpoints: [a,b]"
            )
        if self.env is None:
            raise FieldError(
                "env.type",
                None,
                "is missing: policies are compared in an environment",
                "set it to wmrl_maniskill, world_model or one of LeRobot's, with its settings",
            )
        require_choice(self, "against", ("first", "all"))
        require_at_least(self, 1, "n_episodes", "batch_size")
        require_at_least(self, 0, "seed")
        if self.batch_size > self.n_episodes:
            raise FieldError(
                "batch_size",
                self.batch_size,
                f"there are {self.n_episodes} episodes",
                "lower it, or raise `n_episodes`",
            )
        require_probability(self, "alpha")


def compare(cfg: CompareConfig) -> None:
    """Run the policies, or what is missing of their episodes; write comparison.json and comparison.png."""
    cfg.validate()
    assert cfg.env is not None
    configs = read_policies(cfg.policies, cfg.env)
    cfg.policies = list(configs)
    claim = Claim(cfg.output_dir, draccus.encode(cfg), may_differ(cfg), named_content(cfg))
    claim.check()
    comparison = Comparison(
        cfg.policies, cfg.n_episodes, cfg.against, cfg.alpha, cfg.stop_early, stored_episodes(cfg)
    )
    if comparison.finished:  # perhaps since fewer episodes are asked for than before
        with claim.held():
            write_results(cfg, claim, comparison)
    else:
        run(cfg, claim, comparison, configs)
    save_comparison(comparison, cfg.output_dir / "comparison.png")
    print(f"{comparison}\n{COMPARISON_FILE} and comparison.png are in {cfg.output_dir}")


def named_content(cfg: CompareConfig) -> dict[str, str]:
    """Return digests of the policies, and of what imagined episodes follow from."""
    return {name: checkpoint_digest(name) for name in cfg.policies} | content_of(cfg.env)


def stored_episodes(cfg: CompareConfig) -> list[Episode]:
    """Return the episodes that have run before."""
    results = cfg.output_dir / COMPARISON_FILE
    return episodes_from_json(json.loads(results.read_text())) if results.is_file() else []


def may_differ(cfg: CompareConfig) -> list[str]:
    """Return the settings that may change when a comparison is continued: McNemar's test needs a number of
    starts that was fixed before, the sequential test does not."""
    return ["n_episodes"] if cfg.stop_early else []


def run(
    cfg: CompareConfig, claim: Claim, comparison: Comparison, configs: dict[str, PreTrainedConfig]
) -> None:
    """Run the episodes that are missing; write the results after every batch."""
    assert cfg.env is not None
    save = partial(write_results, cfg, claim, comparison)
    with (
        writing("output_dir", cfg.output_dir),
        opened(cfg.env, cfg.batch_size, cfg.trust_remote_code, len(configs)) as envs,
    ):
        require_new_starts(envs[0], cfg.env, cfg.n_episodes)
        policies = load_policies(configs)
        with claim.held():
            comparison.episodes[:] = stored_episodes(cfg)  # another command may have added some meanwhile
            run_comparison(comparison, envs, cfg.env, policies, cfg.batch_size, cfg.seed, save)


def write_results(cfg: CompareConfig, claim: Claim, comparison: Comparison) -> None:
    """Write comparison.json."""
    results = {"env": claim.settings["env"], "seed": cfg.seed, **comparison.as_json()}
    write_json(cfg.output_dir / COMPARISON_FILE, results)


def main() -> None:
    """Run the console command."""
    run_command(compare, CompareConfig, list)


if __name__ == "__main__":
    main()

"""lerobot-wmrl-judge: estimate from imagined episodes how often policies succeed in reality.

    lerobot-wmrl-judge --policies=[outputs/cloned,outputs/act] --dataset.root=rollouts \\
        --world_model.path=outputs/action_world_model --output_dir=outputs/judgement

It needs no simulator and no robot, but labelled rollouts (`--dataset`) that the world model has not learnt
from. Replayed in it, they say how many successes it misses and how many failures it takes for successes. The
success rate in imagination is corrected for both, and gets an interval.

That supposes that the world model errs about these policies as it does about the rollouts. If the real
success of some policies is known, nine or more (`--references`), the errors about them give the interval
instead, by split conformal prediction. It then supposes only that a policy to judge might be one of them.

A policy that was trained in this world model is not judged, since it may have learnt what only looks like
success there. Nothing is judged if the world model hardly tells the rollouts' successes from their failures.
Running the same command again continues after the last finished policy.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import draccus
from tqdm import tqdm

from lerobot_wmrl.common.checkpoints import Checkpoint
from lerobot_wmrl.common.command_line import RunConfig, claim_output_dir, require_free, run_command
from lerobot_wmrl.common.errors import FieldError, renamed, require_at_least
from lerobot_wmrl.common.files import write_json, writing
from lerobot_wmrl.data.episodes import ChosenEpisodes
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig

if TYPE_CHECKING:
    from lerobot.configs import PreTrainedConfig

    from lerobot_wmrl.common.statistics import Proportion
    from lerobot_wmrl.evaluation.judgement import Judgement


@dataclass
class JudgeConfig(RunConfig):
    """Estimate from imagined episodes how often policies succeed in reality.

    Needed are `--policies`, `--world_model.path` and `--dataset.root`.

    Args:
        policies: checkpoints of policies, or output folders of trainings, of which the last checkpoint is
            taken.
        world_model: an action world model.
        dataset: labelled rollouts, which both succeed and fail, best of policies like those that are judged.
        split: which of its episodes, as in lerobot-wmrl-eval-world-model; `validation` if the world model has
            learnt from this dataset.
        starts: where imagined episodes start, by default in the first frames of these rollouts. Each policy
            has one episode from each start.
        references: policies whose real success is known: comparison.json of lerobot-wmrl-compare in a real
            environment, or a file like it, `{"policies": {"outputs/a": {"k": 12, "n": 20}}}`, k successes in
            n episodes. These must have started as the imagined ones do.
        batch_size: imagined episodes that run at once.
        episode_length: frames within which an episode must succeed, in imagination and in the rollouts; by
            default as many as the clips that the world model has learnt from have.
        done_threshold: predicted success probability at which a frame counts as done.
        done_frames: consecutive done frames that make an imagined success.
        coverage: share of the intervals that shall contain the real success rate.
        device: device of the world model; by default the best one of this machine.
        output_dir: folder of judgement.json and judgement.png.
    """

    policies: list[str] = field(default_factory=list)
    world_model: Checkpoint = field(default_factory=Checkpoint)
    dataset: ChosenEpisodes = field(default_factory=ChosenEpisodes)
    split: str = "all"
    starts: StartFrames = field(default_factory=StartFrames)
    references: Path | None = None
    batch_size: int = 50
    episode_length: int | None = None
    done_threshold: float = 0.5
    done_frames: int = 3
    coverage: float = 0.9
    device: str | None = None
    output_dir: Path = Path("outputs/judgement")

    def check(self) -> None:
        """Raise FieldError for a setting that cannot be."""
        if not self.policies:
            raise FieldError(
                "policies", [], "there is nothing to judge", "give checkpoints of policies: [a,b]"
            )
        if not self.world_model.path:
            raise FieldError(
                "world_model.path",
                "",
                "is missing",
                "give the output folder of an action world model's training",
            )
        if not self.dataset.given:
            raise FieldError(
                "dataset.root", "", "is missing: labelled rollouts say how often the world model errs",
                "give some that it has not learnt from, or its own data with `split=validation`",
            )  # fmt: skip
        require_at_least(self, 1, "batch_size")
        if self.starts.branches:
            raise FieldError(
                "starts.branches", self.starts.branches,
                "from the middle of episodes a policy does not succeed as often as from their starts",
                "leave it out",
            )  # fmt: skip
        if not 0 < self.coverage < 1:
            raise FieldError("coverage", self.coverage, "must be a share between 0 and 1")

    def imagination(self) -> WorldModelEnv:
        """Return the world model as the environment of the policies. FieldError if it cannot be one."""
        starts = self.starts
        if not (starts.given or starts.frames or starts.resets):
            starts = replace(starts, **vars(self.dataset), split=self.split)
        with renamed("world_model_path", "world_model.path"):
            return WorldModelEnv(
                world_model_path=self.world_model.path, dataset=starts, reward=GeneralConfig(alpha=1.0),
                episode_length=self.episode_length, done_threshold=self.done_threshold,
                done_frames=self.done_frames, device=self.device,
            )  # fmt: skip


def judge(cfg: JudgeConfig) -> None:
    """Replay the rollouts and imagine what is missing of the episodes; write the results."""
    from lerobot_wmrl.evaluation.judgement import (
        RESULTS,
        Judgement,
        learnt_from,
        recognise,
        save_picture,
        trained_inside,
    )

    cfg.check()
    env = cfg.imagination()
    configs, references = read_both(cfg, env)
    require_free(cfg.output_dir, draccus.encode(cfg))
    results = cfg.output_dir / RESULTS
    outcomes = json.loads(results.read_text())["outcomes"] if results.is_file() else {}
    reasons = {name: trained_inside(name, cfg.world_model.path) for name in configs}
    refused = {name: why for name, why in reasons.items() if why}
    recognition = recognise(env, cfg.dataset, cfg.split)
    warning = learnt_from(cfg.world_model.path, cfg.dataset, cfg.split)
    judgement = Judgement(recognition, references, refused, cfg.coverage, warning, outcomes)
    with writing("output_dir", cfg.output_dir):
        claim_output_dir(cfg.output_dir, draccus.encode(cfg))
        if not judgement.blind:
            imagine(cfg, env, judgement, configs)
        write_json(results, judgement.as_json())
        save_picture(judgement, cfg.output_dir / "judgement.png")
    print(f"{judgement}\n{RESULTS} and judgement.png are in {cfg.output_dir}")


def read_both(
    cfg: JudgeConfig, env: WorldModelEnv
) -> "tuple[dict[str, PreTrainedConfig], dict[str, Proportion]]":
    """Read the configurations of all policies, references first, and the real success of these, by name.

    Raises:
        FieldError: one of them cannot be read, or a policy to judge is a reference.
    """
    from lerobot_wmrl.evaluation.compare import read_policies
    from lerobot_wmrl.evaluation.judgement import read_references

    judged, known = read_policies(cfg.policies, env), read_references(cfg.references)
    with renamed("policies", "references"):
        others = read_policies(list(known), env)
    if both := sorted(judged.keys() & others.keys()):
        raise FieldError(
            "policies", both[0], "its real success is known: it is among the references",
            "leave it out of one of the two",
        )  # fmt: skip
    return others | judged, dict(zip(others, known.values(), strict=True))


def imagine(
    cfg: JudgeConfig, env: WorldModelEnv, judgement: "Judgement", configs: "Mapping[str, PreTrainedConfig]"
) -> None:
    """Imagine the episodes of the policies that have none yet; write the results after every policy."""
    from lerobot_wmrl.evaluation.compare import fewest_starts, load_policies, opened, run_block
    from lerobot_wmrl.evaluation.judgement import RESULTS

    missing = {name: config for name, config in configs.items() if name not in judgement.outcomes}
    if not missing:
        return
    with opened(env, min(cfg.batch_size, env.dataset.max_starts), False, 1) as (envs,):
        starts = fewest_starts(envs)
        for name, config in tqdm(missing.items(), desc="Imagining", unit="policy"):
            policies = load_policies({name: config})
            blocks = [  # the seed of an episode is the number of its start
                run_block([envs], env, policies, min(cfg.batch_size, starts - begin), begin)
                for begin in range(0, starts, cfg.batch_size)
            ]
            judgement.outcomes[name] = [episode.successes[0] for block in blocks for episode in block]
            write_json(cfg.output_dir / RESULTS, judgement.as_json())


def main() -> None:
    """Run the console command."""
    run_command(judge, JudgeConfig, list)


if __name__ == "__main__":
    main()

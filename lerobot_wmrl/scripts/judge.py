"""lerobot-wmrl-judge: estimate from imagined episodes how often policies succeed in reality.

    lerobot-wmrl-judge --policies=[outputs/cloned,outputs/act] --dataset.root=rollouts \\
        --world_model.path=outputs/action_world_model --output_dir=outputs/judgement

It needs no simulator and no robot, but labelled rollouts (`--dataset`) that the world model has not learnt
from. Replayed in it, they give its recall and its false positives, by which the success rate in imagination
is corrected. The interval of the estimate holds if the world model errs about a policy as it does about the
rollouts.

Better: give policies whose real success is known, nine or more of different trainings (`--references`). A
line through their rates then predicts the real success of the others.
It holds for policies that could have been among the references.

A policy that was trained in this world model is not judged: it may have learnt what only looks like success
there. Without references, neither is one whose success in imagination no real rate explains. If the world
model hardly tells the rollouts' successes from their failures, the command ends with exit status 3 before it
imagines anything.

The same command again continues after the last finished policy. More policies, references or another coverage
may be given then: what has been imagined is kept.
"""

import json
from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field, replace
from math import ceil
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import PreTrainedConfig
from tqdm import tqdm

from lerobot_wmrl.common.checkpoints import Checkpoint, checkpoint_digest, resolved_name
from lerobot_wmrl.common.command_line import RunConfig, run_command
from lerobot_wmrl.common.constants import DONE_FRAMES, DONE_THRESHOLD
from lerobot_wmrl.common.errors import FieldError, Stopped, renamed, require_at_least, require_probability
from lerobot_wmrl.common.files import write_json, writing
from lerobot_wmrl.common.output_folders import Claim
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.data.dataset import ChosenEpisodes, fingerprint
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.envs.content import content_of
from lerobot_wmrl.evaluation.evidence import (
    LabelledRollouts,
    confusion_of,
    learnt_from,
    pooled_instructions,
    read_references,
    replayed_rollouts,
    trained_inside,
)
from lerobot_wmrl.evaluation.judgement import (
    JUDGEMENT_FILE,
    LEAST_YOUDEN,
    Judgement,
    confusion_json,
    confusion_sentence,
)
from lerobot_wmrl.evaluation.pictures import save_judgement
from lerobot_wmrl.evaluation.policy_rollouts import (
    Envs,
    about_policy,
    load_policies,
    opened,
    read_policies,
    run_block,
)


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
            environment (`--stop_early=false`), or a file like it, `{"policies": {"outputs/a": {"k": 12, "n":
            20}}}`, k successes in n episodes. These must have started as the imagined ones do.
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
    done_threshold: float = DONE_THRESHOLD
    done_frames: int = DONE_FRAMES
    coverage: float = 0.9
    device: str | None = None
    output_dir: Path = Path("outputs/judgement")

    def validate(self) -> None:
        """Raise FieldError for a setting that cannot be."""
        if not self.policies:
            raise FieldError("policies", [], "there is nothing to judge", "give checkpoints: [a,b]")
        if not self.world_model.path:
            raise FieldError(
                "world_model.path", "", "is missing", "give the output folder of its training, or a hub id"
            )
        if not self.dataset.given:
            raise FieldError(
                "dataset.root",
                "",
                "is missing: labelled rollouts say how often the world model errs",
                "give some that it has not learnt from, or its own data with `split=validation`",
            )
        require_at_least(self, 1, "batch_size")
        require_probability(self, "coverage")
        self._check_starts()

    @property
    def starts_given(self) -> bool:
        """Whether imagined episodes start elsewhere than in the rollouts."""
        return bool(self.starts.given or self.starts.frames or self.starts.resets)

    def _check_starts(self) -> None:
        starts = self.starts
        require_at_least(starts, 1, "max_starts")
        if starts.branches:
            raise FieldError(
                "starts.branches",
                starts.branches,
                "from the middle of episodes a policy does not succeed as often as from their starts",
                "leave it out",
            )
        if self.starts_given:
            with renamed("dataset", "starts"):
                starts.validate()
        elif starts != StartFrames(max_starts=starts.max_starts):
            raise FieldError(
                "starts.root",
                "",
                "is missing, so that imagined episodes start in the rollouts",
                "choose among them by `dataset.episodes` and `split`, or give `starts.root`",
            )

    def imagination(self) -> WorldModelEnv:
        """Return the world model as the environment of the policies. FieldError if it cannot be one."""
        starts, group = replace(self.starts, **vars(self.dataset), split=self.split), "dataset"
        if self.starts_given:
            starts, group = self.starts, "starts"
        with renamed("world_model_path", "world_model.path"), renamed("dataset", group):
            return WorldModelEnv(
                world_model_path=self.world_model.path,
                dataset=starts,
                episode_length=self.episode_length,
                done_threshold=self.done_threshold,
                done_frames=self.done_frames,
                device=self.device,
            )


MAY_DIFFER = ("policies", "references", "coverage")
"""Settings that change no imagined episode of a policy. Device and batch size do: by its number format."""


def judge(cfg: JudgeConfig) -> None:
    """Replay the rollouts and imagine what is missing of the episodes; write the results."""
    cfg.validate()
    cfg.world_model.path = resolved_name(cfg.world_model.path)
    env = cfg.imagination()
    configs, references = read_both(cfg, env)
    rollouts = LabelledRollouts.read(cfg.dataset, cfg.split, cfg.dataset.episodes)
    claim = Claim(cfg.output_dir, draccus.encode(cfg), MAY_DIFFER, named_content(cfg, env, rollouts.root))
    claim.check()
    confusion, warnings = confusion_of(replayed_rollouts(env, rollouts), env)
    if not confusion.youden >= LEAST_YOUDEN:
        raise Stopped(
            f"{confusion_sentence(confusion)} That is too little to judge by. Choose another "
            "--done_threshold or --done_frames (lerobot-wmrl-eval-world-model shows what they do), or train "
            "the world model on more failures"
        )
    warnings = [
        *warnings_of_learnt(rollouts, cfg.world_model.path),
        *pooled_instructions(rollouts),
        *warnings,
    ]
    refused = {name: why for name in configs if (why := trained_inside(name, cfg.world_model.path))}
    checkpoints = {name: checkpoint_digest(name) for name in configs}
    judgement = Judgement(confusion, references, refused, cfg.coverage, warnings, checkpoints=checkpoints)
    remember(judgement, cfg, configs)
    with writing("output_dir", cfg.output_dir):
        imagine(cfg, env, judgement, configs, len(rollouts.chosen), claim)
        save_judgement(judgement, cfg.output_dir / "judgement.png")
    print(
        f"{judgement}\n\njudgement.json and judgement.png are in {cfg.output_dir}. Next: try the best in "
        "reality, and give the success that you count as --references"
    )


def warnings_of_learnt(rollouts: LabelledRollouts, world_model: str) -> list[str]:
    """Return a warning if the world model has learnt from the rollouts."""
    if not (learnt := learnt_from(world_model, rollouts)):
        return []
    return [
        f"The world model has learnt from {learnt} of these episodes ({rollouts.name}) and predicts them "
        "better than others: estimates and intervals are wrong. Take those that were held out "
        "(--split=validation of the dataset that it was trained on), or others."
    ]


def read_both(
    cfg: JudgeConfig, env: WorldModelEnv
) -> tuple[dict[str, PreTrainedConfig], dict[str, Proportion]]:
    """Read the configurations of all policies, references first, and the real success of these, by name.

    Raises:
        FieldError: one of them cannot be read, or a policy to judge is a reference.
    """
    known, judged = read_references(cfg.references), read_policies(cfg.policies, env)
    with renamed("policies", "references"):
        references = read_policies(list(known), env)
    if both := sorted(judged.keys() & references.keys()):
        raise FieldError(
            "policies",
            both[0],
            "its real success is known: it is among the references",
            "leave it out of one of the two",
        )
    return references | judged, dict(zip(references, known.values(), strict=True))


def named_content(cfg: JudgeConfig, env: WorldModelEnv, rollouts: Path) -> dict[str, str]:
    """Return digests of the rollouts, and of what imagined episodes follow from beside the policy."""
    with starts_as_typed(cfg):
        content = content_of(env)
    return content | {"rollouts": fingerprint(rollouts) if cfg.starts_given else content["dataset"]}


def starts_as_typed(cfg: JudgeConfig) -> AbstractContextManager[None]:
    """Name the starts' settings in an error that leaves the block as they were given: `starts`, or, where
    they are the rollouts, `dataset`."""
    return renamed("dataset", "starts") if cfg.starts_given else nullcontext()


def remember(judgement: Judgement, cfg: JudgeConfig, configs: Collection[str]) -> None:
    """Take over what earlier calls have imagined, of the policies of this one and of others.

    Raises:
        ValueError: the rollouts, the world model or a policy are not what they were then.
    """
    results = cfg.output_dir / JUDGEMENT_FILE
    if not results.is_file():
        return
    stored, now = json.loads(results.read_text()), judgement.checkpoints
    changed = [
        f"{cfg.dataset.name} or the world model"
        for name, rate in confusion_json(judgement.confusion).items()
        if stored[name] != rate
    ]
    before = stored["checkpoints"]
    changed += [name for name in configs if before.get(name, now[name]) != now[name]]
    if changed:
        raise ValueError(
            f"--output_dir={cfg.output_dir}: {changed[0]} has changed since its episodes were imagined; "
            "choose another folder"
        )
    for name, outcomes in stored["outcomes"].items():
        (judgement.outcomes if name in configs else judgement.earlier)[name] = outcomes
    judgement.checkpoints = before | now


def imagine(
    cfg: JudgeConfig,
    env: WorldModelEnv,
    judgement: Judgement,
    configs: Mapping[str, PreTrainedConfig],
    rollouts: int,
    claim: Claim,
) -> None:
    """Imagine the episodes of the policies that have none yet; write the results after every policy.

    rollouts: how many there are, and so how many starts, unless others are given.
    """

    def write() -> None:
        finished = configs.keys() == judgement.outcomes.keys()
        write_json(cfg.output_dir / JUDGEMENT_FILE, judgement.as_json(finished))

    most_starts = env.dataset.max_starts if cfg.starts_given else min(env.dataset.max_starts, rollouts)
    size = even_batch(most_starts, cfg.batch_size)
    with ExitStack() as held:
        if missing := [name for name in configs if name not in judgement.outcomes]:
            with starts_as_typed(cfg):
                (envs,) = held.enter_context(opened(env, size, False, 1))
                starts = starts_of_one_task(envs, cfg)
        held.enter_context(claim.held())
        remember(judgement, cfg, configs)  # what another has added
        write()
        for name in tqdm(missing, desc="Imagining", unit="policy"):
            if name in judgement.outcomes:
                continue
            with about_policy(name):
                policies = load_policies({name: configs[name]})
                blocks = [  # the seed of an episode is the number of its start
                    run_block([envs], env, policies, min(size, starts - begin), begin)
                    for begin in range(0, starts, size)
                ]
            judgement.outcomes[name] = [episode.successes[0] for block in blocks for episode in block]
            write()


def even_batch(episodes: int, most: int) -> int:
    """Return the size of batches of at most `most` that are about equal: a smaller last one takes as long."""
    return ceil(episodes / ceil(episodes / most))


def starts_of_one_task(envs: Envs, cfg: JudgeConfig) -> int:
    """Return the number of starts. FieldError if they are of several tasks: one rate says little of these."""
    made = [env for tasks in envs.values() for env in tasks.values()]
    if len(made) > 1:
        fault = f"the starts are of {len(made)} tasks, and success is judged task by task"
        if cfg.starts_given:
            raise FieldError(
                "dataset.tasks", cfg.starts.tasks, fault, "choose one of them, and rollouts of the same task"
            )
        raise FieldError(
            "dataset.episodes", cfg.dataset.episodes, fault, "choose the rollouts of one of them"
        )
    env: Any = made[0]
    return len(env.env.starts)


def main() -> None:
    """Run the console command."""
    run_command(judge, JudgeConfig, list)


if __name__ == "__main__":
    main()

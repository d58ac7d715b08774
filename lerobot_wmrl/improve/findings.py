"""What a dataset offers to a policy that is to be improved, and what it lacks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, DONE, OBS_IMAGE, OBS_STATE

from lerobot_wmrl.common.constants import START_COLUMNS, START_TASK
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.images import camera_key
from lerobot_wmrl.common.lerobot_commands import edit_advice
from lerobot_wmrl.common.policy_checks import check_fit
from lerobot_wmrl.data.checks import (
    camera_names,
    check_cameras,
    check_widths,
    frame_size,
    require_shown,
    shows_colours,
    solved_from_the_start,
)
from lerobot_wmrl.data.embodiment import Embodiment, check_same_robot, component_names
from lerobot_wmrl.data.episodes import EpisodeTable, count_tasks, success_column
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv

LONGEST_IMAGINATION = 98
"""Frames of an imagined episode at most. Where recorded episodes are longer, imagination also begins in their
middle, and no prediction looks further ahead than this."""

FEW_DECISIONS = 5
"""Decisions an imagined episode below which RL has little to choose."""

FEW_FAILURES = 10
"""Failed episodes below which a world model hardly learns what failure looks like."""


@dataclass(frozen=True)
class Findings:
    """What was found in a dataset.

    Args:
        lines: what it has, as text.
        missing: what it lacks, and what that costs.
        cameras: names of the cameras that the policy looks at.
        frame_side: the shorter side of their frames in pixels.
        pixels: pixels of all these cameras' frames.
        held_out: how many episodes are held out from training.
        held_out_tell: whether some of these succeed and some fail.
        tasks: how many tasks there are, as far as the dataset says.
        fewest: how many episodes there are of the task that has the fewest.
        longest: frames of the longest episode.
        usual: length that nine of ten episodes do not exceed, of the task with the longest.
        success_frames: frames of all successful episodes.
        failures: how many episodes fail.
        root: folder of the dataset.
        total: how many episodes it has, chosen or not.
        columns: its columns, by name, and how LeRobot stores each.
        held: frames in which success holds in a successful episode, the median.
    """

    lines: list[str]
    missing: list[str]
    cameras: list[str]
    frame_side: int
    pixels: int
    held_out: int
    held_out_tell: bool
    tasks: int
    fewest: int
    longest: int
    usual: int
    success_frames: int
    failures: int
    root: Path
    total: int
    columns: dict[str, str]
    held: int

    def __str__(self) -> str:
        return "\n".join([*(f"  {line}" for line in self.lines), *(f"  ! {line}" for line in self.missing)])


def tell_apart(success: np.ndarray) -> bool:
    """Whether some episodes succeed and some fail, so that a world model can be asked which. (E,) bool"""
    return bool(success.any() and not success.all())


def require_mergeable(dataset: LeRobotDataset, env: WmrlManiSkillEnv) -> None:
    """Raise FieldError unless rollouts in ManiSkill can be merged with the dataset: have its columns."""
    features, shown = dataset.features, [camera_key(name) for name in env.cameras]
    colours = [name for name, feature in features.items() if shows_colours(feature)]
    if lacking := [name for name in (*START_COLUMNS, "next.truncated") if name not in features]:
        raise FieldError(
            "dataset.root",
            dataset.root,
            f"lacks {', '.join(lacking)}, which rollouts in ManiSkill have: they could not be merged",
            "record it with lerobot-wmrl-record, or leave `rollouts` out",
        )
    if {*colours} != {*shown}:
        raise FieldError(
            "real_env.cameras",
            list(env.cameras),
            f"rollouts would have these, the dataset has {', '.join(camera_names(colours))}: they could not "
            "be merged",
            f"set `real_env.cameras` to [{','.join(camera_names(colours))}]",
        )
    if depth := dataset.meta.depth_keys:
        raise FieldError(
            "dataset.root",
            dataset.root,
            f"has {', '.join(depth)}, which the rollouts lack",
            "remove these columns: "
            + edit_advice(dataset.root, "remove_feature", {"operation.feature_names": [*depth]}),
        )


def require_checkable(
    check: EpisodeTable,
    episodes: Sequence[int] | None,
    learnt: EpisodeTable,
    robot: Embodiment,
    cameras: Sequence[str],
) -> None:
    """Raise FieldError unless a world model that learns from one dataset can be checked on these episodes of
    another.

    Args:
        check: the other dataset.
        episodes: those of it to check on, all if None.
        learnt: the dataset that is learnt from.
        robot: the robot that it shows.
        cameras: keys of the cameras that the world model looks at.
    """
    features, meta = learnt.dataset.features, check.dataset.meta
    check_cameras(meta, cameras)
    widths = {name: features[name]["shape"][0] for name in (ACTION, OBS_STATE) if name in features}
    check_widths(meta, widths)
    check_same_robot(robot, meta)
    success = check.success[check.among(episodes)]
    if not tell_apart(success):
        raise FieldError(
            "dataset.root",
            check.dataset.root,
            f"of its episodes {success.sum()} succeed and {(~success).sum()} fail, and a check needs both",
            "give labelled rollouts, failures among them",
        )


def require_improvable(
    table: EpisodeTable, policy: PreTrainedConfig, shown: Mapping[str, tuple[int, ...]]
) -> None:
    """Raise FieldError unless a policy can be improved with these episodes.

    shown: what they show, by LeRobot's names with their shapes, images (3, H, W).
    """
    if not any(key.startswith(OBS_IMAGE) for key in policy.image_features):
        raise FieldError(
            "policy.path",
            policy.pretrained_path,
            "looks at no camera, and a world model imagines frames",
            "train a policy that looks at one",
        )
    check_fit(policy, shown, table.action.shape[1], "the dataset")
    if not table.success.any():
        has = "has no successful episode" if table.has_labels else "says nowhere whether an episode succeeds"
        raise FieldError(
            "dataset.root",
            table.dataset.root,
            f"{has}, so there is nothing to reward",
            "add next.success with lerobot-wmrl-label, or record successes",
        )
    require_shown(table, range(len(table.start)))


def require_learnt_successes(table: EpisodeTable, episodes: Sequence[int] | None) -> None:
    """Raise FieldError if chosen episodes succeed, and all that do are held out from training."""
    successes = table.success & table.among(episodes)
    if successes.any() and not (successes & table.training(episodes)).any():
        raise FieldError(
            "dataset.root",
            table.dataset.root,
            f"its {successes.sum()} successful episodes are all held out from training, as every twentieth "
            "episode is, so there is nothing to learn success from",
            "record or label more successes",
        )


def inspect_dataset(
    table: EpisodeTable, policy: PreTrainedConfig, episodes: Sequence[int] | None, rollouts: int = 0
) -> Findings:
    """Describe the chosen episodes of a dataset, and check that a policy can be improved with them.

    rollouts: number that will be recorded too. With any, warnings about failures wait for them.

    Raises:
        FieldError: the policy cannot be improved with it.
    """
    chosen = table.among(episodes)
    held_out, total = table.success[table.validation & chosen], len(chosen)
    if not rollouts:
        require_learnt_successes(table, episodes)
    table = table.subset(chosen)
    features, success = table.dataset.features, table.success
    keys = [key for key in policy.image_features if key.startswith(OBS_IMAGE)]
    sizes = {key: frame_size(features[key]) for key in keys if key in features}
    state = {OBS_STATE: tuple(features[OBS_STATE]["shape"])} if OBS_STATE in features else {}
    require_improvable(table, policy, {key: (3, *size) for key, size in sizes.items()} | state)
    tasks = np.unique(table.column(START_TASK), return_counts=True)[1]
    done = [table.success_target[rows].sum() for rows in table.rows(range(len(success)))]
    return Findings(
        lines=describe(table, dict(zip(camera_names(keys), sizes.values(), strict=True))),
        missing=[
            *missing_labels(table),
            *([] if rollouts else [*one_sided_tasks(table), *few_failures(table)]),
            *few_decisions(policy, table),
        ],
        cameras=camera_names(keys),
        frame_side=min(map(min, sizes.values())),
        pixels=sum(h * w for h, w in sizes.values()),
        held_out=len(held_out),
        held_out_tell=tell_apart(held_out),
        tasks=len(tasks),
        fewest=int(tasks.min()),
        longest=int(table.length.max()),
        usual=usual_length(table),
        success_frames=int(table.length[success].sum()),
        failures=int((~success).sum()),
        root=Path(table.dataset.root),
        total=total,
        columns={name: feature["dtype"] for name, feature in features.items()},
        held=int(np.median(np.array(done)[success])),
    )


def describe(table: EpisodeTable, sizes: Mapping[str, tuple[int, int]]) -> list[str]:
    """Describe a dataset in a few lines; sizes: camera → height and width of its frames."""
    features, fps = table.dataset.features, table.dataset.fps
    success, longest = table.success, table.length.max()
    state = component_names(features[OBS_STATE]) if OBS_STATE in features else ["none"]
    cameras = [f"{name} {height}x{width}" for name, (height, width) in sizes.items()]
    return [
        f"{len(success)} episodes, {table.length.sum()} frames at {fps} Hz; the longest has {longest} "
        f"({longest / fps:.1f} s)",
        f"cameras that the policy sees (height x width): {', '.join(cameras)}",
        f"action: {', '.join(component_names(features[ACTION]))}",
        f"state: {', '.join(state)}",
        f"{success.sum()} episodes succeed, {(~success).sum()} fail",
    ]


def usual_length(table: EpisodeTable) -> int:
    """Return the frames that nine of ten episodes do not exceed, of the task with the longest."""
    tasks = table.column(START_TASK)
    return max(
        int(np.quantile(table.length[tasks == task], 0.9, method="inverted_cdf")) for task in np.unique(tasks)
    )


def missing_labels(table: EpisodeTable) -> list[str]:
    """Say so if success is read from a column that is not about it, or is that of whole episodes."""
    warnings = [warning] if (warning := solved_from_the_start(table)) else []
    if success_column(table.dataset.features) != DONE:
        return warnings
    everywhere = ". It is in every episode: label those that failed" if table.success.all() else ""
    return [
        f"next.done is taken for success: there is no next.success (lerobot-wmrl-label adds it){everywhere}",
        *warnings,
    ]


def one_sided_tasks(table: EpisodeTable) -> list[str]:
    """Say so if, in data of several tasks and both outcomes, an instruction has one outcome alone: the world
    model learns what it asks for from its own episodes."""
    if count_tasks([table]) < 2 or len(set(table.success.tolist())) < 2:
        return []
    outcomes: dict[str, set[bool]] = {}
    for instruction, success in zip(table.instructions, table.success.tolist(), strict=True):
        outcomes.setdefault(instruction, set()).add(success)
    lacking = {
        name: [instruction for instruction, seen in outcomes.items() if seen == {other}]
        for name, other in (("success", False), ("failure", True))
    }
    if not any(lacking.values()):
        return []
    counts = " and ".join(
        f"{len(found)} without a {name} (such as {found[0]!r})" for name, found in lacking.items() if found
    )
    return [
        f"instructions: {len(outcomes)}, by which success is told; {counts}. What each asks for is "
        "learnt from its own episodes: record some of both outcomes, or, if these are one task in several "
        "wordings, give it one (lerobot-edit-dataset --operation.type=modify_tasks)"
    ]


def few_failures(
    table: EpisodeTable,
    remedy: str = "Record rollouts of the policy (--rollouts with --real_env; on a robot lerobot-rollout, "
    "then lerobot-wmrl-label)",
) -> list[str]:
    """Say so if few episodes fail, what that costs, and what helps."""
    failures = int((~table.success).sum())
    if failures >= FEW_FAILURES:
        return []
    return [
        f"failures: {failures}. The world model will hardly tell them from successes, and the policy learns "
        f"what it takes for one. {remedy}, and leave the failures in"
    ]


def few_decisions(policy: PreTrainedConfig, table: EpisodeTable) -> list[str]:
    """Say so if a policy of chunks decides only a few times an episode."""
    steps = getattr(policy, "n_action_steps", 1)
    usual = min(LONGEST_IMAGINATION, int(np.median(table.length)))
    if steps == 1 or usual >= FEW_DECISIONS * steps:
        return []
    return [
        f"decisions: {policy.type} takes {steps} actions at a time, and an imagined episode has about "
        f"{usual} frames. RL has little to choose: set --policy.n_action_steps lower"
    ]

"""lerobot-wmrl-resample: copy a dataset at a lower frame rate, or without what follows success.

    lerobot-wmrl-resample --dataset.root=data/50hz --every=2 --output_dir=data/25hz
    lerobot-wmrl-resample --dataset.root=data/80hz --every=4 --displacements=[x,y,z] --output_dir=data/20hz
    lerobot-wmrl-resample --dataset.root=data/labelled --every=1 --solved_frames=4 --output_dir=data/cut

Frames that hardly differ cost as much to imagine as others. 500 frames at 50 Hz become 250 at 25 Hz. A frame
that is kept gets the action that was sent last before the next one, or, of the components in
`--displacements`, the sum of the actions in between. The rewards in between are added up, and a success in
between counts. A policy for the new rate has to be trained on the copy, and acts at that rate.

With `--solved_frames` a successful episode ends where it has shown the solved task for so many frames: a
policy that is cloned from what follows learns to stand still.
"""

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, DEFAULT_FEATURES, DONE, REWARD

from lerobot_wmrl.common.command_line import RunConfig, run_command
from lerobot_wmrl.common.errors import FieldError, require_at_least
from lerobot_wmrl.common.files import require_new, whole_folder, writing
from lerobot_wmrl.common.flags import flag_as_typed
from lerobot_wmrl.common.lerobot_commands import edit_advice
from lerobot_wmrl.common.success_criterion import first_run
from lerobot_wmrl.data.dataset import DatasetSource, open_dataset, save_episode
from lerobot_wmrl.data.decoding import decode, row_parts, rows_of
from lerobot_wmrl.data.embodiment import component_names
from lerobot_wmrl.data.episodes import SUCCESS, SUCCESS_COLUMNS, read_episodes
from lerobot_wmrl.data.features import encoder_of
from lerobot_wmrl.evaluation.accuracy import absolute_control
from lerobot_wmrl.rewards.success_rules import duration_lines, longest_run

AFTER: Final = "next."
"""How the names of columns begin that say what came after a frame's action."""


@dataclass
class ResampleConfig(RunConfig):
    """Copy a dataset at a lower frame rate, or without what follows success.

    Args:
        dataset: the dataset to copy.
        every: keep every second frame, third, …; must divide the dataset's frames a second. 1 keeps all.
        displacements: the action's components that add up, such as changes of a position: their names, or
            numbers from 0 on where they have none. The others, such as targets and grippers, keep the last
            value.
        solved_frames: frames of the copy in a row that show the solved task, after which an episode ends. One
            that has not as many in a row is kept whole. By default nothing is cut off. Needs `next.success`.
        output_dir: folder of the copy.
        repo_id: its name, for the hub; by default `local/` and the folder's.
    """

    dataset: DatasetSource = field(default_factory=DatasetSource)
    every: int = 2
    displacements: list[str] = field(default_factory=list)
    solved_frames: int | None = None
    output_dir: Path = Path("outputs/resampled")
    repo_id: str | None = None


def resample(cfg: ResampleConfig) -> None:
    """Write the copy and say what is in it."""
    dataset = cfg.dataset.open()
    table = read_episodes(dataset)
    check(cfg, dataset)
    summed = np.isin(component_names(dataset.features[ACTION]), cfg.displacements)
    if cfg.every > 1 and absolute_control(table) is False and not summed.any():
        logging.warning(
            "the actions do not follow the state: if they are displacements, name the components that add up "
            "with --displacements"
        )
    with writing("output_dir", cfg.output_dir, resumes=False):
        write_resampled(dataset, cfg, summed)
    copied = read_episodes(open_dataset(cfg.output_dir))
    labelled = SUCCESS in copied.dataset.features  # next.done may say no more than that episodes end
    success = [copied.success_target[rows] for rows in copied.rows(range(len(copied.start)))]
    lines = [
        f"{cfg.output_dir}: {len(copied.length)} episodes, {copied.length.sum()} frames at "
        f"{copied.dataset.fps} Hz, the longest has {copied.length.max()}.",
        *cut_lines(cfg, -(-table.length // cfg.every) - copied.length),
        *duration_lines([longest_run(each) for each in success] if labelled else []),
        f"Next: lerobot-train {flag_as_typed('dataset.root', cfg.output_dir)} …",
    ]
    print("\n".join(lines))


def check(cfg: ResampleConfig, dataset: LeRobotDataset) -> None:
    """Raise FieldError for a setting that cannot be, or a dataset that cannot be copied whole."""
    require_at_least(cfg, 1 if cfg.solved_frames else 2, "every")
    if cfg.solved_frames is not None:
        require_at_least(cfg, 1, "solved_frames")
        if SUCCESS not in dataset.features:
            raise FieldError(
                "solved_frames",
                cfg.solved_frames,
                f"the dataset does not say in which frames the task is solved ({SUCCESS})",
                "label it first (lerobot-wmrl-label)",
            )
    if dataset.fps % cfg.every:
        raise FieldError(
            "every",
            cfg.every,
            f"does not divide the dataset's {dataset.fps} frames a second",
            "choose a number that does",
        )
    names = component_names(dataset.features[ACTION])
    for name in cfg.displacements:
        if name not in names:
            raise FieldError(
                "displacements", name, "the action has no such component", f"choose from {names}"
            )
    if dataset.meta.depth_keys:
        depth = ", ".join(dataset.meta.depth_keys)
        raise FieldError(
            "dataset.root",
            dataset.root,
            f"has depth ({depth}), which is not copied",
            "remove it first: "
            + edit_advice(
                dataset.root, "remove_feature", {"operation.feature_names": [*dataset.meta.depth_keys]}
            ),
        )
    if language := [name for name, each in dataset.features.items() if each["dtype"] == "language"]:
        raise FieldError(
            "dataset.root",
            dataset.root,
            f"has annotations ({', '.join(language)}), which are not copied",
            "remove them first: "
            + edit_advice(dataset.root, "remove_feature", {"operation.feature_names": language}),
        )
    require_new("output_dir", cfg.output_dir)


def write_resampled(dataset: LeRobotDataset, cfg: ResampleConfig, summed: np.ndarray) -> None:
    """Copy the frames that are kept with LeRobot's own functions; the folder is whole or absent.

    summed: components of the action that add up, (A,).
    """
    from tqdm import trange

    try:
        encoder = encoder_of(dataset.features)
    except ValueError as error:  # LeRobot reads more codecs than it writes
        logging.warning("videos are encoded as LeRobot does by default, not as they were: %s", error)
        encoder = None
    with whole_folder(cfg.output_dir) as partial:
        copy = LeRobotDataset.create(
            cfg.repo_id or f"local/{cfg.output_dir.name}",
            dataset.fps // cfg.every,
            scaled_features(dataset.features, summed, cfg.every),
            root=partial,
            robot_type=dataset.meta.robot_type,
            use_videos=bool(dataset.meta.video_keys),
            rgb_encoder=encoder,
        )
        for episode in trange(dataset.num_episodes, unit="episode", desc="Copying"):
            for row in episode_rows(dataset, episode, copy.features, cfg, summed):
                copy.add_frame(row)
            save_episode(copy)
        copy.finalize()


def scaled_features(features: Mapping[str, Any], summed: np.ndarray, every: int) -> dict[str, Any]:
    """Return a dataset's own features; the recorded range of components that add up grows with them."""
    columns = {name: dict(each) for name, each in features.items() if name not in DEFAULT_FEATURES}
    info = dict(columns[ACTION].get("info") or {})
    for end in {"low", "high"} & info.keys():
        info[end] = (np.asarray(info[end]) * np.where(summed, every, 1)).tolist()
    return columns | {ACTION: columns[ACTION] | ({"info": info} if info else {})}


def cut_lines(cfg: ResampleConfig, left_out: np.ndarray) -> list[str]:
    """Say how much was cut off, of each episode so many frames of the copy. (E,)"""
    if cfg.solved_frames is None:
        return []
    return [f"{(left_out > 0).sum()} episodes were cut, by {left_out.sum()} frames together."]


def end_of(solved: np.ndarray, frames: int) -> int:
    """Return after how many rows an episode has been solved for so many in a row; all rows if it never is.

    solved: whether each row's action leads to a frame that shows the solved task. (T,)
    """
    (begin,) = first_run(solved[None], frames).tolist()
    return len(solved) if begin < 0 else begin + frames


def episode_rows(
    dataset: LeRobotDataset,
    episode: int,
    features: Mapping[str, Any],
    cfg: ResampleConfig,
    summed: np.ndarray,
) -> Iterator[dict[str, Any]]:
    """Yield the rows of an episode's copy, as LeRobotDataset's `add_frame` takes them."""
    every, columns = cfg.every, kept_values(dataset, episode, features, cfg.every, summed)
    begin, length = rows_of(dataset, episode).start, len(columns["task"])
    if cfg.solved_frames is not None:
        length = end_of(columns[SUCCESS].reshape(-1), cfg.solved_frames)
    if DONE in columns and length < len(columns["task"]):
        columns[DONE][length - 1] = True
    for part in row_parts(dataset, episode):  # the frames of a long episode would not fit into the memory
        rows = range(part.start, min(part.stop, begin + length * every))
        kept = [row for row in rows if (row - begin) % every == 0]
        if not kept:
            return
        frames = {key: decode(dataset, episode, key, part) for key in dataset.meta.camera_keys}
        for row in kept:
            images = {key: each[row - part.start].permute(1, 2, 0).numpy() for key, each in frames.items()}
            yield images | {key: values[(row - begin) // every] for key, values in columns.items()}


def kept_values(
    dataset: LeRobotDataset, episode: int, features: Mapping[str, Any], every: int, summed: np.ndarray
) -> dict[str, Any]:
    """Return an episode's columns but for its pictures, and `task`, at the T rows that are kept. (T, …)"""
    rows = rows_of(dataset, episode)
    length = rows.stop - rows.start
    kept = np.arange(0, length, every)
    names = [key for key in features if key not in {*DEFAULT_FEATURES, *dataset.meta.camera_keys}]
    table = dataset.hf_dataset.with_format(None, columns=[*names, "task_index"])[rows]
    last = np.append(kept[1:], length) - 1
    columns: dict[str, Any] = {}
    for key in names:
        values = np.asarray(table[key])
        chosen = last if key.startswith(AFTER) else kept
        if features[key]["dtype"] == "string":
            columns[key] = [str(value) for value in values.reshape(-1)[chosen]]
            continue
        if key == ACTION:
            values = np.where(summed, np.add.reduceat(values, kept), values[last])
        elif key == REWARD:
            values = np.add.reduceat(values, kept)
        elif key in SUCCESS_COLUMNS:
            values = np.logical_or.reduceat(values, kept)
        else:
            values = values[chosen]
        columns[key] = values.astype(features[key]["dtype"]).reshape(-1, *features[key]["shape"])
    tasks = dataset.meta.tasks.index
    return columns | {"task": [tasks[index] for index in np.asarray(table["task_index"])[kept]]}


def main() -> None:
    """Run the console command."""
    run_command(resample, ResampleConfig, list)


if __name__ == "__main__":
    main()

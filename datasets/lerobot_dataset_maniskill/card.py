"""The dataset card, README.md, with a picture of each task: one episode from its start to success.

Everything in it is read from the dataset's own files, so that it can be written again under another name.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_dataset_maniskill.writer import VOCABULARY_FILE
from lerobot_wmrl.common.constants import KINDS, START_KIND, START_SCENE, START_TASK, TASK_NAMES
from lerobot_wmrl.common.files import markdown_table, write_text
from lerobot_wmrl.common.frame_strips import enlarged, in_a_row
from lerobot_wmrl.common.statistics import Proportion, evenly_spaced
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.maniskill.embodiment import FPS

CARD_FILE = Path("README.md")

KIND_MEANINGS = {
    "optimal": "a planner's straight trajectory",
    "waypoint": "a planner's trajectory with a detour",
    "interpolated": "a planner's trajectory off the straight lines",
    "noisy": "a planner whose waypoints are noisy, so that some episodes fail",
    "near_miss": "a planner that misses on purpose",
    "policy": "a policy's rollouts",
    "play": "moving, pushing and lifting at random, without a reset",
    "human_like": "a planner with pauses, detours, tremor and uneven speed, as in teleoperation",
}
"""Kind, one of `constants.KINDS` → how its actions were made."""

MEDIA: Final = Path("media")
FRAMES: Final = 6
WIDTH: Final = 192
"""Pixels that a frame is enlarged to, as far as a whole factor allows."""


def name_card(root: Path, repo_id: str) -> None:
    """Write pictures and card, unless the card has this name already: somebody may have edited it."""
    card = root / CARD_FILE
    if not card.is_file() or title(repo_id) not in card.read_text().splitlines():
        write_card(root, repo_id, read_episodes(open_dataset(root)))


def write_card(root: Path, repo_id: str, table: EpisodeTable) -> None:
    """Write the pictures, then the card, of a dataset.

    Args:
        root: root of the dataset.
        repo_id: its name.
        table: its episodes.
    """
    write_pictures(root, repo_id, table)
    vocabulary = json.loads((root / VOCABULARY_FILE).read_text())
    text = CARD.format(
        title=title(repo_id),
        name=repo_id,
        fps=FPS,
        episodes=len(table.length),
        frames=table.length.sum(),
        minutes=table.length.sum() / FPS / 60,
        success=markdown_table(SUCCESS_HEAD, success_rows(table)),
        meanings="\n".join(f"- `{kind}`: {KIND_MEANINGS[kind]}" for kind in recorded_kinds(table)),
        pictures="\n\n".join(picture_lines(table)),
        scenes=markdown_table(SCENES_HEAD, scene_rows(table, vocabulary["scenes"])),
        size=vocabulary["image_size"],
        cameras=", ".join(f"`observation.images.{camera}`" for camera in vocabulary["cameras"]),
        depth=DEPTH if vocabulary["recording"]["depth"] else "",
        low=vocabulary["action_low"],
        high=vocabulary["action_high"],
        hold=vocabulary["hold_frames"],
        tasks=", ".join(TASK_NAMES),
        kinds=", ".join(KINDS),
    )
    write_text(root / CARD_FILE, text)


def title(repo_id: str) -> str:
    """Return the card's first line."""
    return f"# {repo_id}"


def recorded_kinds(table: EpisodeTable) -> list[str]:
    """Return the names of the kinds that have episodes."""
    return [KINDS[kind] for kind in np.unique(table.columns[START_KIND])]


SUCCESS_HEAD = ("task", "kind", "episodes", "successful", "success rate (95 % interval)")


def success_rows(table: EpisodeTable) -> Iterator[tuple[Any, ...]]:
    """Yield a row for each task and kind that has episodes."""
    tasks, kinds, success = table.columns[START_TASK], table.columns[START_KIND], table.success
    for task, kind in sorted({*zip(tasks.tolist(), kinds.tolist(), strict=True)}):
        chosen = success[(tasks == task) & (kinds == kind)]
        rate = Proportion.of(chosen)
        low, high = rate.interval
        shown = f"{rate.share:.0%} ({low:.0%}–{high:.0%})"
        yield TASK_NAMES[task], KINDS[kind], rate.n, rate.k, shown


def picture_lines(table: EpisodeTable) -> Iterator[str]:
    """Yield every example's picture with its caption."""
    for example in chosen_examples(table):
        end = "from its start to success" if example.success else "which fails"
        caption = f"`{example.task}`: episode {example.episode} ({example.kind}), {end}"
        yield f"![{example.task}]({example.path.as_posix()})\n\n*{caption}.*"


SCENES_HEAD = ("scene", "object", "container", "table", "split", "episodes")


def scene_rows(table: EpisodeTable, scenes: Sequence[Mapping[str, Any]]) -> Iterator[tuple[Any, ...]]:
    """Yield a row for each recorded scene. `scenes` is the vocabulary's, by index."""
    for index, episodes in zip(*np.unique(table.columns[START_SCENE], return_counts=True), strict=True):
        scene = scenes[index]
        yield index, *(scene[part] for part in ("object", "container", "table", "split")), episodes


def success_by_kind(table: EpisodeTable) -> dict[str, tuple[int, int]]:
    """Count by kind. Returns kind → (successful episodes, episodes)."""
    kinds, success = table.columns[START_KIND], table.success
    return {
        name: (int(success[kinds == index].sum()), int(np.sum(kinds == index)))
        for index, name in enumerate(KINDS)
        if np.any(kinds == index)
    }


@dataclass(frozen=True)
class Example:
    """An episode whose picture shows its task."""

    task: str
    episode: int
    kind: str
    success: bool

    @property
    def path(self) -> Path:
        """Path of the picture, from the dataset's root."""
        return MEDIA / f"{self.task}.png"


def chosen_examples(table: EpisodeTable) -> list[Example]:
    """Choose an episode of each task: its first success, optimal if possible, else its first failure."""
    tasks, kinds, success = table.columns[START_TASK], table.columns[START_KIND], table.success
    best = np.lexsort((kinds, ~success))
    chosen = [best[tasks[best] == task][0] for task in np.unique(tasks)]
    return [
        Example(TASK_NAMES[tasks[episode]], int(episode), KINDS[kinds[episode]], bool(success[episode]))
        for episode in chosen
    ]


def write_pictures(root: Path, repo_id: str, table: EpisodeTable) -> None:
    """Write the picture of every example into the folder `media` of the dataset at `root`."""
    (root / MEDIA).mkdir(exist_ok=True)
    for example in chosen_examples(table):
        dataset = LeRobotDataset(repo_id, root=root, episodes=[example.episode], return_uint8=True)
        frames = frames_to_success(dataset)
        enlarged(in_a_row(frames), max(1, WIDTH // frames.shape[2])).save(root / example.path)


def frames_to_success(dataset: LeRobotDataset) -> np.ndarray:
    """Return frames of a dataset of one episode, evenly spaced from its start to success, or to its end.

    Returns:
        (N, C·H, W, 3) uint8, the C cameras below each other.
    """
    success = dataset.hf_dataset.with_format("numpy")["next.success"][:].reshape(-1)
    end = len(success)
    if success.any():
        end = min(int(success.argmax()) + 2, end)  # success shows in the frame after its row
    rows = [dataset[int(index)] for index in evenly_spaced(end, FRAMES)]
    coloured = [name for name in dataset.meta.camera_keys if name not in dataset.meta.depth_keys]
    cameras = [np.stack([as_bytes(row[name].numpy()) for row in rows]) for name in coloured]
    return np.concatenate(cameras, 2).transpose(0, 2, 3, 1)


def as_bytes(image: np.ndarray) -> np.ndarray:
    """Return an image as uint8; LeRobot reads stored images, unlike videos, as floats in [0, 1]."""
    return image if image.dtype == np.uint8 else (255 * image).round().astype(np.uint8)


DEPTH = "- `observation.images.<camera>_depth`: LeRobot depth maps, millimetres along the camera's axis.\n"

CARD = """---
license: apache-2.0
task_categories: [robotics]
tags: [LeRobot, ManiSkill, panda]
configs:
- config_name: default
  data_files: data/*/*.parquet
---
{title}

ManiSkill trajectories recorded by `lerobot-wmrl-record`: {episodes} episodes, {frames} frames
({minutes:.1f} minutes at {fps} Hz).

{success}

An episode is successful if success holds in any of its rows. The kind says how its actions were made:

{meanings}

{pictures}

## Load it

With pictures, as a [LeRobot](https://github.com/huggingface/lerobot) dataset:

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("{name}")  # of a copy on disk: root="its folder"
```

The columns without pictures:

```python
import datasets

rows = datasets.load_dataset("{name}", split="train")
```

## Scenes

Those with split `ind` may be trained on; those with `ood` are held out.

{scenes}

## Columns

- {cameras}: pictures of {size}x{size} pixels.
{depth}- `observation.state`: TCP position (m), TCP quaternion (wxyz), gripper opening in [0, 1].
- `action`: commanded TCP delta (m), rotation (rad) in base axes, gripper in [-1, 1] (+1 opens), inside the
  box from {low} to {high}.
- `next.done` and `next.success` say whether success holds in the frame the row's action led to; an episode
  goes on {hold} rows after success. A failed episode ends with `next.truncated`.
- `start.task` ({tasks}), `start.scene`, `start.seed` and
  `start.kind` ({kinds}) rebuild an episode's start.

`meta/wmrl.json` holds these vocabularies and the settings of the recording.
"""

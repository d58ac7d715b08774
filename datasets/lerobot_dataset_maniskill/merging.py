"""Finished recordings: sub-datasets and shards put together, and the recognition of what is complete."""

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from lerobot.datasets.aggregate import aggregate_datasets

from lerobot_dataset_maniskill.card import CARD_FILE, success_by_kind, write_card
from lerobot_dataset_maniskill.writer import VOCABULARY_FILE, find_damage, write_vocabulary
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.flags import flag_as_typed
from lerobot_wmrl.common.output_folders import different_settings, require_same
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.maniskill.embodiment import FPS

WHOLE: Final = [0, 1]
"""Value of `shard` for a recording that is not split."""


def merge_folders(folders: Sequence[Path], target: Path, repo_id: str) -> None:
    """Put all episodes of `folders`, in order, into a dataset at `target`, which must not exist."""
    aggregate_datasets(
        repo_ids=[repo_id] * len(folders),
        aggr_repo_id=repo_id,
        roots=list(folders),
        aggr_root=target,
        concatenate_videos=False,
        concatenate_data=False,  # appending rewrites the whole file for every part
    )


def describe(merged: Path, output_dir: Path, repo_id: str, content: Mapping[str, Any]) -> str:
    """Add vocabulary, pictures and card to a dataset that is not in its place yet.

    Args:
        merged: the dataset.
        output_dir: where it is to be.
        repo_id: its name.
        content: the settings that decide its episodes, written into its vocabulary.

    Returns:
        What was recorded, how often each kind succeeded, and the next command.
    """
    write_vocabulary(merged, content)
    table = read_episodes(open_dataset(merged))
    write_card(merged, repo_id, table)
    frames = int(table.length.sum())
    rates = (f"{kind} {wins}/{total}" for kind, (wins, total) in success_by_kind(table).items())
    command = "lerobot-wmrl-train-world-model --model.type=frame_tokenizer"
    return (
        f"{output_dir}: {len(table.length)} episodes, {frames} frames ({frames / FPS / 60:.1f} minutes)\n"
        f"successful: {', '.join(rates)}\n"
        f"the card with pictures: {output_dir / CARD_FILE}\n"
        f"next: {command} {flag_as_typed('dataset.root', output_dir)} --output_dir=outputs/frame_tokenizer"
    )


def already_recorded(
    output_dir: Path, settings: Mapping[str, Any] | None, content: Mapping[str, Any], episodes: int
) -> bool:
    """Whether `output_dir` holds exactly this recording. Raises FieldError if it holds anything else.

    Args:
        output_dir: where the dataset is to be.
        settings: the settings stored in the dataset at `output_dir`; None if it stores none.
        content: the settings of this recording.
        episodes: how many it is to have.
    """
    if not output_dir.exists() or (output_dir.is_dir() and not any(output_dir.iterdir())):
        return False
    if settings is None:
        raise FieldError("output_dir", output_dir, "holds something else", "choose a new folder")
    require_same(output_dir, settings, content)
    if problem := find_damage(output_dir, episodes):
        raise FieldError("output_dir", output_dir, problem, "remove the folder and record again")
    print(f"{output_dir} is already recorded: {episodes} episodes")
    return True


def merge_shards(shards: Sequence[Path], output_dir: Path, repo_id: str) -> None:
    """Merge the recordings with `shard` 0/n … n-1/n into one dataset, or report that it is complete.

    Args:
        shards: folders of all shards, in any order.
        output_dir: where the dataset is to be.
        repo_id: its name.

    Raises:
        FieldError: if they are no such set, or if `output_dir` holds anything else.
    """
    contents = [read_content(shard) for shard in shards]
    check_set(shards, contents)
    content = {**contents[0], "shard": WHOLE}
    if already_recorded(output_dir, recorded_settings(output_dir), content, content["num_episodes"]):
        return
    order = sorted(range(len(shards)), key=lambda index: contents[index]["shard"][0])
    merged = output_dir.with_name(f".{output_dir.name}.merging")
    shutil.rmtree(merged, ignore_errors=True)
    merge_folders([shards[index] for index in order], merged, repo_id)
    problem = find_damage(merged, content["num_episodes"])
    if problem:
        raise FieldError("merge_shards", _listed(shards), problem, "record the incomplete shards again")
    report = describe(merged, output_dir, repo_id, content)
    merged.replace(output_dir)
    print(report)


def recorded_settings(root: Path) -> dict[str, Any] | None:
    """Return the settings that a dataset was recorded with; None if the recorder did not make it."""
    vocabulary = root / VOCABULARY_FILE
    return json.loads(vocabulary.read_text())["recording"] if vocabulary.is_file() else None


def read_content(shard: Path) -> dict[str, Any]:
    """Return the settings that a shard was recorded with. Raises FieldError if it is no recording."""
    settings = recorded_settings(shard)
    if settings is None:
        problem = f"is no finished recording ({VOCABULARY_FILE} is missing)"
        raise FieldError("merge_shards", shard, problem, "give the folders of finished shards")
    return settings


def check_set(shards: Sequence[Path], contents: Sequence[Mapping[str, Any]]) -> None:
    """Raise FieldError for a shard of another recording, one that occurs twice, or one that is missing."""
    if not shards:
        raise FieldError("merge_shards", "[]", "give the folders of all shards")
    first, *_ = contents
    for shard, content in zip(shards, contents, strict=True):
        differing = different_settings(first, content, ("shard",))
        if differing or content["shard"][1] != first["shard"][1]:
            raise FieldError(
                "merge_shards",
                shard,
                f"belongs to another recording than {shards[0]} "
                f"({'; '.join(differing) or 'another number of shards'})",
            )
    count, numbers = first["shard"][1], [content["shard"][0] for content in contents]
    twice = sorted({number for number in numbers if numbers.count(number) > 1})
    missing = sorted(set(range(count)) - set(numbers))
    if twice or missing:
        named = [
            f"{what} {', '.join(f'{number}/{count}' for number in which)}"
            for what, which in (("twice:", twice), ("missing:", missing))
            if which
        ]
        raise FieldError("merge_shards", _listed(shards), "; ".join(named), "give each shard once")


def _listed(folders: Sequence[Path]) -> str:
    return f"[{','.join(map(str, folders))}]"

"""Shards of one recording, made apart, put together: every one of them once."""

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_dataset_maniskill.integrity import whole_dataset
from lerobot_dataset_maniskill.merging import finish, merge_folders
from lerobot_dataset_maniskill.recorder import already_recorded
from lerobot_dataset_maniskill.writer import VOCABULARY_FILE

WHOLE = [0, 1]
"""`shard` of a recording that is not a shard."""


def merge_shards(shards: Sequence[Path], output_dir: Path, repo_id: str) -> None:
    """One dataset from the recordings `--shard=0/n` … `--shard=n-1/n`. Complete already: says so.

    ValueError if they are no such set, or if `output_dir` holds anything else.
    """
    contents = [recorded(shard) for shard in shards]
    check_set(shards, contents)
    content = {**contents[0], "shard": WHOLE}
    if already_recorded(output_dir, content, content["num_episodes"]):
        return
    order = sorted(range(len(shards)), key=lambda index: contents[index]["shard"][0])
    merged = output_dir.with_name(f".{output_dir.name}.merging")
    shutil.rmtree(merged, ignore_errors=True)
    merge_folders([shards[index] for index in order], merged, repo_id)
    problem = whole_dataset(merged, content["num_episodes"])
    if problem:
        raise ValueError(f"--merge_shards: {problem}; are all shards whole?")
    finish(merged, output_dir, repo_id, content)


def recorded(shard: Path) -> dict[str, Any]:
    """What the shard says it holds. ValueError if it is no recording."""
    vocabulary = shard / VOCABULARY_FILE
    if not vocabulary.is_file():
        raise ValueError(f"--merge_shards: {shard} is no finished recording ({VOCABULARY_FILE} is missing)")
    return json.loads(vocabulary.read_text())["recording"]


def check_set(shards: Sequence[Path], contents: Sequence[Mapping[str, Any]]) -> None:
    """ValueError names a shard of another recording, one that occurs twice, or one that is missing."""
    if not shards:
        raise ValueError("--merge_shards: give the folders of all shards")
    first = contents[0]
    for shard, content in zip(shards, contents, strict=True):
        differing = [key for key in first if key != "shard" and content.get(key) != first[key]]
        if differing or content["shard"][1] != first["shard"][1]:
            raise ValueError(
                f"--merge_shards: {shard} is of another recording than {shards[0]} "
                f"({', '.join(differing) or 'number of shards'} differ)"
            )
    count, numbers = first["shard"][1], [content["shard"][0] for content in contents]
    twice = sorted({number for number in numbers if numbers.count(number) > 1})
    missing = sorted(set(range(count)) - set(numbers))
    if twice or missing:
        named = [f"{what} {', '.join(f'{number}/{count}' for number in which)}"
                 for what, which in (("twice:", twice), ("missing:", missing)) if which]  # fmt: skip
        raise ValueError(f"--merge_shards: {'; '.join(named)}; give each shard once")

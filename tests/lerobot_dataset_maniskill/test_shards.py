"""Shards put together are the whole recording; what is no set of shards is refused."""

from pathlib import Path

import numpy as np
import pytest

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.manifest import planned_parts
from lerobot_dataset_maniskill.merging import check_set, merge_shards
from lerobot_wmrl.common.constants import START_SEED
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from tests.lerobot_dataset_maniskill.made_up import ROWS, record_made_up

NAMES = [Path("a"), Path("b"), Path("c")]


def config(shard: str) -> RecordConfig:
    return RecordConfig(output_dir=Path("nowhere"), num_episodes=55, part_episodes=10, shard=shard)


def contents(*shards: tuple[int, int], **changed: object) -> list[dict[str, object]]:
    described = [{"seed": 0, "shard": list(shard)} for shard in shards]
    described[-1] |= changed
    return described


def test_shards_are_disjoint_and_together_the_whole() -> None:
    whole = planned_parts(config("0/1"))
    shards = [planned_parts(config(f"{index}/3")) for index in range(3)]
    assert [part for shard in shards for part in shard] == whole
    assert {len(shard) for shard in shards} <= {len(whole) // len(shards), len(whole) // len(shards) + 1}


@pytest.mark.parametrize("shard", ["3/3", "1", "a/b", "-1/2", "1/0"])
def test_what_is_no_shard_is_named(shard: str) -> None:
    with pytest.raises(ValueError, match=f"shard={shard}: must be i/n"):
        config(shard).validate()


def test_more_shards_than_work_are_refused() -> None:
    with pytest.raises(ValueError, match="fewer sub-datasets than shards"):
        config("0/7").validate()


def test_a_complete_set_may_come_in_any_order() -> None:
    check_set(NAMES, contents((2, 3), (0, 3), (1, 3)))


@pytest.mark.parametrize(
    ("described", "message"),
    [
        (contents((0, 3), (1, 3)), "missing: 2/3"),
        (contents((0, 3), (1, 3), (1, 3)), "twice: 1/3; missing: 2/3"),
        (contents((0, 2), (1, 2), seed=7), r"b: belongs to another recording than a \(seed 0 → 7\)"),
        (contents((0, 2), (1, 3)), r"b: belongs to another recording than a \(another number of shards\)"),
    ],
)
def test_what_is_no_set_is_named(described: list[dict[str, object]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_set(NAMES[: len(described)], described)


def test_merged_shards_are_the_whole_and_merged_again_say_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shards = [tmp_path / f"shard-{index}" for index in range(2)]
    for index, shard in enumerate(shards):
        record_made_up(
            RecordConfig(output_dir=shard, num_episodes=5, part_episodes=2, shard=f"{index}/2", seed=7)
        )
    merge_shards(shards, tmp_path / "whole", "local/whole")
    assert read_episodes(open_dataset(tmp_path / "whole")).columns[START_SEED].tolist() == list(range(7, 12))
    rewards = open_dataset(tmp_path / "whole").hf_dataset.with_format("numpy")["next.reward"]
    np.testing.assert_allclose(np.ravel(rewards)[:ROWS], np.arange(1, ROWS + 1) / ROWS, rtol=1e-6)
    capsys.readouterr()
    merge_shards(shards, tmp_path / "whole", "local/whole")
    assert "is already recorded: 5 episodes" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"shard-1: was begun with other settings"):
        merge_shards(shards, shards[1], "local/whole")

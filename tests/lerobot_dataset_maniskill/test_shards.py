"""Shards put together are the whole recording; what is no set of shards is refused."""

import queue
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.manifest import EpisodePlan, planned_parts
from lerobot_dataset_maniskill.merging import check_set, merge_shards
from lerobot_dataset_maniskill.record import run
from lerobot_dataset_maniskill.writer import StartColumns, StepResult, add_step, create_dataset, find_damage
from lerobot_wmrl.common.constants import START_SEED
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.maniskill.episode import Frame
from lerobot_wmrl.maniskill.scenes import SCENES
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


def test_folders_behind_links_are_filled(tmp_path: Path) -> None:
    """Also on another disk: what is unfinished stands beside what the link leads to."""
    for name in ("shard", "whole"):
        (tmp_path / "disk" / name).mkdir(parents=True)
        (tmp_path / name).symlink_to(tmp_path / "disk" / name)
    shard = RecordConfig(output_dir=tmp_path / "shard", num_episodes=2, part_episodes=2, seed=7)
    assert (shard.root, shard.dataset_id) == (tmp_path / "disk" / "shard", "local/shard")
    record_made_up(shard)
    run(RecordConfig(output_dir=tmp_path / "whole", merge_shards=[tmp_path / "shard"]))
    for name in ("shard", "whole"):
        assert (tmp_path / name).is_symlink()
        assert len(read_episodes(open_dataset(tmp_path / "disk" / name)).length) == 2


def test_no_frame_is_dropped_while_the_encoder_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot drops frames where its queue stays full for a tenth of a second."""

    class SlowToBegin(queue.Queue):  # type: ignore[type-arg]
        def get(self, block: bool = True, timeout: float | None = None) -> Any:
            first = super().get(block, timeout)
            time.sleep(0 if hasattr(self, "begun") else 0.5)
            self.begun = True
            return first

    monkeypatch.setattr(queue, "Queue", SlowToBegin)
    dataset = create_dataset(tmp_path / "data", "local/data", ["third_view"], 32)
    start = StartColumns("push it", 0, EpisodePlan("push", "optimal", SCENES[0], 0))
    images = {"third_view": np.zeros((32, 32, 3), np.uint8)}
    frame = Frame(images, {}, np.zeros(8, np.float32), 0, success=False)
    for _ in range(40):
        add_step(dataset, start, frame, np.zeros(7), StepResult(frame, truncated=False))
    dataset.save_episode()
    dataset.finalize()
    assert find_damage(tmp_path / "data", 1) is None


def test_a_disk_that_is_mounted_is_no_output(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "is_mount", lambda path: path.name == "nowhere")
    with pytest.raises(ValueError, match=r"^output_dir=nowhere: a disk is mounted there"):
        config("0/1").validate()


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

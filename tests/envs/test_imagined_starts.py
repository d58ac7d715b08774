"""Where imagined episodes begin."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.constants import TASK_NAMES
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.envs.start_frames import branch_frames
from lerobot_wmrl.envs.world_model_env import load_spread_starts
from tests.envs.imagination import IMAGE, STATE, B, always_done


def test_starts_can_be_chosen_by_task_and_scene(config):
    def count(**chosen) -> int:
        env = replace(config, dataset=replace(config.dataset, **chosen)).create_tensor_env(1)
        return len(env.starts)

    assert count() == 6
    assert count(scenes=[1], tasks=[TASK_NAMES[0]]) == 3
    assert count(split="train,ind", scenes=[0]) == 3
    assert count(episodes=[4, 0, 5]) == 3
    with pytest.raises(ValueError, match=r"^dataset\.episodes=\[9\]: there is no episode 9"):
        count(episodes=[9])
    with pytest.raises(ValueError, match=r"^dataset\.scenes=\[7\]: no episode"):
        count(scenes=[7])
    with pytest.raises(ValueError, match=rf"^dataset\.tasks=\['{TASK_NAMES[1]}'\]: no episode"):
        count(tasks=[TASK_NAMES[1]])
    with pytest.raises(ValueError, match=r"^dataset\.tasks=\['fly'\]: choose from"):
        count(tasks=["fly"])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"frames": Path("starts.npz"), "tasks": [TASK_NAMES[0]]}, "saved frames do not say their task"),
        (
            {"frames": Path("starts.npz"), "split": "ood"},
            "saved frames do not say their task, scene or split",
        ),
        ({"resets": 2, "split": "validation,ood"}, r"split=validation,ood: .*ManiSkill.* ind or ood"),
        ({"resets": -1}, r"^dataset\.resets=-1: must be at least 1"),
        ({"resets": 2, "branches": 1}, r"^dataset\.branches=1: .*; saved frames and resets are first frames"),
        (
            {"root": "data", "branches": -1},
            r"^dataset\.branches=-1: .* branch off from episodes of a dataset",
        ),
        (
            {"root": "data", "branches": 9, "max_starts": 9},
            r"^dataset\.branches=9: .* more than the 9 starts",
        ),
        ({"resets": 2, "episodes": [1]}, r"^dataset\.episodes=\[1\]: .*leave it out"),
    ],
)
def test_what_starts_cannot_be_chosen_by_is_refused(config, given, message):
    """Rather than ignored."""
    with pytest.raises(ValueError, match=message):
        replace(config, dataset=StartFrames(**given)).create_tensor_env(1)


def test_episodes_begin_in_saved_frames_as_in_those_of_the_dataset(config, env, small_dataset, tmp_path):
    """The same frames, saved by hand; and a file that lacks something, or has it in another shape."""
    rows = [small_dataset[int(row)] for row in small_dataset.meta.episodes["dataset_from_index"]]
    whole = {
        IMAGE: np.stack([(255 * row[IMAGE]).round().byte().permute(1, 2, 0).numpy() for row in rows]),
        STATE: np.stack([row[STATE].numpy() for row in rows]),
        "task": np.array([row["task"] for row in rows]),
    }
    path = tmp_path / "starts.npz"
    saved = replace(config, dataset=StartFrames(frames=path, max_starts=4))
    np.savez(path, **whole)
    found, spread = saved.create_tensor_env(2).starts, [0, 2, 3, 5]
    assert torch.equal(found.frames.tokens, env.starts.frames.tokens[spread])
    assert torch.equal(found.frames.state, env.starts.frames.state[spread])
    assert found.instructions == [env.starts.instructions[row] for row in spread]
    for name, value in (
        (IMAGE, whole[IMAGE][:, :16]),
        (STATE, whole[STATE][:, :3]),
        ("task", whole["task"][:3]),
        ("task", np.array("push")),
        (STATE, whole[STATE][:5]),
    ):
        np.savez(path, **{**whole, name: value})
        with pytest.raises(ValueError, match=rf"^dataset\.frames=.*needs {name} of shape \(6,"):
            saved.create_tensor_env(2)
    np.savez(path, **{**whole, "task": np.array([text.encode() for text in whole["task"]])})
    with pytest.raises(
        ValueError, match=r"^dataset\.frames=.*task is \|S\d+, it must be text; save an array of"
    ):
        saved.create_tensor_env(2)
    np.savez(path, **{name: value[:0] for name, value in whole.items()})
    with pytest.raises(ValueError, match=rf"needs {IMAGE} of shape \('K', 32, 32, 3\), has \(0,"):
        saved.create_tensor_env(2)
    np.savez(path, **{**whole, STATE: whole[STATE] * np.nan})
    with pytest.raises(ValueError, match=rf"^dataset\.frames=.*{STATE} contains NaN"):
        saved.create_tensor_env(2)
    np.savez(path, **whole)
    cut = path.read_bytes()[: path.stat().st_size // 2]
    with (tmp_path / "one.npy").open("wb") as file:
        np.save(file, np.zeros(3))
    for content in (b"no frames", b"", cut, (tmp_path / "one.npy").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"cannot be read.*numpy\.savez"):
            saved.create_tensor_env(2)
    with pytest.raises(ValueError, match="starts are given by a dataset and frames; give one"):
        replace(config, dataset=replace(config.dataset, frames=path)).create_tensor_env(2)


def test_success_is_counted_from_starts_all_over_the_dataset(env):
    starts = load_spread_starts(env.model, env.config.dataset, 3)
    assert torch.equal(starts.images, env.starts.images[[0, 2, 5]])
    assert len(load_spread_starts(env.model, env.config.dataset, 50)) == 6, "none twice"


def test_instructions_are_those_of_the_starts(env):
    """Of an episode that ended, and of the one after it."""
    env.starts.instructions[:] = [f"task {row}" for row in range(len(env.starts))]

    def expected() -> list[str]:
        return [f"task {row}" for row in env._start_index.tolist()]

    observation, _ = env.reset(seed=list(range(B)))
    assert observation["task"] == expected()
    always_done(env, torch.tensor([True, False, False, True]))
    for _ in range(3):
        before = expected()
        observation, *_, info = env.step(torch.zeros(B, 7))
    assert info["final_obs"]["task"] == before
    assert observation["task"] == expected() != before


def test_starts_in_a_row_are_first_and_later_frames_alike(small_dataset: LeRobotDataset) -> None:
    """Each episode's first frame, then those of its branches: before its success, none twice."""
    table = read_episodes(small_dataset)
    table.done[:] = False
    table.done[table.start[1] + 2] = True
    rows = branch_frames(table, np.array([0, 1]), branches=1)
    first, second = table.start[:2]
    assert rows.tolist() == [first, first + (table.length[0] - 1) // 2, second, second + 1]
    table.done[second + 1] = True
    assert branch_frames(table, np.array([1]), branches=1).tolist() == [second]


def test_with_branches_any_starts_in_a_row_are_of_episodes_all_over_the_dataset() -> None:
    """A comparison takes some in a row."""
    length = np.full(300, 20)
    table: Any = SimpleNamespace(
        start=np.cumsum(length) - length, length=length, success_target=np.zeros(length.sum(), bool)
    )
    for begun in (0, 100, 411):
        episodes = branch_frames(table, np.arange(300), branches=1)[begun : begun + 60] // 20
        assert np.histogram(episodes, 5, (0, 300))[0].min() >= 9, "of 12 if they were spread exactly"

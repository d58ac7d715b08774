"""The one definition of success, and starts that a seed rebuilds."""

import numpy as np
import pytest

from lerobot_wmrl.maniskill.scenes import SCENES
from lerobot_wmrl.maniskill.tasks import Push, Situation, task_of

HEIGHT = 0.03


def situation(
    dx: float, dy: float, z: float = HEIGHT, tcp: tuple[float, ...] = (-0.04, 0.0, 0.03)
) -> Situation:
    start = np.array([0.01, -0.02, HEIGHT])
    return Situation(start, start + np.array([dx, dy, z - HEIGHT]), start + np.array(tcp), HEIGHT)


@pytest.mark.parametrize(
    ("dx", "dy", "z", "success"),
    [
        (0.101, 0.0, HEIGHT, True),
        (0.099, 0.0, HEIGHT, False),
        (0.12, 0.049, HEIGHT, True),
        (0.12, -0.051, HEIGHT, False),
        (-0.12, 0.0, HEIGHT, False),
        (0.12, 0.0, -0.2, False),
    ],
)
def test_success_is_ten_centimetres_forward_and_at_most_five_sideways(
    dx: float, dy: float, z: float, success: bool
) -> None:
    assert Push().success(situation(dx, dy, z)) is success


def test_the_reward_rises_along_a_push_and_is_one_on_success() -> None:
    task = Push()
    approach = [
        task.reward(situation(0.0, 0.0, tcp=(-distance, 0.0, 0.03))) for distance in (0.15, 0.08, 0.03)
    ]
    push = [task.reward(situation(dx, 0.0, tcp=(dx - 0.03, 0.0, 0.0))) for dx in (0.02, 0.05, 0.09, 0.11)]
    rewards = approach + push
    assert rewards == sorted(rewards)
    assert min(rewards) >= 0.0
    assert push[-1] == 1.0
    assert max(rewards[:-1]) < 1.0


def test_pushing_past_the_side_limit_pays_no_progress() -> None:
    task = Push()
    assert task.reward(situation(0.09, 0.08)) < task.reward(situation(0.05, 0.0))


def test_a_seed_rebuilds_its_start_and_another_does_not() -> None:
    task, scene = Push(), SCENES[0]
    first, again, other = (task.start(scene, "yellow sponge", seed) for seed in (5, 5, 6))
    assert np.array_equal(first.tcp, again.tcp)
    assert np.array_equal(first.object_xy, again.object_xy)
    assert first.instruction == again.instruction
    assert "yellow sponge" in first.instruction
    assert not np.array_equal(first.tcp, other.tcp)


def test_the_gripper_starts_behind_the_object() -> None:
    for seed in range(200):
        start = Push().start(SCENES[1], "tomato can", seed)
        behind = start.object_xy - start.tcp[:2]
        assert 0.08 <= behind[0] <= 0.16
        assert abs(behind[1]) <= 0.08


def test_an_unknown_task_is_named() -> None:
    with pytest.raises(ValueError, match="task='juggle' is unknown; choose one of push"):
        task_of("juggle")

"""The one definition of success, and starts that a seed rebuilds."""

from dataclasses import replace

import numpy as np
import pytest

from lerobot_wmrl.maniskill.objects import CONTAINERS, OBJECTS
from lerobot_wmrl.maniskill.scenes import SCENES
from lerobot_wmrl.maniskill.tasks import TASKS, MoveToAim, PickPlace, Pull, Push, Situation, Task, task_of

SPEC, BOWL = OBJECTS["blue_box"], CONTAINERS["bowl"]
HEIGHT = SPEC.half_size[2]


def at_start(task: Task, seed: int = 0) -> Situation:
    """Nothing has happened yet."""
    start = task.start(SCENES[2], seed)
    place = np.array([*start.object_xy, HEIGHT])
    return Situation(start, SPEC, BOWL, place, place, start.tcp, float(start.gripper_open))


def moved(situation: Situation, by: tuple[float, ...], tcp: tuple[float, ...] = (-0.04, 0, 0)) -> Situation:
    """The object moved `by`, the gripper at `tcp` from it, both (3,)."""
    now = situation.object_start + np.array(by)
    return replace(situation, object_now=now, tcp=now + np.array(tcp))


@pytest.mark.parametrize(
    ("dx", "dy", "dz", "success"),
    [
        (0.101, 0.0, 0.0, True),
        (0.099, 0.0, 0.0, False),
        (0.12, 0.049, 0.0, True),
        (0.12, -0.051, 0.0, False),
        (-0.12, 0.0, 0.0, False),
        (0.12, 0.0, -0.2, False),
        (0.12, 0.0, 0.1, False),
    ],
)
@pytest.mark.parametrize(("task", "sign"), [(Push(), 1), (Pull(), -1)])
def test_a_slide_is_ten_centimetres_along_and_at_most_five_sideways(
    task: Task, sign: int, dx: float, dy: float, dz: float, success: bool
) -> None:
    assert task.success(moved(at_start(task), (sign * dx, dy, dz))) is success


@pytest.mark.parametrize(
    ("change", "success"),
    [
        ({}, True),
        ({"gripper_opening": 0.3}, False),
        ({"object_speed": 0.2}, False),
    ],
)
def test_placed_is_inside_let_go_and_at_rest(change: dict[str, float], success: bool) -> None:
    before = at_start(PickPlace())
    inside = np.array([*before.start.container_xy, HEIGHT + 0.008])
    placed = replace(before, object_now=inside, gripper_opening=1.0)
    assert PickPlace().success(replace(placed, **change)) is success


@pytest.mark.parametrize("off", [(0.05, 0.0, 0.0), (0.0, -0.05, 0.0), (0.0, 0.0, 0.06)])
def test_beside_or_above_the_container_is_not_in_it(off: tuple[float, ...]) -> None:
    before = at_start(PickPlace())
    place = np.array([*before.start.container_xy, HEIGHT + 0.008]) + off
    assert not PickPlace().success(replace(before, object_now=place, gripper_opening=1.0))


@pytest.mark.parametrize(
    ("off", "speed", "success"),
    [
        (0.029, 0.0, True),
        (0.031, 0.0, False),
        (0.0, 0.1, False),
    ],
)
def test_at_its_aim_is_within_three_centimetres_and_at_rest(off: float, speed: float, success: bool) -> None:
    before = at_start(MoveToAim())
    assert before.start.carpet_xy is not None
    place = np.array([before.start.carpet_xy[0] + off, before.start.carpet_xy[1], HEIGHT])
    assert MoveToAim().success(replace(before, object_now=place, object_speed=speed)) is success


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_nothing_succeeds_at_its_start_and_the_reward_knows(task: Task) -> None:
    for seed in range(50):
        situation = at_start(task, seed)
        assert not task.success(situation)
        assert 0.0 <= task.reward(situation) < 0.4


def test_the_reward_rises_along_a_push_and_is_one_on_success() -> None:
    task, before = Push(), at_start(Push())
    approach = [task.reward(moved(before, (0, 0, 0), (-gap, 0, 0))) for gap in (0.15, 0.08, 0.03)]
    push = [task.reward(moved(before, (dx, 0, 0), (-0.03, 0, 0))) for dx in (0.02, 0.05, 0.09, 0.11)]
    rewards = approach + push
    assert rewards == sorted(rewards)
    assert push[-1] == 1.0
    assert max(rewards[:-1]) < 1.0


def test_pushing_past_the_side_limit_pays_no_progress() -> None:
    task, before = Push(), at_start(Push())
    assert task.reward(moved(before, (0.09, 0.08, 0))) < task.reward(moved(before, (0.05, 0, 0)))


def test_the_reward_rises_from_lifting_to_carrying_to_placing() -> None:
    task, before = PickPlace(), at_start(PickPlace())
    way = before.start.container_xy - before.object_start[:2]
    steps = [(0, 0, 0.04), (0, 0, 0.08), (*(0.5 * way), 0.08), (*way, 0.08), (*way, 0.008)]
    rewards = [task.reward(moved(before, step, (0, 0, 0))) for step in steps]
    assert rewards == sorted(rewards)
    assert rewards[-1] == 1.0 or rewards[-1] > rewards[-2]


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_a_seed_rebuilds_its_start_and_another_does_not(task: Task) -> None:
    first, again, other = (task.start(SCENES[0], seed) for seed in (5, 5, 6))
    assert np.array_equal(first.tcp, again.tcp)
    assert np.array_equal(first.object_xy, again.object_xy)
    assert first.instruction == again.instruction
    assert "yellow sponge" in first.instruction
    assert not np.array_equal(first.tcp, other.tcp)


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_object_starts_clear_of_the_container(task: Task) -> None:
    widest = max(max(spec.half_size[:2]) for spec in OBJECTS.values())
    for seed in range(200):
        start = task.start(SCENES[1], seed)
        assert np.linalg.norm(start.container_xy - start.object_xy) > 0.06 + widest


def test_an_unknown_task_is_named() -> None:
    with pytest.raises(ValueError, match="task=juggle: unknown; choose one of push"):
        task_of("juggle")

"""Plans, without the simulator: the arm is replaced by one that achieves a third of each command."""

import numpy as np
import pytest

from lerobot_dataset_maniskill.planner import (
    FINGER_HALF_THICKNESS,
    NEAR_MISSES,
    OPTIMAL_SPEED,
    SUBOPTIMAL,
    Follower,
    Noise,
    PushGeometry,
    pass_over,
    plan_push,
    push_off_centre,
    push_partly,
    stop_short,
)
from lerobot_wmrl.constants import ACTION_HIGH, ACTION_LOW, KINDS
from lerobot_wmrl.maniskill.objects import OBJECTS
from lerobot_wmrl.maniskill.scenes import SCENES
from lerobot_wmrl.maniskill.tasks import Push, Start

SPEC = OBJECTS["blue_box"]
LAG = 1 / 3


def start(seed: int) -> Start:
    return Push().start(SCENES[2], "blue box", seed)


def follow(kind: str, seed: int, steps: int = Push.horizon) -> tuple[np.ndarray, np.ndarray]:
    """TCP path (steps + 1, 3) and actions (steps, 7) of a kinematic arm."""
    rng = np.random.default_rng(seed)
    follower, tcp = Follower(plan_push(kind, SPEC, start(seed), rng), rng), start(seed).tcp.copy()
    path, actions = [tcp], []
    for _ in range(steps):
        actions.append(follower.act(path[-1]))
        path.append(path[-1] + LAG * actions[-1][:3])
    return np.array(path), np.array(actions)


def test_every_kind_but_policy_has_a_planner() -> None:
    assert {"optimal", *SUBOPTIMAL} == set(KINDS) - {"policy"}


@pytest.mark.parametrize("kind", ["optimal", *SUBOPTIMAL])
def test_actions_stay_in_the_box_and_repeat_for_a_seed(kind: str) -> None:
    for seed in range(10):
        _, actions = follow(kind, seed)
        assert actions.dtype == np.float32
        assert np.all(actions >= np.float32(ACTION_LOW))
        assert np.all(actions <= np.float32(ACTION_HIGH))
        assert np.array_equal(actions, follow(kind, seed)[1])


def test_an_optimal_plan_goes_behind_the_object_and_then_straight_through_its_place() -> None:
    for seed in range(20):
        path, actions = follow("optimal", seed)
        x, y = start(seed).object_xy
        contact = np.flatnonzero(path[:, 0] > x - SPEC.half_size[0])[0]
        assert abs(path[contact, 1] - y) < 0.015
        assert path[contact, 2] < 1.5 * SPEC.half_size[2]
        assert path[-1, 0] > x + Push.distance - SPEC.half_size[0] - 0.02
        assert not actions[:, 3:6].any()


def test_near_misses_come_in_all_forms_around_the_push() -> None:
    geometry = PushGeometry(SPEC, start(0))
    rng = np.random.default_rng(0)
    assert len(set(NEAR_MISSES)) == 6
    edge = SPEC.half_size[1] + FINGER_HALF_THICKNESS
    offsets = [push_off_centre(geometry, rng)[-1].position[1] - geometry.at(0.0)[1] for _ in range(100)]
    assert np.abs(offsets).max() <= edge
    assert min(offsets) < -0.7 * edge
    assert max(offsets) > 0.7 * edge
    for _ in range(50):
        over = pass_over(geometry, rng)
        assert min(w.position[2] for w in over) > 2 * SPEC.half_size[2] - 0.01
        assert all(w.position[0] < geometry.at(0.0)[0] for w in stop_short(geometry, rng))
        assert push_partly(geometry, rng)[-1].position[0] < geometry.at(Push.distance)[0]


def test_suboptimal_actions_differ_in_how_noisy_they_are() -> None:
    sigmas = [
        plan_push("near_miss", SPEC, start(seed), np.random.default_rng(seed)).noise.position
        for seed in range(30)
    ]
    assert min(sigmas) < 0.003
    assert max(sigmas) > 0.012


def test_calm_motion_does_not_give_success_away() -> None:
    """Episodes that fail are as often as even as those that succeed, or a world model learns the evenness."""
    plans = [plan_push("near_miss", SPEC, start(seed), np.random.default_rng(seed)) for seed in range(200)]
    calm = [plan for plan in plans if plan.noise == Noise() and plan.speed == OPTIMAL_SPEED]
    assert 0.5 < len(calm) / len(plans) < 0.7
    assert plan_push("optimal", SPEC, start(0), np.random.default_rng(0)).speed == OPTIMAL_SPEED

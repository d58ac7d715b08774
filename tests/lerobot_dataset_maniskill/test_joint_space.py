"""What MPLib adds to a plan: paths that can be repeated, around obstacles, and nothing else."""

import logging
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.planners import MOTIONS, PLANNERS, Follower, Motion, Plan
from lerobot_dataset_maniskill.planners.follower import OPTIMAL_SPEED, Waypoint
from lerobot_dataset_maniskill.recorder import record
from lerobot_wmrl.common.constants import KINDS, PLAY
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.maniskill.cameras import Rendering
from lerobot_wmrl.maniskill.objects import CONTAINERS, OBJECTS
from lerobot_wmrl.maniskill.scenes import SCENES
from lerobot_wmrl.maniskill.simulation import Simulation
from lerobot_wmrl.maniskill.tasks import TASKS

SCENE = next(scene for scene in SCENES if scene.container == "bowl")
THINGS = OBJECTS[SCENE.object], CONTAINERS[SCENE.container]

BUILD_A_PLANNER = """
import ctypes, importlib.util, pathlib, sys
from numpy._core._multiarray_umath import _ARRAY_API

address_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)
table = ctypes.cast(address_of(_ARRAY_API, None), ctypes.POINTER(ctypes.c_void_p))
before = table[:300]
import lerobot_dataset_maniskill.planners
assert "mplib" not in sys.modules and table[:300] == before
from lerobot_dataset_maniskill.planners.planning_arm import restore_copy_into
assert "mplib" not in sys.modules and table[:300] == before
restore_copy_into()
after = table[:300]
assert [slot for slot in range(300) if before[slot] != after[slot]] == [82]
assert after[82] == after[50]
restore_copy_into()
assert table[:300] == after

import mplib
package = pathlib.Path(importlib.util.find_spec("mani_skill").origin).parent
panda = str(package / "assets/robots/panda/panda_v2.urdf")
planner = mplib.Planner(panda, move_group="panda_hand_tcp", srdf=panda.replace(".urdf", ".srdf"))
print("joints:", len(planner.move_group_joint_indices))
"""


def test_one_slot_is_filled_and_a_planner_can_be_built_under_numpy_2() -> None:
    """In a process of its own: without that slot it would be killed."""
    done = subprocess.run([sys.executable, "-c", BUILD_A_PLANNER], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "joints: 7\n"), done.stderr


@pytest.fixture(scope="module")
def mplib() -> Motion:
    return MOTIONS["mplib"]()


def plans(motion: Motion, task: str, kind: str, seed: int) -> tuple[Plan, Plan]:
    """The scripted plan of an episode, and what the motion makes of it."""
    start = TASKS[task].start(SCENE, seed)
    scripted = PLANNERS[task](*THINGS, start).plan(kind, np.random.default_rng(seed))
    return scripted, motion(scripted, *THINGS, start)


def places(plan: Plan) -> np.ndarray:
    return np.array([waypoint.position for waypoint in plan.waypoints])


def test_the_same_episode_has_the_same_plan_whatever_was_planned_before(mplib: Motion) -> None:
    episodes = [(task, kind, seed) for task in TASKS for kind in ("optimal", "noisy") for seed in (0, 1)]
    first = {episode: places(plans(mplib, *episode)[1]) for episode in episodes}
    fresh = MOTIONS["mplib"]()
    again = {episode: places(plans(fresh, *episode)[1]) for episode in reversed(episodes)}
    assert all(np.array_equal(first[episode], again[episode]) for episode in episodes)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "policy"])
def test_scripted_waypoints_stay_and_points_lie_close_on_the_way_to_them(mplib: Motion, kind: str) -> None:
    added = 0
    for task in TASKS:
        scripted, planned = plans(mplib, task, kind, seed=1)
        assert (planned.speed, planned.noise) == (scripted.speed, scripted.noise)
        essential, before = list(scripted.waypoints), TASKS[task].start(SCENE, 1).tcp
        for waypoint in planned.waypoints:
            if waypoint is essential[0]:
                essential.pop(0)
            else:
                added += 1
                assert waypoint.gripper == essential[0].gripper
                assert np.linalg.norm(waypoint.position - before) < 0.031
            before = waypoint.position
        assert not essential
    assert added or kind == PLAY


def test_a_waypoint_that_depends_on_the_object_is_approached_straight(mplib: Motion) -> None:
    start = TASKS["push"].start(SCENE, 0)
    high = np.array([*start.object_xy, 0.2])
    plan = Plan((Waypoint(high, aim=lambda thing: thing + 0.1), Waypoint(high, clear=True)))
    assert mplib(plan, *THINGS, start) == plan


def test_where_no_way_leads_the_line_stays_straight(mplib: Motion, caplog: pytest.LogCaptureFixture) -> None:
    start = TASKS["push"].start(SCENE, 0)
    inside, far = np.array([*start.container_xy, 0.03]), np.array([0.9, 0.0, 0.1])
    plan = Plan((Waypoint(inside), Waypoint(far)))
    with caplog.at_level(logging.DEBUG):
        assert mplib(plan, *THINGS, start) == plan
    assert caplog.text.count("unreachable") == 2


@pytest.fixture(scope="module")
def blind() -> Iterator[Simulation]:
    simulation = Simulation(TASKS["push"], [SCENE], Rendering(()))
    yield simulation
    simulation.close()


def left_to_go(simulation: Simulation, motion: Motion, centre: np.ndarray, half: np.ndarray) -> float:
    """Distance (m) from the goal of a way low over the table, from `centre` − `half` to `centre` + `half`."""
    start = simulation.current_start
    here, there = (np.array([*(centre + side * half), 0.03]) for side in (-1, 1))
    above = here + np.array([0.0, 0.0, 0.09])
    plan = Plan(
        (Waypoint(above, 0.01), Waypoint(here, 0.006), Waypoint(there, 0.005, clear=True)), OPTIMAL_SPEED
    )
    follower = Follower(motion(plan, *THINGS, start), np.random.default_rng(0))
    for _ in range(80):
        simulation.step(follower.act(simulation.tcp_position, simulation.object_position))
    return float(np.linalg.norm(simulation.tcp_position - there))


@pytest.mark.parametrize(("planner", "arrives"), [("cartesian", False), ("mplib", True)])
def test_it_leads_over_the_container(blind: Simulation, planner: str, arrives: bool) -> None:
    blind.reset(SCENE, 0)
    centre = blind.current_start.container_xy
    left = left_to_go(blind, MOTIONS[planner](), centre, np.array([0.12, 0.0]))
    assert (left < 0.01) == arrives


@pytest.mark.parametrize(("planner", "moves"), [("cartesian", True), ("mplib", False)])
def test_it_leads_around_the_object(blind: Simulation, planner: str, moves: bool) -> None:
    blind.reset(SCENE, 2)
    before = blind.object_position
    assert left_to_go(blind, MOTIONS[planner](), before[:2], np.array([0.11, 0.02])) < 0.01
    assert (np.linalg.norm(blind.object_position - before) > 0.01) == moves


def test_a_recording_with_it_is_complete_and_another_planner_is_refused(tmp_path: Path) -> None:
    def config(planner: str) -> RecordConfig:
        settings = {"num_episodes": 2, "num_workers": 1, "kinds": {"optimal": 1.0}, "planner": planner}
        return RecordConfig(output_dir=tmp_path / "dataset", **settings)

    record(config("mplib"))
    assert read_episodes(open_dataset(tmp_path / "dataset")).success.tolist() == [True, True]
    with pytest.raises(ValueError, match=r"other settings.*planner 'mplib' → 'cartesian'"):
        record(config("cartesian"))

"""The list of episodes is a function of the configuration alone."""

from collections import Counter
from pathlib import Path

import pytest

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.manifest import planned_kinds, planned_parts
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv


def config(**fields: object) -> RecordConfig:
    return RecordConfig(output_dir=Path("nowhere"), **fields)  # type: ignore[arg-type]


def test_the_same_configuration_plans_the_same_parts() -> None:
    first, again = (planned_parts(config(num_episodes=55, part_episodes=20)) for _ in range(2))
    assert first == again
    assert [len(part.episodes) for part in first] == [20, 20, 15]


def test_seeds_are_consecutive_never_twice_and_never_for_evaluation() -> None:
    seeds = [plan.seed for part in planned_parts(config(num_episodes=90, seed=100)) for plan in part.episodes]
    assert seeds == list(range(100, 190))
    with pytest.raises(ValueError, match="seed="):
        config(seed=EVALUATION_SEED - 10, num_episodes=11).validate()


def test_kinds_have_exactly_their_shares_in_mixed_order() -> None:
    kinds = planned_kinds(config(num_episodes=100, kinds={"optimal": 1.0, "near_miss": 3.0}))
    assert Counter(kinds) == {"optimal": 25, "near_miss": 75}
    assert "optimal" in kinds[:30]
    assert "near_miss" in kinds[:30]


def test_no_held_out_scene_is_recorded_by_default() -> None:
    parts = planned_parts(config(num_episodes=12))
    assert {plan.scene.split for part in parts for plan in part.episodes} == {"ind"}


@pytest.mark.parametrize("scenes", [[0, 1, 2], [0, 1], [0, 1, 2, 5]])
def test_every_task_meets_every_scene_and_a_short_recording_has_every_task(scenes: list[int]) -> None:
    env, tasks = WmrlManiSkillEnv(scenes=scenes), ["push", "pull"]
    parts = planned_parts(config(num_episodes=4 * len(scenes), env=env, tasks=tasks))
    plans = [plan for part in parts for plan in part.episodes]
    assert Counter((plan.task, plan.scene.index) for plan in plans) == {
        (task, scene): 2 for task in tasks for scene in scenes
    }
    assert {plan.task for plan in plans[:2]} == set(tasks)


def test_flags_of_the_process_are_not_those_of_a_configuration_made_in_python(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("sys.argv", ["lerobot-wmrl-train", "--policy.path=outputs/policy"])
    made = config()
    made.validate()
    assert made.policy is None


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"num_episodes": 0}, "num_episodes=0: must be at least 1"),
        ({"num_workers": 0}, "num_workers=0: must be at least 1"),
        ({"kinds": {"perfect": 1.0}}, "kinds="),
        ({"kinds": {"optimal": 0.0}}, "kinds="),
        ({"planner": "rrt"}, "planner=rrt: choose one of cartesian, mplib"),
        ({"env": WmrlManiSkillEnv(task="juggle")}, "task=juggle"),
        ({"tasks": ["push", "juggle"]}, "task=juggle"),
        ({"env": WmrlManiSkillEnv(scenes=[99])}, r"scenes=\[99\]"),
        ({"output_dir": None}, "output_dir=None: missing"),
    ],
)
def test_bad_settings_are_named(fields: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RecordConfig(**{"output_dir": Path("nowhere"), **fields}).validate()

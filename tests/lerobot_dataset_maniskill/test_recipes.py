"""A recipe stands for the flags it holds, and what is wrong in it is named."""

from collections.abc import Callable
from pathlib import Path

import draccus
import pytest

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.manifest import planned_parts
from lerobot_dataset_maniskill.record import expand_recipes, packaged_recipe, recipe_flags

SIZES = ("tiny", "demo", "cpu", "gpu", "paper")


@pytest.fixture
def recipe(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str) -> Path:
        path = tmp_path / "recipe.yaml"
        path.write_text(text)
        return path

    return write


def test_flags_stand_where_the_recipe_stood(recipe: Callable[[str], Path]) -> None:
    path = recipe("num_episodes: 7\nenv: {type: wmrl_maniskill, cameras: [third_view, wrist]}\n")
    expanded = expand_recipes(["--seed=1", f"--recipe={path}", "--num_episodes=9"])
    assert expanded == [
        "--seed=1",
        "--num_episodes=7",
        "--env.type=wmrl_maniskill",
        "--env.cameras=[third_view,wrist]",
        "--num_episodes=9",
    ]


@pytest.mark.parametrize(
    "text",
    [
        "policy: {path: /policy}\nenv: {type: pusht}\nlike: {root: /data}",
        "policy: {type: wm_mpc, horizon: 8}\nenv: {type: world_model, world_model_path: /model}",
    ],
)
def test_a_recipe_may_hold_any_flag_of_the_command(text: str, recipe: Callable[[str], Path]) -> None:
    assert recipe_flags(recipe(text))


@pytest.mark.parametrize("stated", ["", "type: wmrl_maniskill, "])
def test_what_a_recipe_says_of_its_environment_is_left_out_with_another(
    stated: str, recipe: Callable[[str], Path]
) -> None:
    path = recipe(f"tasks: [push, pull]\nenv: {{{stated}image_size: 32}}\nseed: 3\nkinds: {{optimal: 1}}")
    flags = [f"--recipe={path}", "--env.type=pusht"]
    assert expand_recipes(flags) == ["--seed=3", "--env.type=pusht"]
    assert len(expand_recipes([flags[0], "--env.type=wmrl_maniskill"])) == 5 + bool(stated)


@pytest.mark.parametrize("size", SIZES)
def test_every_packaged_recipe_plans_only_what_training_may_see(size: str, tmp_path: Path) -> None:
    arguments = [*expand_recipes([f"--preset={size}"]), f"--output_dir={tmp_path / 'dataset'}"]
    config = draccus.parse(RecordConfig, args=[*arguments, "--num_episodes=512"])
    config.validate()
    plans = [plan for part in planned_parts(config) for plan in part.episodes]
    assert {plan.scene.split for plan in plans} == {"ind"}
    assert {plan.task for plan in plans} == set(config.recorded_tasks)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("num_episode: 3", "the key num_episode is unknown; did you mean num_episodes?"),
        ("env: {camera: [wrist]}", r"the key env\.camera is unknown; did you mean env\.cameras?"),
        ("frobnicate: 1", "the key frobnicate is unknown; choose from"),
        ("- 1", "must hold"),
        ("a: [1", "cannot be read"),
    ],
)
def test_what_is_wrong_is_named(text: str, message: str, recipe: Callable[[str], Path]) -> None:
    with pytest.raises(ValueError, match=message):
        recipe_flags(recipe(text))


def test_an_unknown_size_and_a_missing_file_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--preset=huge: unknown preset; choose one of cpu, demo"):
        packaged_recipe("huge")
    with pytest.raises(ValueError, match=r"nothing\.yaml: cannot be read"):
        recipe_flags(tmp_path / "nothing.yaml")


def test_the_environments_tasks_are_recorded_in_turn(tmp_path: Path) -> None:
    flags = ["--env.type=wmrl_maniskill", "--env.task=push,pull", "--num_episodes=4"]
    config = draccus.parse(RecordConfig, args=[*flags, f"--output_dir={tmp_path / 'dataset'}"])
    config.validate()
    plans = [plan for part in planned_parts(config) for plan in part.episodes]
    assert sorted(plan.task for plan in plans) == ["pull", "pull", "push", "push"]

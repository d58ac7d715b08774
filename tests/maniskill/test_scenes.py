"""Training must not see what is held out."""

import pytest

from lerobot_wmrl.maniskill.scenes import SCENES, describe_scenes, scene_for_seed, scenes_of


def test_the_index_is_the_place_in_the_table() -> None:
    assert [scene.index for scene in SCENES] == list(range(len(SCENES)))


def test_held_out_scenes_are_new_objects_or_new_combinations() -> None:
    seen = scenes_of("ind")
    seen_objects = {scene.object for scene in seen}
    combinations = {(scene.object, scene.container, scene.table) for scene in seen}
    held_out = scenes_of("ood")
    assert not set(seen) & set(held_out)
    assert any(scene.object not in seen_objects for scene in held_out)
    assert any(scene.object in seen_objects for scene in held_out)
    assert all((scene.object, scene.container, scene.table) not in combinations for scene in held_out)


def test_scenes_of_another_split_cannot_be_chosen() -> None:
    held_out = scenes_of("ood")[0].index
    with pytest.raises(ValueError, match="split 'ind' has"):
        scenes_of("ind", [held_out])
    with pytest.raises(ValueError, match="split='test' is unknown"):
        scenes_of("test")


def test_consecutive_seeds_visit_every_scene() -> None:
    scenes = scenes_of("ind")
    visited = [scene_for_seed(scenes, seed) for seed in range(7, 7 + len(scenes))]
    assert {scene.index for scene in visited} == {scene.index for scene in scenes}


def test_the_table_lists_every_scene() -> None:
    assert len(describe_scenes().splitlines()) == len(SCENES) + 1

"""Training must not see what is held out."""

import pytest

from lerobot_wmrl.maniskill.objects import CONTAINERS, OBJECTS, TABLES
from lerobot_wmrl.maniskill.scenes import SCENES, describe_scenes, scene_for_seed, scenes_of


def test_there_are_eighty_scenes_each_once_and_a_fifth_is_held_out() -> None:
    every = {(scene.object, scene.container, scene.table) for scene in SCENES}
    assert len(SCENES) == len(every) == len(OBJECTS) * len(CONTAINERS) * len(TABLES) == 80
    assert len(scenes_of("ood")) == 16


def test_the_index_is_the_place_in_the_table() -> None:
    assert [scene.index for scene in SCENES] == list(range(len(SCENES)))


def test_indices_that_datasets_hold_keep_their_meaning() -> None:
    assert [(s.object, s.container, s.table) for s in SCENES[:7]] == [
        ("sponge", "plate", "wood"),
        ("tomato_can", "bowl", "slate"),
        ("blue_box", "plate", "wood"),
        ("lime", "bowl", "slate"),
        ("tomato_can", "plate", "wood"),
        ("sponge", "plate", "slate"),
        ("sponge", "bowl", "wood"),
    ]


def test_what_is_held_out_never_occurs_in_training() -> None:
    """An unseen object, or a seen object with a seen container that it never stands beside in training."""
    seen, held_out = scenes_of("ind"), scenes_of("ood")
    objects = {scene.object for scene in seen}
    containers = {scene.container for scene in seen}
    together = {(scene.object, scene.container) for scene in seen}
    unseen = [scene for scene in held_out if scene.object not in objects]
    combined = [scene for scene in held_out if scene.object in objects]
    assert len(unseen) == len(combined) == 8
    assert all(scene.container in containers for scene in combined)
    assert not {(scene.object, scene.container) for scene in held_out} & together


def test_scenes_of_another_split_cannot_be_chosen() -> None:
    held_out = scenes_of("ood")[0].index
    with pytest.raises(ValueError, match="split 'ind' has"):
        scenes_of("ind", [held_out])
    with pytest.raises(ValueError, match="split=test: unknown"):
        scenes_of("test")


def test_consecutive_seeds_visit_every_scene() -> None:
    scenes = scenes_of("ind")
    visited = [scene_for_seed(scenes, seed) for seed in range(7, 7 + len(scenes))]
    assert {scene.index for scene in visited} == {scene.index for scene in scenes}


def test_the_table_lists_every_scene() -> None:
    assert len(describe_scenes().splitlines()) == len(SCENES) + 1


def test_every_object_fits_between_the_fingers() -> None:
    assert all(2 * spec.half_size[1] <= 0.07 for spec in OBJECTS.values())

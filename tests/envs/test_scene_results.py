"""The table of successes by scene: counted by real environments, grouped as held-out scenes are."""

import logging

import numpy as np
import pytest

from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.maniskill_env import make_vector_env
from lerobot_wmrl.envs.scene_results import SceneResults
from lerobot_wmrl.maniskill.scenes import SCENES, UNSEEN_OBJECTS


def ended(*episodes: tuple[int, int, bool]) -> dict[str, np.ndarray]:
    """`final_info` of these (seed, scene, success)."""
    columns = zip(*episodes, strict=True)
    return {
        name: np.array(column) for name, column in zip(("seed", "scene", "is_success"), columns, strict=True)
    }


def test_a_seed_counts_once_and_groups_add_up() -> None:
    held_out = [scene for scene in SCENES if scene.split == "ood"]
    unseen = next(scene.index for scene in held_out if scene.object in UNSEEN_OBJECTS)
    combined = next(scene.index for scene in held_out if scene.object not in UNSEEN_OBJECTS)
    results = SceneResults("push")
    results.add(ended((1, unseen, True), (2, combined, False), (3, combined, True)), np.array([True] * 3))
    results.add(ended((3, combined, True), (4, unseen, True)), np.array([True, False]))
    lines = results.table().splitlines()
    assert len(lines) == 5
    for name, counts in (("unseen objects", "1 of 1"), ("unseen combinations", "1 of 2"), ("all", "2 of 3")):
        assert any(line.startswith(name) and counts in line for line in lines)


def test_environments_log_what_they_counted(caplog: pytest.LogCaptureFixture) -> None:
    config = WmrlManiSkillEnv(episode_length=1, split="ood", scenes=[3, 4], image_size=32)
    envs = make_vector_env([config] * 2, use_async_envs=False, freeze=True)
    envs.reset(seed=[EVALUATION_SEED, EVALUATION_SEED + 1])
    envs.step(np.zeros((2, 7), np.float32))
    with caplog.at_level(logging.INFO):
        envs.close()
    assert "3 lime" in caplog.text
    assert "(0 of 2;" in caplog.text

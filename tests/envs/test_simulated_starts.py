"""Imagined episodes that begin in ManiSkill's resets."""

import numpy as np
import pytest

from lerobot_wmrl.common.constants import START_SCENE, START_SEED, TASK_NAMES
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.envs.start_frames import read_start_images
from lerobot_wmrl.maniskill.scenes import SCENES
from lerobot_wmrl.maniskill.tasks import task_of
from lerobot_wmrl.world_models.autoregressive.configuration import AutoregressiveConfig
from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig


def test_they_are_what_the_simulator_shows(recwarn):
    """Two scenes in turn, then the next task."""
    config = ActionWorldModelConfig(
        tokenizer=TokenizerConfig(["side_view", "third_view"], image_size=32), device="cpu"
    )
    source = StartFrames(resets=4, tasks=["push", "pull"], scenes=[0, 2], split="ind")
    found = read_start_images(source, config)
    assert found.images.shape == (4, 2, 32, 32, 3)
    assert found.tasks.tolist() == [TASK_NAMES.index(task) for task in ("push", "push", "pull", "pull")]
    assert found.origins[START_SCENE].tolist() == [0, 2, 0, 2]
    assert found.origins[START_SEED].tolist() == [0, 1, 2, 3]
    env = WmrlManiSkillEnv(task="pull", scenes=[0, 2], cameras=["third_view"], image_size=32)
    simulation = env.create_simulation()
    simulation.task = task_of("pull")
    frame = simulation.reset(SCENES[2], 3)
    assert np.array_equal(found.images[3, 1], frame.images["third_view"])
    assert np.array_equal(found.state[3], frame.state)
    assert found.instructions[3] == simulation.instruction
    simulation.close()
    config.dynamics = AutoregressiveConfig(depth=True)
    with pytest.raises(ValueError, match=r"^dataset\.root=None: .*looks at depth.*give a dataset"):
        found.depth(type("Model", (), {"config": config}))

"""Depth and colours, as they come out of the dataset: equal to what the rebuilt start shows."""

from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.recorder import record
from lerobot_dataset_maniskill.writer import depth_encoder
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.maniskill.scenes import SCENES


def test_a_stored_start_and_its_depth_are_rebuilt_from_scene_and_seed(tmp_path: Path) -> None:
    env = WmrlManiSkillEnv(cameras=["third_view", "wrist"], image_size=64, scenes=[1])
    config = RecordConfig(tmp_path / "dataset", num_episodes=1, num_workers=1, env=env, depth=True)
    record(config)
    dataset = LeRobotDataset("local/dataset", root=tmp_path / "dataset")
    assert set(dataset.meta.depth_keys) == {f"observation.images.{name}_depth" for name in env.cameras}
    assert "_depth`: LeRobot depth maps" in (tmp_path / "dataset" / "README.md").read_text()
    row = dataset[0]
    simulation = env.create_simulation(depth=True)
    try:
        frame = simulation.reset(SCENES[int(row["start.scene"])], int(row["start.seed"]))
    finally:
        simulation.close()
    np.testing.assert_allclose(row["observation.state"], frame.state, atol=1e-6)
    for name in env.cameras:
        stored = row[f"observation.images.{name}_depth"].numpy().reshape(64, 64)
        shown = np.minimum(frame.depth[name].reshape(64, 64), 1000 * depth_encoder().depth_max)
        assert np.abs(stored - shown).max() <= 1.0, "millimetres"
        colours = 255 * row[f"observation.images.{name}"].permute(1, 2, 0).numpy()
        assert np.abs(colours - frame.images[name]).mean() < 4.0

"""CPU time of a recorded step: this package's table against ManiSkill's own, same cameras, in one run.

    python benchmarks/recording_speed.py

Two cameras of 128x128 pixels. ManiSkill's own is PushCube with `panda_wristcam`, whose pictures a user would
record; ours is measured with the light robot meshes and with all of them. Writes
docs/results/recording_speed.json.
"""

import argparse
import resource
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import mani_skill.envs  # noqa: F401 (registers PushCube)
import numpy as np

from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.maniskill.backend import render_backend
from lerobot_wmrl.maniskill.cameras import ROBOT_MESH_DETAIL, Rendering
from lerobot_wmrl.maniskill.scenes import scenes_of
from lerobot_wmrl.maniskill.simulation import Simulation
from lerobot_wmrl.maniskill.tasks import TASKS

CAMERAS = ("third_view", "wrist")
"""As many as ManiSkill's own recording has."""

RESULTS = Path(__file__).parents[1] / "docs" / "results"
REPETITIONS = 3


def cpu_seconds(step: Callable[[], object], steps: int) -> float:
    """Median CPU time of a step (s), all threads together, after a warm-up."""
    for _ in range(3):
        step()
    costs = []
    for _ in range(REPETITIONS):
        began = time.process_time()
        for _ in range(steps):
            step()
        costs.append((time.process_time() - began) / steps)
    return float(np.median(costs))


def stock_step(image_size: int, steps: int) -> float:
    """ManiSkill's own environment, with the pictures of both its cameras as numpy arrays."""
    env = gym.make(
        "PushCube-v1",
        robot_uids="panda_wristcam",
        obs_mode="rgb",
        control_mode="pd_ee_delta_pose",
        sensor_configs={"width": image_size, "height": image_size},
        sim_backend="physx_cpu",
        render_backend=render_backend(),
    )
    env.reset(seed=0)
    still = np.zeros(env.action_space.shape, np.float32)

    def step() -> list[np.ndarray]:
        observation = env.step(still)[0]
        return [data["rgb"].cpu().numpy() for data in observation["sensor_data"].values()]

    assert len(step()) == len(CAMERAS)
    cost = cpu_seconds(step, steps)
    env.close()
    return cost


def our_step(image_size: int, steps: int, robot_mesh_detail: float) -> float:
    """The recorder's simulation in one scene."""
    scenes = scenes_of("ind")[:1]
    simulation = Simulation(
        TASKS["push"], scenes, Rendering(CAMERAS, image_size, robot_mesh_detail=robot_mesh_detail)
    )
    simulation.reset(scenes[0], 0)
    still = np.zeros(7, np.float32)
    cost = cpu_seconds(lambda: simulation.step(still), steps)
    simulation.close()
    return cost


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--image_size", type=int, default=128, help="pixels a side")
    parser.add_argument("--steps", type=int, default=40, help="steps a repetition")
    parser.add_argument("--output", type=Path, default=RESULTS / "recording_speed.json", help="JSON file")
    return parser


def main() -> None:
    """Measure, print, write."""
    given = make_parser().parse_args()
    light = our_step(given.image_size, given.steps, ROBOT_MESH_DETAIL)
    full = our_step(given.image_size, given.steps, 1.0)
    stock = stock_step(given.image_size, given.steps)
    figures = {
        "cameras": list(CAMERAS),
        "image_size": given.image_size,
        "cpu_s_per_step": {"light meshes": light, "all meshes": full, "ManiSkill's own": stock},
        "share_of_stock": {"light meshes": light / stock, "all meshes": full / stock},
        "peak_memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }
    print(figures)
    write_json(given.output, figures)


if __name__ == "__main__":
    main()

"""CPU time from an imported simulator to its first picture: with SAPIEN's own shaders, and with ours.

    python benchmarks/simulator_start.py

Two cameras of 64x64 pixels; each measurement is a process of its own, and the kinds take turns. ManiSkill's
own PushCube with `panda_wristcam` is what a user would start. Writes docs/results/simulator_start.json.
"""

import argparse
import multiprocessing
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from lerobot_wmrl.common.files import write_json

RESULTS: Final = Path(__file__).parents[1] / "docs" / "results"
IMAGE_SIZE: Final = 64
REPETITIONS: Final = 3


def ours(rewritten: bool = True) -> float:
    """Return the CPU seconds of this package's table, on request with SAPIEN's shaders as they are."""
    from mani_skill.render import PREBUILT_SHADER_CONFIGS

    from lerobot_wmrl.maniskill import rendering, shaders
    from lerobot_wmrl.maniskill.cameras import Rendering
    from lerobot_wmrl.maniskill.scenes import scenes_of
    from lerobot_wmrl.maniskill.simulation import Simulation
    from lerobot_wmrl.maniskill.tasks import TASKS

    if not rewritten:
        rendering.sensor_shaders = lambda: PREBUILT_SHADER_CONFIGS[shaders.PACK]
    scenes = scenes_of("ind")[:1]
    began = time.process_time()
    simulation = Simulation(TASKS["push"], scenes, Rendering(("third_view", "wrist"), IMAGE_SIZE))
    simulation.reset(scenes[0], 0)
    return time.process_time() - began


def with_all_shaders() -> float:
    """Return those of the same table with SAPIEN's shaders as they are."""
    return ours(rewritten=False)


def stock() -> float:
    """Return those of ManiSkill's own environment."""
    import gymnasium as gym
    import mani_skill.envs  # noqa: F401 (registers PushCube)

    from lerobot_wmrl.maniskill.backend import render_backend

    backend = render_backend()
    began = time.process_time()
    env = gym.make(
        "PushCube-v1",
        robot_uids="panda_wristcam",
        obs_mode="rgb",
        control_mode="pd_ee_delta_pose",
        sensor_configs={"width": IMAGE_SIZE, "height": IMAGE_SIZE},
        sim_backend="physx_cpu",
        render_backend=backend,
    )
    observation, _ = env.reset(seed=0)
    assert len([data["rgb"].cpu().numpy() for data in observation["sensor_data"].values()]) == 2
    return time.process_time() - began


KINDS: Final[dict[str, Callable[[], float]]] = {
    "ours": ours,
    "ours, SAPIEN's shaders": with_all_shaders,
    "ManiSkill's own": stock,
}


def measure(kind: str) -> float:
    """Return the CPU seconds of one kind, in a new process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(KINDS[kind])


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=RESULTS / "simulator_start.json", help="JSON file")
    return parser


def main() -> None:
    """Measure, print, write."""
    given = make_parser().parse_args()
    runs = [{kind: measure(kind) for kind in KINDS} for _ in range(REPETITIONS)]
    seconds = {kind: float(np.median([run[kind] for run in runs])) for kind in KINDS}
    figures = {
        "image_size": IMAGE_SIZE,
        "cpu_s": seconds,
        "times_faster": {kind: seconds[kind] / seconds["ours"] for kind in KINDS if kind != "ours"},
    }
    print(figures)
    write_json(given.output, figures)


if __name__ == "__main__":
    main()

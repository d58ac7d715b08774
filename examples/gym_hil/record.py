"""Record gym-hil's cube with a scripted expert, made worse by noise, by LeRobot's own API alone.

    pip install examples/gym_hil
    MUJOCO_GL=egl python examples/gym_hil/record.py --root=outputs/pick --num_episodes=8

The expert knows where the cube is: it goes above it, down, closes the gripper and lifts. Its skill is drawn
for each episode: the noise on its actions (`--noise`). Nothing here imports `lerobot_wmrl`: the dataset is
what a LeRobot user would bring.
"""

import argparse
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot_env_gym_hil import CAMERAS, FPS, SIDE, TASK, PickCube
from tqdm import trange

SMOOTHNESS = 0.8
"""Share of the noise that an action takes over from the one before."""

GRIPPER_NOISE = 0.5
"""Noise of the gripper's component against that of the others."""

STEP = 0.025
"""Metres that the gripper moves at most in a step, along each axis."""

CLOSING = 4
"""Steps that the gripper closes before it is lifted."""

IMAGE = {"dtype": "image", "shape": (SIDE, SIDE, 3), "names": ["height", "width", "channels"]}
JOINTS = [f"joint{index}" for index in range(1, 8)]
FEATURES = {
    **{f"observation.images.{camera}": IMAGE for camera in CAMERAS},
    "observation.state": {
        "dtype": "float32",
        "shape": (18,),
        "names": [*JOINTS, *(f"{joint}_velocity" for joint in JOINTS), "gripper", "x", "y", "z"],
    },
    "action": {
        "dtype": "float32",
        "shape": (4,),
        "names": ["x", "y", "z", "gripper"],
        "info": {"low": [-1.0, -1.0, -1.0, 0.0], "high": [1.0, 1.0, 1.0, 2.0]},
    },
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}


class Expert:
    """Picks the cube up in one episode."""

    def __init__(self, env: PickCube) -> None:
        self.data, self.closed = env.unwrapped.data, 0

    def act(self) -> np.ndarray:
        """Return the next action, (4,)."""
        cube, gripper = self.data.sensor("block_pos").data, self.data.sensor("2f85/pinch_pos").data
        if self.closed >= CLOSING:
            return np.array([0.0, 0.0, 1.0, 2.0])
        aside, height = cube[:2] - gripper[:2], gripper[2] - cube[2]
        distance = np.linalg.norm(aside)
        if distance > 0.03 and height < 0.06 and not self.closed:  # beside the cube
            way = np.array([0.0, 0.0, 0.06])
        elif distance > 0.015:
            way = np.array([*aside, 0.1 - height if distance > 0.04 else 0.0])
        elif height > 0.012:
            way = np.array([*aside, -height])
        else:
            self.closed += 1
            return np.array([0.0, 0.0, 0.0, 2.0])
        return np.append(np.clip(way / STEP, -1, 1), 0.0)


def record(root: Path, num_episodes: int, seed: int, noise: list[float]) -> None:
    """Record the episodes and print how many succeed."""
    dataset = LeRobotDataset.create(
        "local/pick", FPS, FEATURES, root=root, use_videos=False, image_writer_threads=2
    )
    env, successes = PickCube(), 0
    low, high = env.action_space.low, env.action_space.high
    for episode in trange(num_episodes, unit="episode"):
        rng = np.random.default_rng((seed, episode))
        observation, _ = env.reset(seed=seed + episode)
        expert, skill, error, done = Expert(env), float(rng.choice(noise)), np.zeros(4), False
        while not done:
            error = SMOOTHNESS * error + np.sqrt(1 - SMOOTHNESS**2) * skill * rng.standard_normal(4)
            action = expert.act() + error * [1.0, 1.0, 1.0, GRIPPER_NOISE]
            action = np.clip(action, low, high).astype(np.float32)
            after, reward, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            dataset.add_frame(
                {
                    **{f"observation.images.{camera}": observation["pixels"][camera] for camera in CAMERAS},
                    "observation.state": observation["agent_pos"].astype(np.float32),
                    "action": action,
                    "next.reward": np.array([reward], np.float32),
                    "next.success": np.array([info["is_success"]]),
                    "next.done": np.array([done]),
                    "task": TASK,
                }
            )
            observation = after
        dataset.save_episode()
        successes += info["is_success"]
    dataset.finalize()
    print(f"{root}: {num_episodes} episodes, {successes} succeed")


def make_parser() -> argparse.ArgumentParser:
    verbatim = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=verbatim)
    parser.add_argument("--root", type=Path, default=Path("outputs/pick"), help="new dataset's folder")
    parser.add_argument("--num_episodes", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0, help="of the starts and the noise")
    noise = {"type": float, "nargs": "+", "default": [0.1, 0.3, 0.5]}
    parser.add_argument(
        "--noise", **noise, help="standard deviation of the noise; displacements are from -1 to 1"
    )
    return parser


def main() -> None:
    """Entry point."""
    record(**vars(make_parser().parse_args()))


if __name__ == "__main__":
    main()

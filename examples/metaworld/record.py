"""Record a Meta-World task with its scripted expert, made worse by noise, by LeRobot's own API alone.

    pip install examples/metaworld
    MUJOCO_GL=egl python examples/metaworld/record.py --task=push-v3 --root=outputs/metaworld

The expert's skill is drawn for each episode: the noise on its actions (`--noise`). LeRobot's environment ends
an episode at its first success, so that success is recorded in one frame alone. `--small` records frames of
96 pixels in place of 480, which is what `--env.type=metaworld_small` shows to a policy. Nothing here imports
`lerobot_wmrl`: the dataset is what a LeRobot user would bring.
"""

import argparse
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import MetaworldEnv as MetaworldConfig
from lerobot_env_metaworld_small import make as make_small
from tqdm import trange

SMOOTHNESS = 0.8
"""Share of the noise that an action takes over from the one before."""

WRITERS = 4
"""Threads that compress frames."""

FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (4,), "names": ["x", "y", "z", "gripper"]},
    "action": {
        "dtype": "float32",
        "shape": (4,),
        "names": ["x", "y", "z", "gripper"],
        "info": {"low": [-1.0] * 4, "high": [1.0] * 4},
    },
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}


def record(
    task: str, root: Path, num_episodes: int, seed: int, noise: list[float], steps: int, small: bool
) -> None:
    """Record the episodes and print how many succeed."""
    from lerobot.envs.metaworld import MetaworldEnv  # imports Meta-World

    env = (make_small if small else MetaworldEnv)(task, obs_type="pixels_agent_pos")
    fps = MetaworldConfig().fps
    shape = env.observation_space["pixels"].shape
    image = {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}
    features = {"observation.image": image, **FEATURES}
    dataset = LeRobotDataset.create(
        f"local/{task}", fps, features, root=root, use_videos=False, image_writer_threads=WRITERS
    )
    successes = 0
    for episode in trange(num_episodes, unit="episode"):
        rng = np.random.default_rng((seed, episode))
        observation, _ = env.reset(seed=seed + episode)
        skill, error, success = float(rng.choice(noise)), np.zeros(4), False
        for step in range(steps):
            error = SMOOTHNESS * error + np.sqrt(1 - SMOOTHNESS**2) * skill * rng.standard_normal(4)
            planned = env.expert_policy.get_action(env._env._get_obs())
            action = np.clip(planned + error, -1, 1).astype(np.float32)
            after, reward, terminated, truncated, info = env.step(action)
            success = info["is_success"]
            done = terminated or truncated or step == steps - 1
            dataset.add_frame(
                {
                    "observation.image": observation["pixels"],
                    "observation.state": observation["agent_pos"].astype(np.float32),
                    "action": action,
                    "next.reward": np.array([reward], np.float32),
                    "next.success": np.array([success]),
                    "next.done": np.array([done]),
                    "task": env.task_description,
                }
            )
            observation = after
            if done:
                break
        dataset.save_episode()
        successes += int(success)
    dataset.finalize()
    print(f"{root}: {num_episodes} episodes, {successes} succeed")


def make_parser() -> argparse.ArgumentParser:
    verbatim = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=verbatim)
    parser.add_argument("--task", default="push-v3", help="one of Meta-World's tasks")
    parser.add_argument("--root", type=Path, default=Path("outputs/metaworld"), help="new dataset's folder")
    parser.add_argument("--num_episodes", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0, help="of the starts and the noise")
    noise = {"type": float, "nargs": "+", "default": [0.1, 0.4, 0.8]}
    parser.add_argument("--noise", **noise, help="standard deviation of the noise; actions are from -1 to 1")
    parser.add_argument("--steps", type=int, default=150, help="longest episode")
    parser.add_argument("--small", action="store_true", help="frames of 96 pixels, without shadows")
    return parser


def main() -> None:
    """Entry point."""
    record(**vars(make_parser().parse_args()))


if __name__ == "__main__":
    main()

"""Record PushT (gym-pusht) with a scripted pusher of mixed skill, by LeRobot's own API alone.

    python examples/record_pusht.py --root=outputs/pusht --num_episodes=200 --seed=0

The pusher goes around the block and pushes it in a straight line, again and again. Each push is the best of a
fan of them, tried in a copy of the physics. Its skill is drawn for each episode: the error of its hand
(`--noise`). Nothing here imports `lerobot_wmrl`: the dataset is what a LeRobot user would bring.
"""

import argparse
from itertools import product
from pathlib import Path

import gym_pusht  # noqa: F401  (registers the environment)
import gymnasium as gym
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tqdm import trange

SIZE = 96
"""Side of the frames in pixels, as in the dataset `lerobot/pusht`."""

CLEARANCE = 110.0
"""Distance from the block's centre at which the pusher goes around it; the board's side is 512."""

BOARD = (20.0, 492.0)
"""Targets of the pusher stay between, along both axes."""

STRIDE = 20.0
"""Distance between two targets of a push."""

WALK = 30.0
"""Distance between two targets around the block."""

ANGLES = 12
"""Directions from the block's centre in which a push may begin."""

LONGEST_PUSH = 300.0
"""Length of a push at most."""

TIME_COST = 0.1
"""What a step costs, in units of the board."""

FEATURES = {
    "observation.image": {
        "dtype": "image",
        "shape": (SIZE, SIZE, 3),
        "names": ["height", "width", "channels"],
    },
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}


class ScriptedPusher:
    """Push the block to its goal, greedily.

    Args:
        env: the environment; its physics is tried out and put back.
        noise: standard deviation of the targets' error, in units of the board.
        rng: of the noise.
    """

    def __init__(self, env: gym.Env, noise: float, rng: np.random.Generator) -> None:
        self.env, self.noise, self.rng = env.unwrapped, noise, rng
        self.plan: list[np.ndarray] = []
        self.goal = self._goal_corners()

    def act(self) -> np.ndarray:
        """Return the next target, (2,) float32."""
        if not self.plan:
            fan = product(2 * np.pi / ANGLES * np.arange(ANGLES), range(len(self.goal)))
            tried = [self._try(angle, corner) for angle, corner in fan]
            self.plan = list(min(tried, key=lambda each: each[1])[0])
        target = self.plan.pop(0) + self.noise * self.rng.standard_normal(2)
        return np.clip(target, *BOARD).astype(np.float32)

    def _try(self, angle: float, corner: int) -> tuple[np.ndarray, float]:
        """Try the push that begins at an angle and aims near a corner.

        Return its targets (T, 2), until the block is nearest to its goal, and its cost.
        """
        centre, corners = self._corners().mean(0), self._corners()
        start = np.clip(centre + CLEARANCE * np.array([np.cos(angle), np.sin(angle)]), *BOARD)
        aim = 0.8 * corners[corner] + 0.2 * centre
        way = (aim - start) / max(1.0, float(np.linalg.norm(aim - start)))
        push = start + STRIDE * np.arange(int(LONGEST_PUSH / STRIDE))[:, None] * way
        targets = np.clip(np.concatenate([self._way_around(centre, start), push]), *BOARD)
        saved = self._save()
        costs = []
        for target in targets:
            self._step(target)
            costs.append(self._cost() + TIME_COST * len(costs))
        self._restore(saved)
        first = len(targets) - len(push)
        last = first + int(np.argmin(costs[first:]))
        return targets[: last + 1], costs[last]

    def _way_around(self, centre: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Return targets (T, 2) that lead around the block to where the push begins."""
        here, there = np.array(self.env.agent.position) - centre, start - centre
        angle = np.arctan2(here[1], here[0])
        turn = (np.arctan2(there[1], there[0]) - angle + np.pi) % (2 * np.pi) - np.pi
        steps = 1 + int(abs(turn) * CLEARANCE / WALK)
        angles = angle + turn * np.arange(steps + 1) / steps
        around = centre + CLEARANCE * np.stack([np.cos(angles), np.sin(angles)], 1)
        return np.concatenate([around, [start, start]])

    def _corners(self) -> np.ndarray:
        """Return the block's corners, (8, 2)."""
        return self.env.get_keypoints(self.env._block_shapes)

    def _cost(self) -> float:
        """Mean distance of the block's corners from the goal's, and more when it leaves the board."""
        corners = self._corners()
        outside = np.maximum(0, np.abs(corners - 256) - 240).sum()
        return float(np.linalg.norm(corners - self.goal, axis=1).mean() + outside)

    def _goal_corners(self) -> np.ndarray:
        """Return the corners of the block at its goal, (8, 2)."""
        block, (x, y, angle) = self.env.block, self.env.goal_pose
        saved = block.angle, block.position
        block.angle, block.position = angle, (x, y)  # in this order: a body turns around its centre of mass
        corners = self._corners()
        block.angle, block.position = saved
        return corners

    def _step(self, target: np.ndarray) -> None:
        """Do what the environment does in a step, without its pictures and its reward."""
        env, (x, y) = self.env, map(float, target)
        for _ in range(int(1 / (env.dt * env.control_hz))):
            place, velocity = env.agent.position, env.agent.velocity
            env.agent.velocity = (
                velocity.x + (env.k_p * (x - place.x) - env.k_v * velocity.x) * env.dt,
                velocity.y + (env.k_p * (y - place.y) - env.k_v * velocity.y) * env.dt,
            )
            env.space.step(env.dt)

    def _save(self) -> list[tuple]:
        bodies = (self.env.agent, self.env.block)
        return [(body.angle, body.position, body.angular_velocity, body.velocity) for body in bodies]

    def _restore(self, saved: list[tuple]) -> None:
        for body, state in zip((self.env.agent, self.env.block), saved, strict=True):
            body.angle, body.position, body.angular_velocity, body.velocity = state
        self.env.space.reindex_shapes_for_body(self.env.agent)
        self.env.space.reindex_shapes_for_body(self.env.block)


def record(root: Path, num_episodes: int, seed: int, noise: list[float], steps: int) -> None:
    """Record the episodes and print how many succeed."""
    env = gym.make(
        "gym_pusht/PushT-v0",
        obs_type="pixels_agent_pos",
        observation_width=SIZE,
        observation_height=SIZE,
        max_episode_steps=steps,
        disable_env_checker=True,
    )
    dataset = LeRobotDataset.create("local/pusht", fps=10, features=FEATURES, root=root, use_videos=False)
    successes = 0
    for episode in trange(num_episodes, unit="episode"):
        rng = np.random.default_rng((seed, episode))
        observation, _ = env.reset(seed=seed + episode)
        pusher, done = ScriptedPusher(env, float(rng.choice(noise)), rng), False
        while not done:
            action = pusher.act()
            after, reward, success, truncated, _ = env.step(action)
            done = success or truncated
            dataset.add_frame(
                {
                    "observation.image": observation["pixels"],
                    "observation.state": observation["agent_pos"].astype(np.float32),
                    "action": action,
                    "next.reward": np.array([reward], np.float32),
                    "next.success": np.array([success]),
                    "next.done": np.array([done]),
                    "task": "Push the T onto its outline.",
                }
            )
            observation = after
        dataset.save_episode()
        successes += int(success)
    dataset.finalize()
    print(f"{root}: {num_episodes} episodes, {successes} succeed")


def main() -> None:
    """Entry point."""
    verbatim = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=verbatim)
    parser.add_argument("--root", type=Path, default=Path("outputs/pusht"), help="folder of the new dataset")
    parser.add_argument("--num_episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the starts and the pusher")
    parser.add_argument(
        "--noise",
        type=float,
        nargs="+",
        default=[2, 8, 32],
        help="error of the targets, of 512; one is drawn for each episode",
    )
    parser.add_argument("--steps", type=int, default=300, help="longest episode")
    record(**vars(parser.parse_args()))


if __name__ == "__main__":
    main()

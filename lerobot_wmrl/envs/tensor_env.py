"""What reinforcement learning trains in: vector environments with tensors in and tensors out."""

import gymnasium as gym
import torch


class TensorEnv(gym.vector.VectorEnv):
    """B environments that begin anew in the step in which an episode ends (gymnasium's SAME_STEP autoreset).

    - `reset(seed=…)` returns observations in LeRobot's names: images (B, 3, H, W) float32 in [0, 1],
      `observation.state` (B, P), `task` (B strings).
    - `step(actions)` takes actions (B, A) in the dataset's units, and returns observations, rewards (B,)
      float32, terminated (B,) and truncated (B,) bool, and `info`.
    - `info["reward_parts"]` has parts of the reward and measurements, (B,) each. Actions out of their range
      are clipped to it, and `clipped` is the share of components that were.
    - Where an episode has ended, `info["final_obs"]` has the observations before the reset (rows of the
      others equal the observation), and `info["final_info"]` has `is_success` and `episode_length`, (B,)
      each.
    """

    device: torch.device
    max_episode_steps: int
    """Steps after which the longest episodes are truncated."""

    tasks: int = 1
    """Number of tasks, which are shared out among the environments."""

    def repeats_starts(self) -> bool:
        """Return whether the same seed gives the same start."""
        return True

"""What the training loop asks of an algorithm, beyond LeRobot's interface of algorithms."""

from abc import abstractmethod
from typing import Any

import gymnasium as gym
import torch
from lerobot.rl.algorithms.base import RLAlgorithm
from torch.optim import Optimizer

from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.common.policies import load_trained_weights
from lerobot_wmrl.rl.rollout import RolloutBuffer


class Algorithm(RLAlgorithm):
    """Trains a policy of LeRobot, one rollout after the other.

    Args:
        policy: LeRobot's policy, trained in place and kept as `lerobot_policy`.
    """

    iteration: int
    """Rollouts that were trained on."""

    optimizer: Optimizer

    def __init__(self, policy: Any) -> None:
        self.lerobot_policy, self.iteration = policy, 0

    def check_dataset(self, env: Any, pipeline: Pipeline) -> None:
        """Raise FieldError if recorded episodes are learnt from beside the rollouts, and cannot be. By
        default none are.

        Args:
            env: the environment to train in, which knows its dataset.
            pipeline: the policy's processors.
        """

    @abstractmethod
    def iterate(
        self, env: gym.vector.VectorEnv, pipeline: Pipeline, rollout: RolloutBuffer, seed: int, last: bool
    ) -> dict[str, float]:
        """Collect one rollout, update the policy on it, and return metrics.

        Args:
            env: the environment to train in.
            pipeline: the policy's processors.
            rollout: buffer that is filled.
            seed: seed of this process's first environment in this iteration.
            last: whether this is the training's last iteration.

        Raises:
            TrainingStopped: there is nothing to learn from, or the policy cannot be improved further.
        """

    def get_optimizers(self) -> dict[str, Optimizer]:
        """Return the optimizer in use, with its moments; `make_optimizers_and_scheduler` makes a new one."""
        return {self.name: self.optimizer}

    def load_weights(self, weights: dict[str, Any], device: str | torch.device = "cpu") -> None:
        """Load a checkpoint's weights into `lerobot_policy`."""
        load_trained_weights(self.lerobot_policy, weights)

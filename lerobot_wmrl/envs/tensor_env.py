"""What reinforcement learning trains in: vector environments with tensors in and tensors out."""

from abc import abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Final, NamedTuple

import gymnasium as gym
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from lerobot_wmrl.common.actions import clip_actions
from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.policies import LoadedPolicy

NO_PARTS: Final[Mapping[str, Tensor]] = MappingProxyType({})


class Outcome(NamedTuple):
    """What a step of B episodes led to, (B,) each, before another one begins where one has ended.

    Attributes:
        observation: what is seen after it.
        reward: float32.
        terminated, truncated: whether the episode has ended, bool.
        success: whether it succeeds, bool.
        length: its steps so far.
        parts: parts of the reward, and measurements.
    """

    observation: Observation
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    success: Tensor
    length: Tensor
    parts: Mapping[str, Tensor] = NO_PARTS


class TensorEnv(gym.vector.VectorEnv):
    """B environments that begin anew in the step in which an episode ends (gymnasium's SAME_STEP autoreset).

    `reset(seed=…)` returns observations in LeRobot's names: images (B, 3, H, W) float32 in [0, 1],
    `observation.state` (B, P), `task` (B strings).
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 (gymnasium's own)

    device: torch.device
    max_episode_steps: int
    """Steps after which the longest episodes are truncated."""

    action_low: Tensor
    action_high: Tensor
    """Range of the actions, (A,) each, on the device on which actions are taken."""

    tasks: int = 1
    """Number of tasks, which are shared out among the environments."""

    refuses_nan_first: ClassVar[bool] = True
    """Whether NaN is searched for before the step: a simulator may crash on it. Each search synchronises
    with the device, so the world model, which NaN does not harm, searches once, after the step."""

    @torch.no_grad()
    def step(self, actions: Tensor) -> tuple[Observation, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Take a step in every environment, and begin new episodes where one has ended.

        Args:
            actions: (B, A) in the dataset's units; what is out of range is clipped to it.

        Returns:
            Observations, rewards (B,) float32, terminated (B,) and truncated (B,) bool, and `info`.
            `info["reward_parts"]` has parts of the reward and measurements, (B,) each; `clipped` among them
            is the share of components that were clipped. Where an episode has ended, `info["final_obs"]` has
            the observations before the reset (rows of the others equal the observation), and
            `info["final_info"]` has `is_success` and `episode_length`, (B,) each.

        Raises:
            ValueError: the actions have another shape.
            NanActionError: the actions contain NaN; reset before the next step.
        """
        clipped, share = clip_actions(self._checked(actions), self.action_low, self.action_high)
        nan = clipped.isnan().any(1)
        if self.refuses_nan_first and bool(nan.any()):
            raise NanActionError(nan)
        outcome = self._advance(clipped)
        info: dict[str, Any] = {"reward_parts": {**outcome.parts, "clipped": share.to(self.device)}}
        ended = outcome.terminated | outcome.truncated
        any_ended, any_nan = torch.stack([ended.any(), nan.any().to(ended.device)]).tolist()
        if any_nan:
            raise NanActionError(nan)
        observation = outcome.observation
        if any_ended:
            info["final_obs"] = observation
            info["final_info"] = {"is_success": outcome.success, "episode_length": outcome.length}
            observation = self._restart(ended, outcome)
        return observation, outcome.reward, outcome.terminated, outcome.truncated, info

    def widen(self, low: Tensor, high: Tensor) -> None:
        """Let actions reach as far as those that were learnt from, (A,) each, where an environment may take
        more than its action space says; by default its range stays as it is."""

    def accept(self, policy: LoadedPolicy) -> None:
        """Make ready for a policy's actions. FieldError if they are in other units than the environment's."""

    def repeats_starts(self) -> bool:
        """Return whether the same seed gives the same start."""
        return True

    @abstractmethod
    def _advance(self, actions: Tensor) -> Outcome:
        """Take one step in every environment, without beginning anew. actions (B, A), in their range."""

    @abstractmethod
    def _restart(self, ended: Tensor, outcome: Outcome) -> Observation:
        """Begin new episodes where `ended` (B,) is True. Return the outcome's observation with these rows
        replaced."""

    def _checked(self, actions: Tensor) -> Tensor:
        """Return actions in float32 where they are taken. ValueError for another shape than (B, A)."""
        wanted = self.num_envs, len(self.action_low)
        if tuple(actions.shape) != wanted:
            raise ValueError(
                f"action: shape {tuple(actions.shape)}, but {self.num_envs} environments take {wanted}"
            )
        return torch.as_tensor(actions, dtype=torch.float32, device=self.action_low.device).detach()


class NanActionError(ValueError):
    """The actions of some environments, (B,) bool, are NaN."""

    def __init__(self, nan: Tensor) -> None:
        super().__init__(
            f"action: NaN in environments {nan.nonzero().flatten().tolist()}: the policy's weights or its "
            "observations are not finite; reset before the next step"
        )

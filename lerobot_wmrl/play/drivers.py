"""Who acts in a drive besides a person: a policy, a planner, or the recorded episode."""

import copy
from typing import Protocol

import torch
from lerobot.configs import PreTrainedConfig
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.pipeline import make_pipeline
from lerobot_wmrl.common.policies import check_units, fit_to_environment, load_policy, load_processors
from lerobot_wmrl.envs.world_model_env import Observation
from lerobot_wmrl.play.drive import Drive
from lerobot_wmrl.world_models.configuration_planner import PlannerSettings
from lerobot_wmrl.world_models.planning import Planner

PLANNER_SEED = 0


class Driver(Protocol):
    """Acts in a drive."""

    def reset(self) -> None:
        """Forget the past: another drive begins, this one was rewound, or somebody else has acted."""

    def act(self, drive: Drive) -> Tensor:
        """Return the next action. (1, A)"""


class DrivingPolicy:
    """A policy for one visitor. Copies share the weights; each has its own memory of an episode.

    Args:
        config: configuration of the policy.
        shown: what the world model shows: LeRobot's names with their shapes.
        names, low, high: of the components of its actions, and their range. (A,) each
    """

    def __init__(
        self, config: PreTrainedConfig, shown: dict[str, tuple[int, ...]], names: list[str], low: Tensor,
        high: Tensor,
    ) -> None:  # fmt: skip
        fit_to_environment(config, shown, len(names))
        self.config, self.processors = config, load_processors(config)
        self.policy = load_policy(config).eval()
        check_units(config, self.processors[1], names, low, high)
        self.pipeline = make_pipeline(config, *self.processors)

    def copy(self) -> "DrivingPolicy":
        """Return the policy for another visitor."""
        shared = {id(each): each for each in (*self.policy.parameters(), *self.policy.buffers())}
        other = copy.copy(self)
        other.policy = copy.deepcopy(self.policy, shared)
        other.processors = copy.deepcopy(self.processors)
        other.pipeline = make_pipeline(self.config, *other.processors)
        return other

    def reset(self) -> None:
        """Forget the episode."""
        for part in (self.policy, *self.processors):
            part.reset()

    @torch.no_grad()
    def action(self, observation: Observation) -> Tensor:
        """Return the action for an observation, in the dataset's units. (B, A)"""
        chosen = self.policy.select_action(self.pipeline.prepare(observation))
        return self.pipeline.to_action(chosen)


class PolicyDriver:
    """A policy of LeRobot acts."""

    def __init__(self, policy: DrivingPolicy) -> None:
        self.policy = policy

    def reset(self) -> None:
        self.policy.reset()

    def act(self, drive: Drive) -> Tensor:
        return self.policy.action(drive.observation).cpu()


class PlannerDriver:
    """The planner searches actions that succeed in the world model, and executes the beginning of a plan.

    Args:
        settings: settings of the search.
        done_frames: consecutive done frames that make a success.
        policy: policy whose actions it changes, if there is one.
    """

    def __init__(self, settings: PlannerSettings, done_frames: int, policy: DrivingPolicy | None) -> None:
        self.settings, self.done_frames, self.policy = settings, done_frames, policy
        self.reset()

    def reset(self) -> None:
        self.planner: Planner | None = None
        self.plan: list[Tensor] = []

    def act(self, drive: Drive) -> Tensor:
        if not self.plan:
            self.plan = list(self._search(drive)[0, : self.settings.execute].unbind(0))
        return self.plan.pop(0)[None].cpu()

    def _search(self, drive: Drive) -> Tensor:
        """Return planned actions. (1, T, A)"""
        env = drive.env
        self.planner = self.planner or Planner(
            env.model, None, self.settings, min(self.done_frames, self.settings.horizon),
            averaged=False, low=env.action_low, high=env.action_high, seed=PLANNER_SEED,
        )  # fmt: skip
        proposed = None
        if self.policy is not None:
            self.policy.reset()
            row = torch.zeros(1, dtype=torch.long, device=env.device)
            proposed = env.policy_actions(self.policy.action, row, self.settings.horizon)
        return self.planner.plan(env.newest_frames(), [drive.instruction], proposed)


class RecordedDriver:
    """The episode of the dataset goes on as it was recorded."""

    def reset(self) -> None:
        """Do nothing: what comes next depends on the drive alone."""

    def act(self, drive: Drive) -> Tensor:
        if drive.recorded is None or drive.frame >= len(drive.recorded.actions):
            raise FieldError("driver", "recorded", "the recorded episode is over", "choose who goes on")
        return torch.from_numpy(drive.recorded.actions[drive.frame])[None]

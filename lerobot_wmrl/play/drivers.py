"""Who acts in a drive besides a person: a policy, a planner, or the recorded episode."""

import copy
from typing import Protocol

import torch
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policies import LoadedPolicy
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


def copied(policy: LoadedPolicy) -> LoadedPolicy:
    """Return the policy for another visitor: it shares the weights, and has its own memory of an episode."""
    shared = {id(each): each for each in (*policy.policy.parameters(), *policy.policy.buffers())}
    return copy.deepcopy(policy, shared)


class PolicyDriver:
    """A policy of LeRobot acts."""

    def __init__(self, policy: LoadedPolicy) -> None:
        self.policy = policy

    def reset(self) -> None:
        self.policy.reset()

    def act(self, drive: Drive) -> Tensor:
        return self.policy.act(drive.observation).cpu()


class PlannerDriver:
    """The planner searches actions that succeed in the world model, and executes the beginning of a plan.

    Args:
        settings: settings of the search.
        done_frames: consecutive done frames that make a success.
        policy: policy whose actions it changes, if there is one.
    """

    def __init__(self, settings: PlannerSettings, done_frames: int, policy: LoadedPolicy | None) -> None:
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
            env.model,
            None,
            self.settings,
            min(self.done_frames, self.settings.horizon),
            averaged=False,
            low=env.action_low,
            high=env.action_high,
            seed=PLANNER_SEED,
        )
        proposed = None
        if self.policy is not None:
            self.policy.reset()
            row = torch.zeros(1, dtype=torch.long, device=env.device)
            proposed = env.policy_actions(self.policy.act, row, self.settings.horizon)
        return self.planner.plan(env.newest_frames(), [drive.instruction], proposed)


class RecordedDriver:
    """The episode of the dataset goes on as it was recorded."""

    def reset(self) -> None:
        """Do nothing: what comes next depends on the drive alone."""

    def act(self, drive: Drive) -> Tensor:
        if drive.recorded is None or drive.frame >= len(drive.recorded.actions):
            raise FieldError("driver", "recorded", "the recorded episode is over", "choose who goes on")
        return torch.from_numpy(drive.recorded.actions[drive.frame])[None]

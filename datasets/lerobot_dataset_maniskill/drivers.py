"""What chooses the actions of an episode: a planner or a policy."""

from typing import Any, Protocol

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig

from lerobot_dataset_maniskill.manifest import EpisodePlan
from lerobot_dataset_maniskill.planners import MOTIONS, follow_plan
from lerobot_wmrl.common.constants import ACTION_HIGH, ACTION_LOW, KINDS
from lerobot_wmrl.common.policy_checkpoints import load_policy, load_processors
from lerobot_wmrl.maniskill.episode import Frame
from lerobot_wmrl.maniskill.simulation import Simulation

EXPLORATION_STREAM = 1 << 20
"""Tells this noise from the draws of starts, which are seeded by (seed, task, scene)."""

NOISE_MEMORY = 0.9
"""Autocorrelation of exploration noise from one step to the next: it lasts about ten steps."""


class Driver(Protocol):
    """Chooses actions (7,) float32 inside the action box."""

    def begin(self, simulation: Simulation, plan: EpisodePlan) -> None:
        """A new episode has just been reset."""

    def act(self, simulation: Simulation, frame: Frame) -> np.ndarray:
        """The action for this frame."""


class PlannerDriver:
    """Follows a plan that depends on the episode's seed and kind only, by one of `planners.MOTIONS`."""

    def __init__(self, planner: str) -> None:
        self.motion = MOTIONS[planner]()

    def begin(self, simulation: Simulation, plan: EpisodePlan) -> None:
        rng = np.random.default_rng((plan.seed, KINDS.index(plan.kind), simulation.task.index))
        start = simulation.current_start
        self.follower = follow_plan(simulation.task.name, plan.scene, start, plan.kind, rng, self.motion)

    def act(self, simulation: Simulation, frame: Frame) -> np.ndarray:
        return self.follower.act(simulation.tcp_position, simulation.object_position)


class ExplorationNoise:
    """A first-order autoregressive walk on the translations, its level drawn once an episode.

    Independent noise averages out within a few steps; this leads an episode away from the policy's path,
    to where the policy will be once it has changed.
    """

    def __init__(self, largest: float, seed: int) -> None:
        self.rng = np.random.default_rng((seed, EXPLORATION_STREAM))
        self.level = self.rng.uniform(0.0, largest) * np.array(ACTION_HIGH[:3])
        self.state = self.rng.normal(size=3)

    def __call__(self) -> np.ndarray:
        """What to add to the next action: (3,) metres."""
        offset = self.level * self.state
        fresh = np.sqrt(1.0 - NOISE_MEMORY**2) * self.rng.normal(size=3)
        self.state = NOISE_MEMORY * self.state + fresh
        return offset


class PolicyDriver:
    """A LeRobot policy with its own pre- and postprocessors, and noise on its actions if asked for."""

    def __init__(self, config: PreTrainedConfig, exploration: float) -> None:
        self.policy: Any = load_policy(config).eval()
        self.preprocess, self.postprocess = load_processors(config)
        self.exploration = exploration

    def begin(self, simulation: Simulation, plan: EpisodePlan) -> None:
        torch.manual_seed(plan.seed)
        self.noise = ExplorationNoise(self.exploration, plan.seed)
        self.policy.reset()
        self.preprocess.reset()
        self.postprocess.reset()

    @torch.no_grad()
    def act(self, simulation: Simulation, frame: Frame) -> np.ndarray:
        batch = self.preprocess(policy_observation(frame, simulation.instruction))
        action = self.postprocess(self.policy.select_action(batch)).squeeze(0).cpu().numpy()
        action[:3] += self.noise()
        return np.clip(action, ACTION_LOW, ACTION_HIGH).astype(np.float32)


def policy_observation(frame: Frame, instruction: str) -> dict[str, Any]:
    """A batch of one in LeRobot's names: images (1, 3, H, W) in [0, 1], state (1, 8), task."""
    images = {
        f"observation.images.{camera}": torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255.0
        for camera, image in frame.images.items()
    }
    return {**images, "observation.state": torch.from_numpy(frame.state)[None], "task": [instruction]}

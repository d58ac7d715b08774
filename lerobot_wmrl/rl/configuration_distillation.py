"""Configuration of distillation, `algorithm.type` distillation."""

from dataclasses import dataclass, field
from typing import ClassVar

from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.rl.algorithms.configs import RLAlgorithmConfig

from lerobot_wmrl.common.errors import FieldError, require_at_least, within
from lerobot_wmrl.common.policy_checks import require_distillable
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.rl.configuration_algorithms import AlgorithmConfig
from lerobot_wmrl.world_models.configuration_planner import PlannerSettings


@dataclass
class FastPlanner(PlannerSettings):
    """A planner that is asked some hundred times."""

    horizon: int = 28
    samples: int = 48
    iterations: int = 2
    spread: float = 0.5


@RLAlgorithmConfig.register_subclass("distillation")
@dataclass
class DistillationConfig(AlgorithmConfig):
    """Distillation of a planner into the policy, in imagination (DAgger, Ross et al. 2011).

    The policy acts first, then the planner takes over. The policy is fitted, by its own supervised loss, to
    the planner's actions in all episodes that succeeded. So any policy can be trained that lerobot-train can
    clone, at its own learning rate (`policy.optimizer_lr`).

    Args:
        planner: how the planner searches.
        longest_lead: steps for which the policy acts before the planner takes over, at most. Each iteration
            draws a number, the first takes 0.
        updates: optimizer steps in each iteration.
        last_updates: optimizer steps in the last iteration, on all labels.
        recorded: whether the policy also learns from the successful episodes of `env.dataset`, if there are
            any.
        train_encoder: train the policy's encoder of observations too. It may come to fit imagined frames, and
            recorded ones less well; `false` keeps it as it was. For the policy `cnn`.
        batch_size: labels in an optimizer step, in each process of `torchrun`.
    """

    imitates_planner: ClassVar[bool] = True

    planner: FastPlanner = field(default_factory=FastPlanner)
    longest_lead: int = 16
    updates: int = 150
    last_updates: int = 1000
    recorded: bool = True
    train_encoder: bool = True
    batch_size: int = 32

    def __post_init__(self) -> None:
        with within("planner"):
            self.planner.check_planner()
        require_at_least(self, 0, "longest_lead", "updates", "last_updates")
        require_at_least(self, 1, "batch_size")

    def check_policy(self, policy: PreTrainedConfig) -> None:
        """Raise FieldError for a policy that learns actions relative to the state."""
        require_distillable(policy)

    def check(self, num_envs: int, iterations: int, env: EnvConfig) -> None:
        """Raise FieldError unless the planner can look ahead in the environment."""
        if not isinstance(env, WorldModelEnv):
            raise FieldError(
                "algorithm.type",
                "distillation",
                f"its planner looks ahead in a world model, and `env.type` is {env.type}",
                "set `env.type` to world_model, or choose ppo or grpo",
            )
        if env.done_frames > self.planner.horizon:
            raise FieldError(
                "algorithm.planner.horizon",
                self.planner.horizon,
                f"must be at least `env.done_frames`, {env.done_frames}",
            )

"""Bases of this project's policy configurations."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig


@dataclass
class SingleStepConfig(PreTrainedConfig):
    """Configuration of a policy that takes one action from one observation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_obs_steps != 1:
            raise ValueError(f"n_obs_steps={self.n_obs_steps}: this policy sees one observation, set it to 1")

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        return None

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None


@dataclass
class ClonedConfig(SingleStepConfig):
    """Configuration of a policy that lerobot-train fits to demonstrations, by AdamW at a constant rate.

    Args:
        optimizer_lr: learning rate.
        optimizer_weight_decay: weight decay.
        optimizer_grad_clip_norm: largest norm of the gradient.
    """

    optimizer_lr: float = 1e-3
    optimizer_weight_decay: float = 1e-4
    optimizer_grad_clip_norm: float = 1.0

    @property
    def chunk_size(self) -> int:
        """Frames that one prediction acts for; lerobot-train asks for it to weight samples."""
        return 1

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

"""Configurations of the two rewards that are learnt from recorded ones, `next.reward`."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs.rewards import RewardModelConfig
from lerobot.optim.optimizers import AdamWConfig


@dataclass
class LearnedRewardConfig(RewardModelConfig):
    """What both share.

    Args:
        hidden: width of the last hidden layer.
        learning_rate: AdamW's.
    """

    hidden: int = 128
    learning_rate: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("hidden", "learning_rate"):
            if getattr(self, name) <= 0:
                raise ValueError(f"--reward_model.{name}={getattr(self, name)}: must be above 0")

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.learning_rate, weight_decay=1e-4, grad_clip_norm=1.0)


@RewardModelConfig.register_subclass("proxy")
@dataclass
class ProxyConfig(LearnedRewardConfig):
    """A network of its own reads the reward off a frame (DiWA's).

    Args:
        cameras: whose frames it sees.
        width: channels of its first convolution.
        image_size: side of the square frames in the dataset, in pixels; filled in from it where training
            begins.
    """

    cameras: list[str] = field(default_factory=lambda: ["third_view"])
    image_size: int = 0
    width: int = 32

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width < 1:
            raise ValueError(f"--reward_model.width={self.width}: must be at least 1")

    @property
    def camera_keys(self) -> list[str]:
        """The dataset's keys of the cameras."""
        return [f"observation.images.{camera}" for camera in self.cameras]

    @property
    def observation_delta_indices(self) -> list[int]:
        """The frame that a row's action leads to: the row's reward is about that one."""
        return [1]


@RewardModelConfig.register_subclass("embedding")
@dataclass
class EmbeddingConfig(LearnedRewardConfig):
    """A head reads the reward off the action world model's hidden state (iVideoGPT's).

    Args:
        world_model_path: the trained action world model. Only needed where its hidden states are not given:
            in training, and to score windows of a dataset.
        world_model: which one that was, a digest of its weights; hidden_size, clip_length: its sizes. Filled
            in from its checkpoint.
    """

    world_model_path: str | None = None
    world_model: str = ""
    hidden_size: int = 0
    clip_length: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.world_model_path and not self.clip_length:
            from lerobot_wmrl.world_models.checkpoint import read_config

            model: Any = read_config(self.world_model_path, "action_world_model")
            self.clip_length = model.clip_length

    @property
    def observation_delta_indices(self) -> list[int]:
        return list(range(1 - self.clip_length, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        return self.observation_delta_indices

    @property
    def reward_delta_indices(self) -> list[int]:
        return self.observation_delta_indices

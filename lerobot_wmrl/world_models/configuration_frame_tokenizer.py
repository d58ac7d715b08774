"""Configuration of the frame tokenizer."""

from dataclasses import dataclass, field

from lerobot.configs.rewards import RewardModelConfig
from lerobot.optim.optimizers import AdamWConfig
from lerobot.optim.schedulers import CosineDecayWithWarmupSchedulerConfig, LRSchedulerConfig


@RewardModelConfig.register_subclass("frame_tokenizer")
@dataclass
class FrameTokenizerConfig(RewardModelConfig):
    """Frames to tokens. As a reward model it scores the similarity of a frame to a goal frame (eq. 5).

    Args:
        cameras: camera names whose frames make one time step.
        image_size: side of the square frames in the dataset, in pixels.
        widths: channels from fine to coarse; each further entry halves the token grid.
        levels: levels of each code factor (finite scalar quantisation).
        motion_weight: how much more a pixel counts in the loss once it differs from the episode's start.
    """

    cameras: list[str] = field(default_factory=lambda: ["third_view"])
    image_size: int = 128
    widths: list[int] = field(default_factory=lambda: [48, 96])
    levels: list[int] = field(default_factory=lambda: [5, 5, 5, 5, 5, 5])
    motion_weight: float = 4.0
    learning_rate: float = 2e-3

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.learning_rate, weight_decay=1e-4, grad_clip_norm=1.0)

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        return None

    @property
    def camera_keys(self) -> list[str]:
        """The dataset's keys of the cameras."""
        return [f"observation.images.{camera}" for camera in self.cameras]


def cosine_schedule(learning_rate: float, steps: int) -> CosineDecayWithWarmupSchedulerConfig:
    """Warm up over 5 % of the steps, then decay to a twentieth."""
    return CosineDecayWithWarmupSchedulerConfig(
        num_warmup_steps=max(1, steps // 20),
        num_decay_steps=steps,
        peak_lr=learning_rate,
        decay_lr=learning_rate / 20,
    )

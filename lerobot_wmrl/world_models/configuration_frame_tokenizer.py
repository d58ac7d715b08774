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
        widths: channels from fine to coarse. With one entry a token is 4x4 pixels; each further entry doubles
            its side. The last scale does most of the work.
        quantizer: `fsq` (finite scalar quantisation) or `lfq` (MAGVIT-2's lookup-free quantisation).
        levels: codes of each factor of a token; with `lfq` the same power of two for all, such as [512,512]
            for 18 bits.
        motion_weight: how much more a pixel counts in the loss once it differs from the episode's start.
        context: give encoder and decoder the episode's first frame, so that tokens need carry only motion.
        perceptual_weight: of LPIPS in the loss. Needs torchvision's VGG-16 in its cache; 0 does without.
    """

    cameras: list[str] = field(default_factory=lambda: ["third_view"])
    image_size: int = 128
    widths: list[int] = field(default_factory=lambda: [48, 96])
    quantizer: str = "fsq"
    levels: list[int] = field(default_factory=lambda: [5, 5, 5, 5, 5, 5])
    context: bool = False
    motion_weight: float = 4.0
    perceptual_weight: float = 0.0
    learning_rate: float = 2e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("motion_weight", "perceptual_weight"):
            if getattr(self, name) < 0:
                raise ValueError(f"--model.{name}={getattr(self, name)}: must not be negative")
        if not self.cameras or len(set(self.cameras)) < len(self.cameras):
            raise ValueError(f"--model.cameras={self.cameras}: give at least one camera, each once")

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

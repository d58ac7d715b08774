"""Configuration of the frame tokenizer, alone and as a world model carries it."""

import math
from dataclasses import dataclass, field
from typing import Final

from lerobot.configs.rewards import RewardModelConfig
from lerobot.optim.optimizers import AdamWConfig
from lerobot.optim.schedulers import CosineDecayWithWarmupSchedulerConfig, LRSchedulerConfig

from lerobot_wmrl.common.errors import FieldError, require_at_least
from lerobot_wmrl.common.images import camera_key

PATCH: Final = 4
"""Side in pixels of the squares that the first convolution sees as one."""

NORM_GROUPS: Final = 8
"""Groups of channels that are normalised together at the coarsest scale."""

MOST_CODES: Final = {"fsq": 2**20, "lfq": 2**31}
"""Codes of a token at most: FSQ computes their numbers in float32 and keeps a list of all, LFQ's tokens are
cached as int32."""

LARGEST_BINARY_FACTOR: Final = 2**12
"""LFQ's entropy term holds a probability for every code of a factor at every token of the batch."""

FEWEST_LEVELS: Final = {"fsq": 3, "lfq": 2}
"""Known quantizers, and how many levels a factor of a token needs at least."""


@dataclass
class TokenizerConfig:
    """Which frames become tokens, and how.

    Args:
        cameras: names of the cameras, without `observation.images.`; `observation.image` by that name.
        image_size: side in pixels of the square frames that become tokens. Frames of another size or shape
            are stretched to it, and decoded ones back, so that policies see them as the dataset has them.
        widths: channels from fine to coarse. With one entry a token is 4x4 pixels; each further entry doubles
            its side.
        quantizer: `fsq` (finite scalar quantisation) or `lfq` (MAGVIT-2's lookup-free quantisation).
        levels: codes of each factor of a token; with `lfq` the same power of two for all, such as [512,512]
            for 18 bits.
        context: show encoder and decoder the episode's first frame too, so that tokens encode what moves.
        success: learn to classify success in frames too. An anchored world model then predicts the
            classifier's features, and reads success from them. Needs labels of success, and `context`.
        instructions: whether success depends on the episode's instruction too; with `success`. By default it
            does where the datasets have several tasks: by their column `start.task`, else by instructions
            with five episodes each on average; with fewer these are taken for other words of one task.
        frame_sizes: height and width of each camera's frames, read from the dataset.
    """

    cameras: list[str] = field(default_factory=lambda: ["third_view"])
    image_size: int = 128
    widths: list[int] = field(default_factory=lambda: [48, 96])
    quantizer: str = "fsq"
    levels: list[int] = field(default_factory=lambda: [5, 5, 5, 5, 5, 5])
    context: bool = False
    success: bool = False
    instructions: bool | None = None
    frame_sizes: list[list[int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not self.cameras or len(set(self.cameras)) < len(self.cameras):
            raise FieldError("tokenizer.cameras", self.cameras, "give at least one camera, each once")
        if self.success and not self.context:
            raise FieldError(
                "tokenizer.success",
                True,
                "success can depend on the episode's first frame, which tokens without `tokenizer.context` "
                "do not show",
                "set `tokenizer.context` to true",
            )
        if self.instructions and not self.success:
            raise FieldError(
                "tokenizer.instructions",
                True,
                "they are read where success is classified, which is off",
                "set `tokenizer.success` to true",
            )
        self._check_sizes()
        self._check_levels()

    def _check_sizes(self) -> None:
        """Raise FieldError unless the coarsest scale can be normalised, and tokens fill the frame."""
        if not self.widths or min(self.widths) < 1 or self.widths[-1] % NORM_GROUPS:
            raise FieldError(
                "tokenizer.widths",
                list(self.widths),
                f"must be channels from fine to coarse, the last a multiple of {NORM_GROUPS}",
                "each further entry halves the token grid",
            )
        if self.image_size < 1 or self.image_size % self.downsample:
            raise FieldError(
                "tokenizer.image_size",
                self.image_size,
                f"must be a multiple of {self.downsample}, a token's side with "
                f"`tokenizer.widths`={list(self.widths)}",
            )

    def _check_levels(self) -> None:
        """Raise FieldError unless the quantizer is known and can have these levels."""
        levels = list(self.levels)
        if self.quantizer not in FEWEST_LEVELS:
            raise FieldError(
                "tokenizer.quantizer", self.quantizer, f"choose one of {', '.join(FEWEST_LEVELS)}"
            )
        fewest = FEWEST_LEVELS[self.quantizer]
        if not levels or min(levels) < fewest:
            raise FieldError(
                "tokenizer.levels", levels, f"give at least one factor, each of {fewest} or more levels"
            )
        most = MOST_CODES[self.quantizer]
        if math.prod(levels) > most:
            raise FieldError(
                "tokenizer.levels",
                levels,
                f"{math.prod(levels):,} codes are more than {most:,}",
                "give fewer factors",
            )
        size = levels[0]
        same_power = len(set(levels)) == 1 and not size & (size - 1) and size <= LARGEST_BINARY_FACTOR
        if self.quantizer == "lfq" and not same_power:
            raise FieldError(
                "tokenizer.levels",
                levels,
                "with `tokenizer.quantizer`=lfq all factors must be the same power of two, at most "
                f"{LARGEST_BINARY_FACTOR}",
                "[512,512] is 18 bits in two factors",
            )

    @property
    def downsample(self) -> int:
        """Side of a token in pixels."""
        return PATCH * 2 ** (len(self.widths) - 1)

    @property
    def frame_shapes(self) -> dict[str, tuple[int, int, int]]:
        """Shape (3, H, W) of each camera's frames as the dataset has them, by the camera's key."""
        sizes = self.frame_sizes or [[self.image_size, self.image_size]] * len(self.cameras)
        return {key: (3, *size) for key, size in zip(self.camera_keys, sizes, strict=True)}  # type: ignore[misc]

    @property
    def square_side(self) -> int | None:
        """Side of the frames as the dataset has them, None unless all are squares of one size."""
        sides = {side for _, *size in self.frame_shapes.values() for side in size}
        return sides.pop() if len(sides) == 1 else None

    @property
    def camera_keys(self) -> list[str]:
        """The dataset's keys of the cameras."""
        return [camera_key(camera) for camera in self.cameras]


@RewardModelConfig.register_subclass("frame_tokenizer")
@dataclass
class FrameTokenizerConfig(RewardModelConfig):
    """Train a frame tokenizer. As a reward model it scores the similarity of a frame to a goal frame (eq. 5).

    Args:
        tokenizer: which frames become tokens, and how.
        perceptual_weight: weight of LPIPS in the loss, 0 is off. Needs torchvision's VGG-16 in torch's cache.
        learning_rate: highest learning rate of the schedule.
    """

    tokenizer: TokenizerConfig = field(default_factory=TokenizerConfig)
    perceptual_weight: float = 0.0
    learning_rate: float = 2e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(self, 0, "perceptual_weight")

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.learning_rate, weight_decay=1e-4, grad_clip_norm=1.0)

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        return None


def cosine_schedule(learning_rate: float, steps: int) -> CosineDecayWithWarmupSchedulerConfig:
    """Warm up over 5 % of the steps, then decay to a twentieth."""
    return CosineDecayWithWarmupSchedulerConfig(
        num_warmup_steps=max(1, steps // 20),
        num_decay_steps=steps,
        peak_lr=learning_rate,
        decay_lr=learning_rate / 20,
    )

"""Sizes of imagined frames, batches and rollouts, given the size of the frames that the policy sees."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from lerobot_wmrl.common.flags import Flags
from lerobot_wmrl.common.presets import preset_settings
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.configuration_distillation import DistillationConfig

SIDES: Final = {"tiny": 32, "demo": 64, "cpu": 128}
"""Pixels a side of imagined frames at each size, unless the dataset's are smaller."""

SIDE_STEP: Final = 32
"""A side is a multiple of this: at any of the sizes, the transformer's patches divide the token grid."""

ROLLOUT_BYTES: Final = 2**31
"""Bytes of frames that RL keeps at most: PPO those of an iteration, distillation those of all iterations.
Imagined ones are kept as small as they are imagined, recorded ones in the policy's size."""

CHANNELS: Final = 3
"""Of a frame, a byte each."""

PASS_PIXELS: Final = 2**23
"""Pixels of observations in one forward and backward pass at most."""

ACTING_PIXELS: Final = 4 * PASS_PIXELS
"""Pixels that a policy acts on at once at most. Without a backward pass less is kept of each."""

MINIBATCH: Final = PPOConfig.minibatch_size
"""Decisions in an optimizer step of PPO."""

CLONING_PRESETS: Final = {"tiny": "tiny"}
"""Presets of cloning at the sizes where it is not `demo`, which trains for as long as it helps."""


@dataclass(frozen=True)
class Sizes:
    """How large imagined frames, batches and rollouts are.

    Args:
        preset: the stages' preset.
        frame_side: the shorter side of the frames that the policy sees, in pixels.
        pixels: pixels of all its cameras' frames.
        cameras: how many cameras there are.
        length: frames of an imagined episode.
        observations: how many observations it learns from at once.
    """

    preset: str
    frame_side: int
    pixels: int
    cameras: int
    length: int
    observations: int

    @property
    def could_be_larger(self) -> bool:
        """Whether imagined frames are larger at the size `cpu`."""
        return self._side("cpu") > self.side

    @property
    def side(self) -> int:
        """The side of imagined frames in pixels."""
        return self._side(self.preset)

    def _side(self, size: str) -> int:
        return max(SIDE_STEP, min(SIDES[size], self.frame_side) // SIDE_STEP * SIDE_STEP)

    @property
    def pass_observations(self) -> int:
        """Steps of which a policy learns in one pass at most."""
        return max(1, PASS_PIXELS // (self.pixels * self.observations))

    def cloning_settings(self) -> dict[str, Any]:
        """Return the preset of cloning, with smaller batches where frames are large."""
        settings = preset_settings(CLONING_PRESETS.get(self.preset, "demo"), "sft", ["filtered"])
        return settings | {"batch_size": min(self.pass_observations, settings["batch_size"])}

    def iterations(self, training: Flags) -> int:
        """Return the iterations of RL with these flags."""
        return int(training.get("iterations", self._preset(training)["iterations"]))

    def rl_flags(self, training: Flags, success_frames: Callable[[], int]) -> Flags:
        """Return the flags that limit the memory of frames, where those that the policy sees are large.

        Args:
            training: other flags of RL.
            success_frames: returns the frames of all successful episodes. Called only for a distillation that
                labels recorded episodes.
        """
        preset, frame = self._preset(training), self.cameras * self.side**2 * CHANNELS
        distils = training["algorithm.type"] == "distillation"
        kept = self.iterations(training) if distils else 1
        flags: dict[str, bool | int] = {}
        remembered = ROLLOUT_BYTES // (kept * self.length * frame)
        envs = max(1, min(remembered, ACTING_PIXELS // (self.pixels * self.observations)))
        if envs < preset["num_envs"]:
            flags["num_envs"] = envs
        labels = distils and "algorithm.recorded" not in training
        if labels and success_frames() * self.pixels * CHANNELS > ROLLOUT_BYTES:
            flags["algorithm.recorded"] = False
        fits = self.pass_observations
        if distils and fits < preset.get("algorithm.batch_size", DistillationConfig.batch_size):
            flags["algorithm.batch_size"] = fits
        if not distils and fits < MINIBATCH:
            flags["algorithm.micro_batch_size"] = fits
        return flags

    def _preset(self, training: Flags) -> dict[str, Any]:
        return preset_settings(self.preset, "train", [str(training["algorithm.type"])])

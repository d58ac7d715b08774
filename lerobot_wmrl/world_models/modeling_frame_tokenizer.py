"""The frame tokenizer as a LeRobot reward model: trained, saved and published like one."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.constants import OBS_IMAGE
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.images import stretch
from lerobot_wmrl.data.checks import check_cameras, frame_size
from lerobot_wmrl.data.frames import NO_CONTEXT
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig, TokenizerConfig
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer, ImageLoss, motion_weight
from lerobot_wmrl.world_models.goal import similarity_to_goal
from lerobot_wmrl.world_models.hub_card import HubCard
from lerobot_wmrl.world_models.perceptual import PerceptualLoss, lpips_network, require_backbone

CLASSIFIER_LOSS_WEIGHT: Final = 0.1
"""Weight of the success classifier's loss. They share no weights, only the limit on the gradient's norm."""

COLLAPSE_BEGINS: Final = 0.1
"""Share of the training from which the tokens of different frames must differ."""

COLLAPSE_BATCH: Final = 8
"""Frames that a batch must have for its tokens to be compared."""

COLLAPSE_STEPS: Final = 20
"""Batches in a row whose frames all have the same tokens that tell of a collapse. In a single one, all frames
may be of a robot that waits."""


def stack_cameras(batch: dict[str, Tensor], keys: Sequence[str], size: int) -> Tensor:
    """Stack camera images (…, 3, H, W) of a batch, stretched to squares → (…, N, 3, size, size).

    ValueError if one is not there, or is none of three colours.
    """
    missing = [key for key in keys if key not in batch]
    if missing:
        present = [key for key in batch if key.startswith(OBS_IMAGE)]
        raise ValueError(
            f"the batch lacks the cameras {missing}; it has {present}. Train on a dataset with them."
        )
    for key in keys:
        if batch[key].shape[-3] != 3:
            raise ValueError(
                f"{key}: frames of shape {tuple(batch[key].shape[-3:])}; give them as (3, H, W), in RGB"
            )
    return torch.stack([stretch(batch[key], size, size) for key in keys], dim=-4)


def split_cameras(images: Tensor, shapes: Mapping[str, tuple[int, int, int]]) -> dict[str, Tensor]:
    """Return decoded images (…, N, 3, S, S) by camera, stretched to the shapes (3, H, W) of its frames."""
    return stretch_cameras(dict(zip(shapes, images.unbind(-4), strict=True)), shapes)


def stretch_cameras(
    observation: Mapping[str, Any], shapes: Mapping[str, tuple[int, int, int]]
) -> dict[str, Any]:
    """Return an observation whose cameras' frames (…, 3, S, S) are stretched to their shapes (3, H, W)."""
    return {
        name: stretch(value, *shapes[name][1:]) if name in shapes else value
        for name, value in observation.items()
    }


def with_frame_sizes(tokenizer: TokenizerConfig, features: dict[str, Any]) -> TokenizerConfig:
    """Return the settings with the sizes of a dataset's frames, and log which frames are stretched."""
    keys, side = tokenizer.camera_keys, tokenizer.image_size
    sizes = [list(frame_size(features[key])) for key in keys]
    for key, (height, width) in zip(keys, sizes, strict=True):
        if (height, width) != (side, side):
            logging.info(
                "%s: frames of %d x %d (height x width) are stretched to `tokenizer.image_size`=%d",
                key,
                height,
                width,
                side,
            )
    return replace(tokenizer, frame_sizes=sizes)


class FrameTokenizerRewardModel(HubCard, PreTrainedRewardModel):
    """Frame tokenizer as a reward model: 1 − distance to a goal frame in feature space (eq. 5)."""

    config_class = FrameTokenizerConfig
    name = "frame_tokenizer"
    summary = (
        "A frame tokenizer: camera frames to grids of discrete tokens and back, for the world models of "
        "`lerobot_env_wmrl`. Its reward is the similarity of a frame to a goal frame."
    )

    def __init__(self, config: FrameTokenizerConfig, dataset_meta: Any = None, **kwargs: Any) -> None:
        if dataset_meta is not None:
            check_cameras(dataset_meta, config.tokenizer.camera_keys, "tokenizer.cameras")
            sized = with_frame_sizes(config.tokenizer, dataset_meta.features)
            config = replace(config, tokenizer=sized)
        super().__init__(config)
        self.config: FrameTokenizerConfig = config
        if dataset_meta is not None and config.perceptual_weight:
            require_backbone("vgg", "perceptual_weight", config.perceptual_weight, "0")
        self.tokenizer = FrameTokenizer(config.tokenizer)
        self._alike = 0  # batches in a row, up to the last, whose frames all had the same tokens

    def forward(self, batch: dict[str, Any], progress: float = 1.0) -> tuple[Tensor, dict[str, float]]:
        """Return the reconstruction loss of `observation.images.*` (B, 3, H, W) and metrics.

        `reference.*` are the episodes' first frames, needed with the option `context`; `success` (B,) bool,
        whether it holds at the frames, is needed with the option `success`, which adds the classifier's loss,
        and `task`, the instructions, if they are read.
        The loss is the same at any `progress` of the training.

        Raises:
            ValueError: a tenth of the training is done, and in each of the last `COLLAPSE_STEPS` batches all
                frames had the same tokens.
        """
        images, reference = self._observed(batch), self._reference(batch)
        weight, context = None, NO_CONTEXT
        if reference is not None:
            weight = motion_weight(images, reference)
            context = self.tokenizer.context(reference)
        loss, metrics = self.tokenizer(images, weight, self._perceptual_loss(images.device), context)
        if self.training and progress >= COLLAPSE_BEGINS and len(images) >= COLLAPSE_BATCH:
            self._require_distinct(metrics["distinct_frames"] * len(images))
        if self.tokenizer.success is None:
            return loss, metrics
        assert reference is not None  # success needs context, and context the reference
        success_loss, success_metrics = self.tokenizer.success.loss(
            reference, images, batch["success"], batch.get("task", ())
        )
        return loss + CLASSIFIER_LOSS_WEIGHT * success_loss, metrics | success_metrics

    def _require_distinct(self, distinct: float) -> None:
        self._alike = self._alike + 1 if round(distinct) <= 1 else 0
        if self._alike >= COLLAPSE_STEPS:
            raise ValueError(
                f"distinct_frames: in {self._alike} batches in a row all frames have the same tokens, from "
                f"which nothing can be learnt; look at the frames of {self.config.tokenizer.camera_keys}, "
                f"which may be alike, or lower `model.learning_rate` (now {self.config.learning_rate})"
            )

    def _observed(self, batch: dict[str, Tensor]) -> Tensor:
        tokenizer_config = self.config.tokenizer
        return stack_cameras(batch, tokenizer_config.camera_keys, tokenizer_config.image_size)

    def _stack(self, batch: dict[str, Tensor], prefix: str) -> Tensor:
        keys = [f"{prefix}.{camera}" for camera in self.config.tokenizer.cameras]
        return stack_cameras(batch, keys, self.config.tokenizer.image_size)

    def _reference(self, batch: dict[str, Tensor]) -> Tensor | None:
        """Return the first frames of the episodes, None if the batch lacks them and they are not needed."""
        missing = [
            key
            for key in (f"reference.{camera}" for camera in self.config.tokenizer.cameras)
            if key not in batch
        ]
        if not missing:
            return self._stack(batch, "reference")
        if self.config.tokenizer.context:
            raise FieldError(
                "tokenizer.context",
                True,
                f"the batch lacks {missing}, the first frames of the episodes",
                "train with lerobot-wmrl-train-world-model, which adds them",
            )
        return None

    def _perceptual_loss(self, device: torch.device) -> ImageLoss | None:
        """Return LPIPS. It is no module of this model, so that a checkpoint does not contain its network."""
        weight = self.config.perceptual_weight
        return PerceptualLoss(lpips_network("vgg", device), weight) if weight else None

    @torch.no_grad()
    def compute_reward(self, batch: dict[str, Tensor]) -> Tensor:
        """Return the similarity in [0, 1] of `observation.images.*` (B, 3, H, W) to `goal.*`, (B,).

        A context-conditioned tokenizer also needs `reference.*`, the first frames of the episodes.
        """
        images, reference = self._observed(batch), self._reference(batch)
        goal = self._stack(batch, "goal")
        context = NO_CONTEXT if reference is None else self.tokenizer.context(reference)
        goal_tokens = self.tokenizer.encode(goal, context)
        goal_features = self.tokenizer.decode_with_features(goal_tokens, context).features
        tokens = self.tokenizer.encode(images, context)
        return similarity_to_goal(self.tokenizer, tokens, goal_features, context)

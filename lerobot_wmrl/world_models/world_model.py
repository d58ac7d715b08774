"""What both world models share (eq. 1): their parts in one checkpoint, and the loss they learn from.

Trained from token clips (`loss`) or from a LeRobotDataset's batches (`forward`).
"""

import logging
from typing import Any

import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.constants import OBS_STATE
from torch import Tensor, nn

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.clips import Clip, clip_from_windows
from lerobot_wmrl.data.episodes import (
    check_cameras,
    check_dataset,
    check_depth,
    check_episode_lengths,
    success_column,
)
from lerobot_wmrl.data.frame_cache import depth_of_windows
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.configuration_world_model import WorldModelConfig
from lerobot_wmrl.world_models.decoding import Condition, make_decoding
from lerobot_wmrl.world_models.dynamics import make_dynamics
from lerobot_wmrl.world_models.frame_network import Prediction
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer
from lerobot_wmrl.world_models.hub_card import HubCard
from lerobot_wmrl.world_models.imagination import Imagination
from lerobot_wmrl.world_models.modeling_frame_tokenizer import stack_cameras

MIN_SPREAD = 1e-3
"""Components that vary less than this are constants, and left alone by normalisation."""

STATE_SPREAD = 0.02
"""In the dataset's units: what varies less (a closed gripper's opening, the rotation of a hand that is held
upright) is scaled as if it varied so much, lest its noise weigh as much as centimetres."""

STATE_LIMIT = 5.0
"""In standard deviations."""

NEVER = -5.0
"""Logit of done with which a model begins whose dataset does not say what success is: else it would stay at
chance, and every second imagination would succeed."""


def check_tokenizer_source(config: WorldModelConfig) -> None:
    """Raise FieldError unless the model gets its tokenizer from exactly one place."""
    if config.tokenizer_path and config.pretrained_path:
        raise FieldError(
            "tokenizer_path", config.tokenizer_path,
            f"the world model at {config.pretrained_path} carries the tokenizer whose codes it has learnt",
            "leave one of the two out",
        )  # fmt: skip
    if config.tokenizer_path and config.tokenizer is not None:
        raise FieldError(
            "tokenizer", config.tokenizer, "is that of the checkpoint at `tokenizer_path`",
            "leave its settings out",
        )  # fmt: skip
    if not config.tokenizer_path and config.tokenizer is None:
        raise FieldError(
            "tokenizer_path", config.tokenizer_path, "is missing",
            "give the output folder of a training with type=frame_tokenizer",
        )  # fmt: skip


class WorldModelRewardModel(HubCard, Imagination, PreTrainedRewardModel):
    """Base of both: tokenizer, next-frame network and statistics in one checkpoint."""

    config_class = WorldModelConfig
    name = "world_model"
    state_mean: Tensor
    state_std: Tensor

    def __init__(
        self, config: WorldModelConfig, dataset_stats: Any = None, dataset_meta: Any = None, **kwargs: Any
    ) -> None:
        super().__init__(config)
        self.config: Any = config
        self.training_progress = 1.0
        check_tokenizer_source(config)
        if dataset_meta is not None:
            check_episode_lengths(dataset_meta)
        source = self._adopt_tokenizer() if config.tokenizer_path else None
        if dataset_meta is not None:
            self._adopt_features(dataset_meta.features)
        sizes: Any = config.tokenizer  # given, or adopted above
        self.tokenizer = FrameTokenizer(sizes).requires_grad_(False)
        if source is not None:
            self.tokenizer.load_state_dict(source.tokenizer.state_dict())
        if self.tokenizer.grid % config.patch:
            raise ValueError(
                f"--model.patch={config.patch}: must divide the tokenizer's grid, {self.tokenizer.grid}"
            )
        self.dynamics = make_dynamics(config)
        self.network = self.dynamics.make_network(
            levels=sizes.levels, grid=self.tokenizer.grid, num_cameras=len(sizes.cameras),
            state_size=config.state_size, patch=config.patch, width=config.width,
            code_width=config.code_width, quantizer=sizes.quantizer,
        )  # fmt: skip
        if dataset_meta is not None and success_column(dataset_meta.features) is None:
            last: Any = self.network.done[-1]
            nn.init.constant_(last.bias, NEVER)
        self.tokenizer.eval()
        self.decoding = make_decoding(config, self.network.embedding.local.in_channels)
        self._register_statistics("state", OBS_STATE, config.state_size, dataset_stats, STATE_SPREAD)

    def train(self, mode: bool = True) -> "WorldModelRewardModel":
        """The tokenizer is fixed: it stays in evaluation mode."""
        super().train(mode)
        self.tokenizer.eval()
        return self

    def _adopt_tokenizer(self) -> Any:
        """Take the tokenizer's sizes into the config; a trained checkpoint no longer needs its path."""
        source = load_model(self.config.tokenizer_path, "frame_tokenizer")
        self.config.tokenizer = source.config.tokenizer
        self.config.tokenizer_path = None
        return source

    def _adopt_features(self, features: dict[str, Any]) -> None:
        """Take the widths from the dataset; a trained model must find its own there."""
        if self.config.pretrained_path:
            check_dataset(self.config, features)
        sizes = self.config.tokenizer
        check_cameras(features, sizes.camera_keys, sizes.image_size)
        if self.config.depth:
            check_depth(features, sizes.camera_keys, sizes.image_size)
        if self.config.state_size and OBS_STATE not in features:
            logging.info("the dataset has no observation.state: the world model does without proprioception")
        if self.config.state_size:
            self.config.state_size = features[OBS_STATE]["shape"][0] if OBS_STATE in features else 0

    def _register_statistics(self, name: str, key: str, size: int, stats: Any, least: float = 0.0) -> None:
        """Mean and spread of the feature `key`, the spread at least `least`."""
        mean, std = torch.zeros(size), torch.ones(size)
        if stats is not None and size:
            mean = torch.as_tensor(stats[key]["mean"], dtype=torch.float32)
            std = torch.as_tensor(stats[key]["std"], dtype=torch.float32)
            std = torch.where(std < MIN_SPREAD, 1.0, std).clamp_min(least)
        self.register_buffer(f"{name}_mean", mean)
        self.register_buffer(f"{name}_std", std)

    def normalize_state(self, state: Tensor) -> Tensor:
        """Dataset units to zero mean and unit spread, clipped: rare collisions must not outweigh the rest.

        Components beyond the model's `state_size` are dropped.
        """
        state = state[..., : self.config.state_size]
        return ((state - self.state_mean) / self.state_std).clamp(-STATE_LIMIT, STATE_LIMIT)

    def condition(self, clip: Clip) -> Condition:
        """Eq. 1's c as tokens for cross-attention."""
        raise NotImplementedError

    def loss(self, clip: Clip) -> tuple[Tensor, dict[str, float]]:
        """Eqs. 2-4 on a clip of tokens."""
        return self.dynamics.loss(self, clip)

    def forward(self, batch: Clip | dict[str, Any], progress: float = 1.0) -> tuple[Tensor, dict[str, float]]:
        """Return the loss and its parts on a clip, or on LeRobot's batch (see `clip_from_windows`).

        progress: share of the training that is over, on which some losses depend.
        """
        self.training_progress = progress
        return self.loss(batch if isinstance(batch, Clip) else self.clip_from_batch(batch))

    @torch.no_grad()
    def clip_from_batch(self, batch: dict[str, Any]) -> Clip:
        """Tokenise a batch of LeRobot's windows, beside their first frames: they lack their episodes'."""
        sizes = self.config.tokenizer
        images = stack_cameras(batch, sizes.camera_keys, sizes.image_size)
        shape = images.shape[:2]
        context = self.tokenizer.context(images[:, 0])
        rows = torch.arange(shape[0]).repeat_interleave(shape[1])
        tokens = self.tokenizer.encode(images.flatten(0, 1), context[rows]).unflatten(0, shape)
        depth = self._depth(batch)
        clip = clip_from_windows(
            tokens, batch, self.config.tokenizer.camera_keys[0], self.config.state_size, depth
        )
        return clip._replace(context=context)

    def _depth(self, batch: dict[str, Any]) -> Tensor | None:
        """Of the windows' frames, (B, T, S) metres, if the model looks at depth."""
        if not self.config.depth:
            return None
        return depth_of_windows(batch, self.config.tokenizer.camera_keys, self.tokenizer.grid)

    @torch.no_grad()
    def predict(self, clip: Clip, drawn: bool = True) -> Prediction:
        """Predictions about the frame after every row of a clip, not fed back. Where its tokens are not
        needed, `drawn` = False is faster."""
        return self.dynamics.predict(self, clip, drawn)

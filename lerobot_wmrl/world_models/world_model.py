"""What both world models share (eq. 1): their parts in one checkpoint, and the loss they learn from.

Trained from token clips (`loss`) or from a LeRobotDataset's batches (`forward`).
"""

import logging
from typing import Any

import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_wmrl.precision import computing_dtype
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.compatibility import (
    check_cameras,
    check_dataset,
    check_episode_lengths,
    check_tokenizer_source,
)
from lerobot_wmrl.world_models.configuration_world_model import WorldModelConfig
from lerobot_wmrl.world_models.context import Context
from lerobot_wmrl.world_models.decoding import Condition, FramesSeen, make_decoding
from lerobot_wmrl.world_models.depth_maps import depth_of_windows
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer
from lerobot_wmrl.world_models.hub_card import HubCard
from lerobot_wmrl.world_models.imagination import Imagination
from lerobot_wmrl.world_models.keypoints import keypoint_loss
from lerobot_wmrl.world_models.losses import (
    Clip,
    corrupt_digits,
    force_predictions,
    forced_share,
    next_frame_loss,
    self_rollout_rows,
    token_weights,
)
from lerobot_wmrl.world_models.modeling_frame_tokenizer import stack_cameras
from lerobot_wmrl.world_models.next_frame import NextFrameNetwork, Prediction
from lerobot_wmrl.world_models.windows import clip_from_windows

MIN_SPREAD = 1e-3
"""Components that vary less than this are constants, and left alone by normalisation."""

STATE_LIMIT = 5.0
"""In standard deviations."""


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
        if dataset_meta is not None:
            check_tokenizer_source(config)
            check_episode_lengths(dataset_meta)
        source = self._adopt_tokenizer() if config.tokenizer_path else None
        if dataset_meta is not None:
            self._adopt_features(dataset_meta.features)
        self.tokenizer = FrameTokenizer(
            config.image_size, config.tokenizer_widths, config.levels, len(config.cameras), config.quantizer,
            config.tokenizer_context,
        ).requires_grad_(False)  # fmt: skip
        if source is not None:
            self.tokenizer.load_state_dict(source.tokenizer.state_dict())
        if self.tokenizer.grid % config.patch:
            raise ValueError(
                f"--model.patch={config.patch}: must divide the tokenizer's grid, {self.tokenizer.grid}"
            )
        self.network = NextFrameNetwork(
            levels=config.levels, grid=self.tokenizer.grid, num_cameras=len(config.cameras),
            state_size=config.state_size, patch=config.patch, layers=config.layers, width=config.width,
            heads=config.heads, window=config.window, code_width=config.code_width,
            quantizer=config.quantizer,
            conditioning=config.conditioning, depth=config.depth,
        )  # fmt: skip
        self.tokenizer.eval()
        self.decoding = make_decoding(config, self.network.embedding.local.in_channels)
        self._register_statistics("state", OBS_STATE, config.state_size, dataset_stats)

    def train(self, mode: bool = True) -> "WorldModelRewardModel":
        """The tokenizer is fixed: it stays in evaluation mode."""
        super().train(mode)
        self.tokenizer.eval()
        return self

    def _adopt_tokenizer(self) -> Any:
        """Take the tokenizer's sizes into the config; a trained checkpoint no longer needs its path."""
        source = load_model(self.config.tokenizer_path, "frame_tokenizer")
        self.config.cameras, self.config.image_size = source.config.cameras, source.config.image_size
        self.config.tokenizer_widths, self.config.levels = source.config.widths, source.config.levels
        self.config.quantizer, self.config.tokenizer_context = source.config.quantizer, source.config.context
        self.config.tokenizer_path = None
        return source

    def _adopt_features(self, features: dict[str, Any]) -> None:
        """Take the widths from the dataset; a trained model must find its own there."""
        if self.config.pretrained_path:
            check_dataset(self.config, features)
        check_cameras(self.config, features)
        if self.config.state_size and OBS_STATE not in features:
            logging.info("the dataset has no observation.state: the world model does without proprioception")
        if self.config.state_size:
            self.config.state_size = features[OBS_STATE]["shape"][0] if OBS_STATE in features else 0

    def _register_statistics(self, name: str, key: str, size: int, stats: Any) -> None:
        mean, std = torch.zeros(size), torch.ones(size)
        if stats is not None and size:
            mean = torch.as_tensor(stats[key]["mean"], dtype=torch.float32)
            std = torch.as_tensor(stats[key]["std"], dtype=torch.float32)
            std = torch.where(std < MIN_SPREAD, 1.0, std)
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
        """Eqs. 2-4 on a clip of tokens, with part of the inputs replaced by the model's own predictions."""
        condition = self.condition(clip)
        digits, state = self.network.codebook.digits(clip.tokens), self.normalize_state(clip.state)
        depth = self.network.depth.normalize(clip.depth, clip.tokens)
        seen, seen_state, seen_depth = self.inputs(clip, condition, digits, state, depth)
        torch.clear_autocast_cache()  # older torch keeps the casts made without gradients
        memory = self.network.transformer.clip_memory(digits.shape[1], digits.device)
        prediction = self.network(seen, seen_state, *condition, memory, seen_depth)
        weights = token_weights(self.network.codebook, digits, clip, self.config.motion_weight)
        loss, metrics = next_frame_loss(
            prediction, self.network.codebook, digits, state, clip, weights, self.config
        )
        frames = FramesSeen(seen, condition, prediction, memory)
        decoding_loss, decoding_metrics = self.decoding.loss(
            self.network, frames, digits[:, 1:], weights.weight
        )
        depth_loss, depth_metrics = self.network.depth.loss(prediction.depth, depth, clip.valid)
        loss = loss + decoding_loss + self.config.depth_weight * depth_loss
        metrics = metrics | decoding_metrics | depth_metrics
        if self.config.keypoint_weight > 0:
            consistency = keypoint_loss(
                prediction.logits[:, :-1], self.network.codebook, digits, clip.valid,
                self.network.num_cameras,
            )  # fmt: skip
            loss = loss + self.config.keypoint_weight * consistency
            metrics["keypoint_loss"] = consistency.item()
        return loss, metrics

    @torch.no_grad()
    def inputs(
        self, clip: Clip, condition: Condition, digits: Tensor, state: Tensor, depth: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What the network sees instead of a clip's digits (B, T, S, C), normalised state (B, T, P) and
        normalised depth (B, T, S or 0).

        Against drift: noise, one-pass predictions of single frames, and whole rollouts from first frames.
        """
        codebook, progress = self.network.codebook, self.training_progress
        seen, seen_state = corrupt_digits(digits, codebook, self.config.token_noise), state
        share = forced_share(self.config.self_forcing, progress)
        if share > 0:
            guess = self.network(seen, seen_state, *condition, depth=depth)
            seen, seen_state, depth = force_predictions(guess, codebook, seen, seen_state, depth, share)
        rows = self_rollout_rows(self.config.self_rollout, progress, len(digits), digits.device)
        if len(rows):
            rolled, rolled_state, rolled_depth = self._roll_out_rows(rows, clip, condition)
            seen, seen_state = seen.index_copy(0, rows, rolled), seen_state.index_copy(0, rows, rolled_state)
            depth = depth.index_copy(0, rows, rolled_depth)
        return seen, seen_state, depth

    def _roll_out_rows(self, rows: Tensor, clip: Clip, condition: Condition) -> tuple[Tensor, Tensor, Tensor]:
        """Clips `rows` imagined from their first frames: in float32 if they are learnt from in it, so that
        the format does not depend on how many rows a process has; else as imagination chooses."""
        tokens, mask = condition
        own = tokens[rows].float(), None if mask is None else mask[rows]
        exact = computing_dtype(clip.tokens.device) == torch.float32
        dtype = torch.float32 if exact else None
        steps = clip.tokens.shape[1] - 1
        depth = None if clip.depth is None else clip.depth[rows, 0]
        return self.roll_out(clip.tokens[rows, 0], clip.state[rows, 0], own, steps, dtype, depth)

    def forward(self, batch: Clip | dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """The loss on a clip, or on LeRobot's batch, of which `clip_from_windows` has the shapes."""
        return self.loss(batch if isinstance(batch, Clip) else self.clip_from_batch(batch))

    @torch.no_grad()
    def clip_from_batch(self, batch: dict[str, Any]) -> Clip:
        """Tokenise a batch of LeRobot's windows."""
        images = stack_cameras(batch, self.config.camera_keys, self.config.image_size)
        shape = images.shape[:2]
        context = self.tokenizer.context(images[:, 0])[torch.arange(shape[0]).repeat_interleave(shape[1])]
        tokens = self.tokenizer.encode(images.flatten(0, 1), context).unflatten(0, shape)
        depth = self._depth(batch)
        return clip_from_windows(tokens, batch, self.config.camera_keys[0], self.config.state_size, depth)

    def _depth(self, batch: dict[str, Any]) -> Tensor | None:
        """Of the windows' frames, (B, T, S) metres, if the model looks at depth."""
        if not self.config.depth:
            return None
        return depth_of_windows(batch, self.config.camera_keys, self.tokenizer.grid)

    def _context(self, batch: dict[str, Any]) -> Context:
        """Of the windows' first frames, since a window does not hold its episode's. B rows, or none."""
        images = stack_cameras(batch, self.config.camera_keys, self.config.image_size)
        return self.tokenizer.context(images[:, 0])

    @torch.no_grad()
    def predict(self, clip: Clip) -> Prediction:
        """Teacher-forced predictions on a clip."""
        digits = self.network.codebook.digits(clip.tokens)
        depth = self.network.depth.normalize(clip.depth, clip.tokens)
        return self.network(digits, self.normalize_state(clip.state), *self.condition(clip), depth=depth)

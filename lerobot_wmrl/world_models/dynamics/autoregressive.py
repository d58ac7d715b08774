"""Each frame from the one before it (eq. 1), and what is done in training against the drift that brings."""

from typing import Any, Protocol

import torch
from torch import Tensor

from lerobot_wmrl.common.precision import computing_dtype
from lerobot_wmrl.data.clips import Clip
from lerobot_wmrl.data.frames import Context
from lerobot_wmrl.world_models.decoding import Condition, FramesSeen
from lerobot_wmrl.world_models.frame_network import FrameNetwork, Prediction
from lerobot_wmrl.world_models.keypoints import keypoint_loss
from lerobot_wmrl.world_models.losses import (
    corrupt_digits,
    force_predictions,
    forced_share,
    next_frame_loss,
    next_frames,
    self_rollout_rows,
)
from lerobot_wmrl.world_models.next_frame import NextFrameNetwork
from lerobot_wmrl.world_models.open_loop import OpenLoopPrediction, open_loop_stepwise


class Dynamics(Protocol):
    """What the kinds have to offer."""

    def __init__(self, config: Any) -> None: ...

    def make_network(self, **sizes: Any) -> FrameNetwork:
        """The network, untrained; `sizes` are those of `FrameNetwork`."""

    def loss(self, model: Any, clip: Clip) -> tuple[Tensor, dict[str, float]]:
        """Of the model on a clip, and what it is made of."""

    def predict(self, model: Any, clip: Clip, drawn: bool) -> Prediction:
        """About the frame after every row of a clip. What is not `drawn` may have no logits, (B, 0, S, V)."""

    def open_loop(
        self, model: Any, tokens: Tensor, state: Tensor, actions: Tensor, context: Context,
        depth: Tensor | None, generator: torch.Generator,
    ) -> OpenLoopPrediction:  # fmt: skip
        """As `open_loop.open_loop`."""


class AutoregressiveDynamics:
    """The network sees every frame, in imagination its own."""

    def __init__(self, config: Any) -> None:
        self.config = config

    def make_network(self, **sizes: Any) -> NextFrameNetwork:
        config = self.config
        return NextFrameNetwork(
            layers=config.layers, heads=config.heads, window=config.window, conditioning=config.conditioning,
            depth=config.depth, **sizes,
        )  # fmt: skip

    def loss(self, model: Any, clip: Clip) -> tuple[Tensor, dict[str, float]]:
        """Eqs. 2-4 on a clip of tokens, with part of the inputs replaced by the model's own predictions."""
        network, config = model.network, self.config
        condition = model.condition(clip)
        digits, state = network.codebook.codes(clip.tokens), model.normalize_state(clip.state)
        depth = network.depth.normalize(clip.depth, clip.tokens)
        seen, seen_state, seen_depth = self.inputs(model, clip, condition, digits, state, depth)
        torch.clear_autocast_cache()  # older torch keeps the casts made without gradients
        memory = network.transformer.clip_memory(digits.shape[1], digits.device)
        prediction = network(seen, seen_state, *condition, memory, seen_depth)
        frames = next_frames(network.codebook, digits, clip, config.motion_weight)
        loss, metrics = next_frame_loss(prediction, network.codebook, frames, state, clip, config)
        given = FramesSeen(seen, condition, prediction, memory)
        decoding_loss, decoding_metrics = model.decoding.loss(network, given, frames.digits, frames.weight)
        depth_loss, depth_metrics = network.depth.loss(prediction.depth, depth, clip.valid)
        loss = loss + decoding_loss + config.depth_weight * depth_loss
        metrics = metrics | decoding_metrics | depth_metrics
        if config.keypoint_weight > 0:
            consistency = keypoint_loss(
                prediction.logits[:, :-1], network.codebook, digits, clip.valid, network.num_cameras
            )
            loss = loss + config.keypoint_weight * consistency
            metrics["keypoint_loss"] = consistency.item()
        return loss, metrics

    @torch.no_grad()
    def inputs(
        self, model: Any, clip: Clip, condition: Condition, digits: Tensor, state: Tensor, depth: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What the network sees instead of a clip's digits (B, T, S, C), normalised state (B, T, P) and
        normalised depth (B, T, S or 0).

        Against drift: noise, one-pass predictions of single frames, and whole rollouts from first frames.
        """
        network, progress = model.network, model.training_progress
        seen, seen_state = corrupt_digits(digits, network.codebook, self.config.token_noise), state
        share = forced_share(self.config.self_forcing, progress)
        if share > 0:
            guess = network(seen, seen_state, *condition, depth=depth)
            seen, seen_state, depth = force_predictions(
                guess, network.codebook, seen, seen_state, depth, share
            )
        rows = self_rollout_rows(self.config.self_rollout, progress, len(digits), digits.device)
        if len(rows):
            rolled, rolled_state, rolled_depth = self._roll_out_rows(model, rows, clip, condition)
            seen, seen_state = seen.index_copy(0, rows, rolled), seen_state.index_copy(0, rows, rolled_state)
            depth = depth.index_copy(0, rows, rolled_depth)
        return seen, seen_state, depth

    def _roll_out_rows(
        self, model: Any, rows: Tensor, clip: Clip, condition: Condition
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Clips `rows` imagined from their first frames: in float32 if they are learnt from in it, so that
        the format does not depend on how many rows a process has; else as imagination chooses."""
        tokens, mask = condition
        own = tokens[rows].float(), None if mask is None else mask[rows]
        exact = computing_dtype(clip.tokens.device) == torch.float32
        dtype = torch.float32 if exact else None
        steps = clip.tokens.shape[1] - 1
        depth = None if clip.depth is None else clip.depth[rows, 0]
        rolled: tuple[Tensor, Tensor, Tensor] = model.roll_out(
            clip.tokens[rows, 0], clip.state[rows, 0], own, steps, dtype, depth
        )
        return rolled

    @torch.no_grad()
    def predict(self, model: Any, clip: Clip, drawn: bool) -> Prediction:
        """Given the real frames until then; the logits cost next to nothing."""
        network = model.network
        digits, depth = network.codebook.codes(clip.tokens), network.depth.normalize(clip.depth, clip.tokens)
        prediction: Prediction = network(
            digits, model.normalize_state(clip.state), *model.condition(clip), depth=depth
        )
        return prediction

    def open_loop(
        self, model: Any, tokens: Tensor, state: Tensor, actions: Tensor, context: Context,
        depth: Tensor | None, generator: torch.Generator,
    ) -> OpenLoopPrediction:  # fmt: skip
        return open_loop_stepwise(model, tokens, state, actions, context, depth, generator)

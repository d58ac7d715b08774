"""Autoregressive dynamics: the inputs of a training step, the loss, and imagination."""

from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.common.precision import compute_in, computing_dtype
from lerobot_wmrl.data.clips import Clip, known_transitions
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.world_models.autoregressive.configuration import AutoregressiveConfig
from lerobot_wmrl.world_models.autoregressive.depth import DepthBranch, depth_loss, metres, normalize_depth
from lerobot_wmrl.world_models.autoregressive.keypoints import keypoint_loss
from lerobot_wmrl.world_models.autoregressive.maskgit import FirstPass, MaskGit
from lerobot_wmrl.world_models.autoregressive.network import NextFrameNetwork
from lerobot_wmrl.world_models.codebook import CodeBook
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.dynamics import Dynamics, Imagination, Imagined
from lerobot_wmrl.world_models.layers import FrameSizes, Prediction
from lerobot_wmrl.world_models.losses import corrupt_codes, next_frame_loss, weighted_frames

DEPTH_WEIGHT: Final = 1.0
"""Weight of the depth branch's loss."""

SELF_ROLLOUT_FROM: Final = 0.75
"""Share of the training after which self-rollouts begin. Before, the model's own frames leave the data within
a few steps."""


class Inputs(NamedTuple):
    """Inputs of the network for whole clips: codes (B, T, S, C), state (B, T, P) and depth (B, T, S or 0).

    State and depth are normalised.
    """

    codes: Tensor
    state: Tensor
    depth: Tensor


def replaced_share(target: float, progress: float) -> float:
    """Return the share of input frames to replace after `progress` (0 to 1) of the training.

    It is 0 in the first quarter, when predictions are noise, and has risen to `target` at half time.
    """
    return target * min(1.0, max(0.0, 4 * progress - 1))


def replace_by_predictions(
    guess: Prediction, next_depth: Tensor, codebook: CodeBook, real: Inputs, share: float
) -> Inputs:
    """Replace a share of the input frames by one-pass predictions of them: scheduled sampling in parallel."""
    predicted = codebook.most_likely(guess.logits[:, :-1])
    swap = torch.rand(real.codes.shape[:2], device=real.codes.device)[:, 1:] < share
    frames = torch.where(swap[..., None, None], predicted, real.codes[:, 1:])
    states, depths = (
        torch.where(swap[..., None], imagined[:, :-1].to(recorded.dtype), recorded[:, 1:])
        for imagined, recorded in ((guess.state, real.state), (next_depth, real.depth))
    )
    return Inputs(
        torch.cat([real.codes[:, :1], frames], 1),
        torch.cat([real.state[:, :1], states], 1),
        torch.cat([real.depth[:, :1], depths], 1),
    )


def self_rollout_rows(share: float, progress: float, batch: int, device: torch.device) -> Tensor:
    """Choose at random the clips that show rollouts instead of recorded frames. → rows (R,)"""
    if share <= 0 or progress < SELF_ROLLOUT_FROM:
        return torch.empty(0, dtype=torch.long, device=device)
    return (torch.rand(batch, device=device) < share).nonzero().squeeze(1)


@dataclass
class AutoregressiveImagination(Imagination):
    """Imaginations that see their own frames.

    depth (B, 1, S) is that of the newest ones, normalised; (B, 1, 0) without a depth branch.
    """

    depth: Tensor = field(default_factory=lambda: torch.empty(0))


class AutoregressiveDynamics(Dynamics):
    """Predict each frame from those before it, in imagination from imagined ones."""

    network: NextFrameNetwork

    def __init__(self, config: AutoregressiveConfig, sizes: FrameSizes) -> None:
        super().__init__()
        self.config = config
        self.network = NextFrameNetwork(config, sizes)
        if config.depth:
            self.network.depth = DepthBranch(config, sizes)
        self.maskgit: MaskGit | None = None
        if config.maskgit_steps:
            self.maskgit = MaskGit(config, self.network.codebook.channels)

    def loss(self, clip: Clip, condition: Condition, progress: float) -> tuple[Tensor, dict[str, float]]:
        """Eqs. 2-4, with part of the inputs replaced by the dynamics' own predictions."""
        network, codebook, config = self.network, self.network.codebook, self.config
        real = Inputs(codebook.codes(clip.tokens), clip.state, self._depth(clip.depth, clip.tokens))
        inputs = self.network_inputs(real, clip, condition, progress)
        torch.clear_autocast_cache()  # older torch keeps the casts made without gradients
        memory = network.clip_memory(real.codes.shape[1], real.codes.device)
        prediction, next_depth = network(inputs.codes, inputs.state, condition, memory, inputs.depth)
        known = known_transitions(clip.valid)  # (B, T − 1)
        target = weighted_frames(codebook, real.codes[:, 1:], real.codes[:, :-1], known)
        loss, metrics = next_frame_loss(prediction, codebook, target, clip)
        if self.maskgit is not None:
            first = FirstPass(inputs.codes, condition, prediction, next_depth, memory)
            draft_loss, parts = self.maskgit.loss(network, first, target.codes, target.weight)
            loss, metrics = loss + draft_loss, metrics | parts
        if network.depth is not None:
            error, parts = depth_loss(next_depth, real.depth, clip.valid)
            loss, metrics = loss + DEPTH_WEIGHT * error, metrics | parts
        if config.keypoint_weight > 0:
            logits = prediction.logits[:, :-1]
            error = keypoint_loss(logits, codebook, real.codes, clip.valid, network.num_cameras)
            loss = loss + config.keypoint_weight * error
            metrics["keypoint_loss"] = error.item()
        return loss, metrics

    @torch.no_grad()
    def network_inputs(self, real: Inputs, clip: Clip, condition: Condition, progress: float) -> Inputs:
        """Return what the network sees instead of the real frames.

        Against drift: noise, one-pass predictions of single frames, and whole rollouts from first frames.
        """
        inputs = real
        if self.training:
            inputs = real._replace(codes=corrupt_codes(real.codes, self.network.codebook))
        share = replaced_share(self.config.self_forcing, progress)
        if share > 0:
            guess, next_depth = self.network(inputs.codes, inputs.state, condition, depth=inputs.depth)
            inputs = replace_by_predictions(guess, next_depth, self.network.codebook, inputs, share)
        rows = self_rollout_rows(self.config.self_rollout, progress, len(real.codes), real.codes.device)
        if len(rows):
            rolled = self._roll_out_rows(rows, clip, condition)
            inputs = Inputs(*(a.index_copy(0, rows, b) for a, b in zip(inputs, rolled, strict=True)))
        return inputs

    def _roll_out_rows(self, rows: Tensor, clip: Clip, condition: Condition) -> Inputs:
        """Imagine the clips `rows` (R,) from their first frames, in float32 if training computes in it."""
        mask = None if condition.mask is None else condition.mask[rows]
        exact = computing_dtype(clip.tokens.device) == torch.float32
        depth = None if clip.depth is None else clip.depth[rows, 0]
        first = Frames(clip.tokens[rows, 0], clip.state[rows, 0], depth=depth)
        selected, steps = Condition(condition.tokens[rows].float(), mask), clip.tokens.shape[1] - 1
        return self.roll_out(first, selected, steps, torch.float32 if exact else None)

    @torch.no_grad()
    def roll_out(
        self, first: Frames, condition: Condition, steps: int, dtype: torch.dtype | None = None
    ) -> Inputs:
        """Imagine `steps` frames after the first one. → what the network sees of all, T = 1 + `steps`.

        condition (B, `steps` or more, M, D) or (B, 1, M, D), float32. Draws no random number.
        """
        imagination, tokens, mask = self.start(first, dtype), condition.tokens, condition.mask
        frames = [_newest(imagination)]
        for step in range(steps):
            now = tokens[:, step : step + 1] if tokens.shape[1] > 1 else tokens
            self.step(imagination, Condition(now, mask))
            frames.append(_newest(imagination))
        return Inputs(*(torch.cat(parts, 1) for parts in zip(*frames, strict=True)))

    @torch.no_grad()
    def predict(self, clip: Clip, condition: Condition, with_tokens: bool) -> Prediction:
        """Predict each frame from the real ones before it; logits cost little and are always there."""
        codes, depth = self.network.codebook.codes(clip.tokens), self._depth(clip.depth, clip.tokens)
        return self.network(codes, clip.state, condition, depth=depth)[0]

    def start(self, frames: Frames, dtype: torch.dtype | None = None) -> AutoregressiveImagination:
        """Begin at these frames, with an empty cache. ValueError if their depth is needed and missing."""
        codes, state, dtype = self._first(frames, dtype)
        cache = self.network.make_cache(len(codes), codes.device, dtype)
        depth = self._depth(frames.depth, frames.tokens)[:, None]
        return AutoregressiveImagination(codes, state, cache, frames.context, depth=depth)

    def show(self, imagination: Imagination, mask: Tensor, frames: Frames) -> None:
        """Replace the newest frames of the environments in `mask` (B,), their depth too."""
        assert isinstance(imagination, AutoregressiveImagination)
        super().show(imagination, mask, frames)
        depth = self._depth(frames.depth, frames.tokens)[:, None]
        imagination.depth.copy_(torch.where(mask[:, None, None], depth, imagination.depth))

    def newest(self, imagination: Imagination) -> Frames:
        """Return the newest frames, with their depth if there is a depth branch."""
        assert isinstance(imagination, AutoregressiveImagination)
        depth = None if self.network.depth is None else metres(imagination.depth[:, 0])
        return replace(super().newest(imagination), depth=depth)

    @torch.no_grad()
    def step(self, imagination: Imagination, condition: Condition) -> Imagined:
        """Predict from the newest frame and the cache, to which its keys and values are added."""
        assert isinstance(imagination, AutoregressiveImagination)
        network, codes, cache = self.network, imagination.codes, imagination.cache
        with compute_in(imagination.dtype, codes.device):
            prediction, depth = network(
                codes, imagination.state, condition, cache.advance(), imagination.depth
            )
            if self.maskgit is None:
                predicted = network.codebook.most_likely(prediction.logits)
            else:
                predicted = self.maskgit.decode(
                    network, FirstPass(codes, condition, prediction, depth, cache)
                )
        imagination.depth.copy_(depth)
        imagined = self._advance(imagination, prediction, predicted)
        return imagined if network.depth is None else imagined._replace(depth=metres(depth[:, 0]))

    def _depth(self, depth: Tensor | None, tokens: Tensor) -> Tensor:
        """Metres (…, S) of each of the tokens → normalised; (…, 0) without a depth branch."""
        if self.network.depth is None:
            return torch.zeros(*tokens.shape[:-1], 0, device=tokens.device)
        return normalize_depth(depth, tokens)


def _newest(imagination: AutoregressiveImagination) -> Inputs:
    """Copy the newest frames, which the next step overwrites in place."""
    return Inputs(imagination.codes.clone(), imagination.state.clone(), imagination.depth.clone())

"""Anchored dynamics: the loss, imagination, and open-loop prediction in one pass."""

from collections.abc import Callable
from typing import Final

import torch
from torch import Tensor

from lerobot_wmrl.common.precision import compute_in, imagination_dtype
from lerobot_wmrl.data.clips import Clip, known_transitions, take_steps
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.world_models.anchored.imagination import AnchoredImagination
from lerobot_wmrl.world_models.anchored.network import AnchoredNetwork
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.configuration_world_model import AnchoredConfig
from lerobot_wmrl.world_models.dynamics import Dynamics, Imagination, Imagined, OpenLoopPrediction
from lerobot_wmrl.world_models.kv_cache import KVCache
from lerobot_wmrl.world_models.layers import FrameSizes, Prediction
from lerobot_wmrl.world_models.losses import (
    FEATURE_WEIGHT,
    corrupt_codes,
    feature_loss,
    next_frame_loss,
    weighted_frames,
)
from lerobot_wmrl.world_models.success import PredictedSuccess

RENDERED_FRAMES: Final = 4
"""Frames of each clip, sampled at random, whose tokens a training step learns. Done and state are learnt from
all frames."""


def sample_steps(valid: Tensor, count: int) -> Tensor:
    """Sample `count` steps of each clip whose next frame is valid too: valid (B, T) → (B, count)."""
    chance = torch.rand(len(valid), count, device=valid.device)
    transitions = (valid[:, 1:].sum(1, keepdim=True)).clamp_min(1)
    return (chance * transitions).long().clamp_max(valid.shape[1] - 2)


class AnchoredDynamics(Dynamics):
    """Predict every frame from a first frame and the actions since."""

    network: AnchoredNetwork

    def __init__(self, config: AnchoredConfig, sizes: FrameSizes) -> None:
        super().__init__()
        self.network = AnchoredNetwork(config, sizes)

    def loss(self, clip: Clip, condition: Condition, progress: float) -> tuple[Tensor, dict[str, float]]:
        """Eqs. 2-4, with the tokens of `RENDERED_FRAMES` frames a clip.

        Those that differ from the first frame's count more. With a tokenizer that classifies success, the
        loss of the classifier's features takes the place of that of done, which is then only measured.
        """
        network, codebook = self.network, self.network.codebook
        codes = codebook.codes(clip.tokens)  # (B, T, S, C)
        steps = sample_steps(clip.valid, RENDERED_FRAMES)  # (B, K)
        first = corrupt_codes(codes[:, :1], codebook) if self.training else codes[:, :1]
        prediction = network(first, clip.state[:, :1], condition, codes.shape[1], steps, clip.context)
        known, target = (take_steps(x, steps) for x in (known_transitions(clip.valid), codes[:, 1:]))
        frames = weighted_frames(codebook, target, codes[:, :1], known)
        if not isinstance(network.done, PredictedSuccess):
            return next_frame_loss(prediction, codebook, frames, clip)
        features = FEATURE_WEIGHT * feature_loss(network.done.features(prediction.hidden), clip)
        prediction = prediction._replace(done_logit=prediction.done_logit.detach())
        loss, metrics = next_frame_loss(prediction, codebook, frames, clip)
        return loss + features, metrics | {"feature_loss": features.item() / FEATURE_WEIGHT}

    @torch.no_grad()
    def predict(self, clip: Clip, condition: Condition, with_tokens: bool) -> Prediction:
        """Predict each frame from the first one and the actions before it."""
        codes, length = self.network.codebook.codes(clip.tokens[:, :1]), clip.tokens.shape[1]
        steps = None if with_tokens else clip.tokens.new_empty(len(codes), 0)
        return self.network(codes, clip.state[:, :1], condition, length, steps, clip.context)

    def start(self, frames: Frames, dtype: torch.dtype | None = None) -> AnchoredImagination:
        """Begin at these frames. The scene is encoded in the first step, which needs their context."""
        network = self.network
        codes, state, dtype = self._first(frames, dtype)
        shape = (len(network.trajectory), len(codes), 1, network.heads, network.window, network.head_width)
        cache = KVCache.empty(shape, codes.device, dtype)
        return AnchoredImagination(codes, state, cache, frames.context, frames.instruction_weights)

    @torch.no_grad()
    def step(self, imagination: Imagination, condition: Condition) -> Imagined:
        """Predict the next frame; environments that begin encode their newest frame as the scene first."""
        assert isinstance(imagination, AnchoredImagination)
        network, codes, state = self.network, imagination.codes, imagination.state
        with compute_in(imagination.dtype, codes.device):
            rows = imagination.due()
            if len(rows):
                began = network.encode(codes[rows], state[rows], imagination.context[rows])
                imagination.begin(rows, *began)
            assert imagination.scene is not None
            assert imagination.rollout is not None
            prediction, rollout = network.follow(
                imagination.scene,
                imagination.rollout,
                condition.mean(),
                imagination.advance(),
                None,
                condition.instruction_weights,
            )
            imagination.rollout = rollout.last()
            codes = network.codebook.most_likely(prediction.logits)
        return self._advance(imagination, prediction, codes)

    @torch.no_grad()
    def open_loop(
        self, frames: Frames, actions: Tensor, encode: Callable[[Tensor], Condition], with_tokens: bool
    ) -> OpenLoopPrediction:
        """Predict in one pass that encodes each frame once and renders the last frames alone, if any.

        Step by step beyond the length of a clip.
        """
        network, codebook, length = self.network, self.network.codebook, actions.shape[1]
        if length > network.window:
            return super().open_loop(frames, actions, encode, with_tokens)
        codes, state, dtype = self._first(frames, imagination_dtype(actions.device, len(actions)))
        steps = torch.full((len(actions), int(with_tokens)), length - 1, device=codes.device)
        with compute_in(dtype, codes.device):
            prediction = network(codes, state, encode(actions), length, steps, frames.context)
        tokens = None
        if with_tokens:
            tokens = codebook.tokens(codebook.most_likely(prediction.logits.float())[:, 0])
        return OpenLoopPrediction(prediction.done_logit, prediction.state, tokens)

"""Anchored dynamics: the loss, imagination, and open-loop prediction in one pass."""

from collections.abc import Callable
from typing import Final

import torch
from torch import Tensor

from lerobot_wmrl.common.precision import compute_in
from lerobot_wmrl.data.clips import Clip, known_transitions, take_rows
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.world_models.anchored.imagination import AnchoredImagination
from lerobot_wmrl.world_models.anchored.network import AnchoredNetwork
from lerobot_wmrl.world_models.codebook import CodeBook
from lerobot_wmrl.world_models.configuration_world_model import AnchoredConfig
from lerobot_wmrl.world_models.dynamics import Dynamics, Imagination, Imagined, OpenLoopPrediction
from lerobot_wmrl.world_models.kv_cache import KVCache
from lerobot_wmrl.world_models.layers import Condition, FrameSizes, Prediction
from lerobot_wmrl.world_models.losses import TargetFrames, corrupt_codes, next_frame_loss, weighted_frames

DRAWN_FRAMES: Final = 4
"""Frames of each clip that a training step draws, at random. Done and state are learnt from all of them."""


def draw_rows(valid: Tensor, count: int) -> Tensor:
    """Draw `count` rows of each clip whose next one is valid too: valid (B, T) → (B, count)."""
    chance = torch.rand(len(valid), count, device=valid.device)
    transitions = (valid[:, 1:].sum(1, keepdim=True)).clamp_min(1)
    return (chance * transitions).long().clamp_max(valid.shape[1] - 2)


def frames_after(rows: Tensor, codes: Tensor, valid: Tensor, codebook: CodeBook) -> TargetFrames:
    """Return the frames after rows (B, K) of clips with codes (B, T, S, C), valid (B, T).

    Tokens that differ from the first frame count more.
    """
    known, target = (take_rows(x, rows) for x in (known_transitions(valid), codes[:, 1:]))
    return weighted_frames(codebook, target, codes[:, :1], known)


class AnchoredDynamics(Dynamics):
    """Predict every frame from the episode's first one and the actions since, never from imagined ones."""

    network: AnchoredNetwork

    def __init__(self, config: AnchoredConfig, sizes: FrameSizes) -> None:
        super().__init__()
        self.network = AnchoredNetwork(config, sizes)

    def loss(self, clip: Clip, condition: Condition, progress: float) -> tuple[Tensor, dict[str, float]]:
        """Eqs. 2-4, with the tokens of `DRAWN_FRAMES` frames a clip, and done and state of all frames."""
        network, codebook = self.network, self.network.codebook
        codes = codebook.codes(clip.tokens)  # (B, T, S, C)
        rows = draw_rows(clip.valid, DRAWN_FRAMES)  # (B, K)
        first = corrupt_codes(codes[:, :1], codebook)
        prediction = network(first, clip.state[:, :1], condition, codes.shape[1], rows, clip.context)
        target = frames_after(rows, codes, clip.valid, codebook)
        return next_frame_loss(prediction, codebook, target, clip)

    @torch.no_grad()
    def predict(self, clip: Clip, condition: Condition, drawn: bool) -> Prediction:
        """Predict each frame from the first one and the actions before it."""
        codes = self.network.codebook.codes(clip.tokens[:, :1])
        no_rows = torch.empty(len(codes), 0, dtype=torch.long, device=codes.device)
        rows, length = None if drawn else no_rows, clip.tokens.shape[1]
        prediction: Prediction = self.network(codes, clip.state[:, :1], condition, length, rows, clip.context)
        return prediction

    def start(self, frames: Frames, dtype: torch.dtype | None = None) -> AnchoredImagination:
        """Begin at these frames. The scene is encoded in the first step, which needs their context."""
        network = self.network
        codes, state, dtype = self._first(frames, dtype)
        shape = (len(network.trajectory), len(codes), 1, network.heads, network.window, network.head_width)
        return AnchoredImagination(codes, state, KVCache.empty(shape, codes.device, dtype), frames.context)

    @torch.no_grad()
    def step(self, imagination: Imagination, condition: Condition) -> Imagined:
        """Draw the next frame; environments that begin encode their newest frame as the scene first."""
        assert isinstance(imagination, AnchoredImagination)
        network, codes, state = self.network, imagination.codes, imagination.proprioception
        with compute_in(imagination.dtype, codes.device):
            rows = imagination.due()
            if len(rows):
                began = network.encode(codes[rows], state[rows], imagination.context[rows])
                imagination.begin(rows, *began)
            assert imagination.scene is not None
            assert imagination.rollout is not None
            prediction, rollout = network.follow(
                imagination.scene, imagination.rollout, condition.mean(), imagination.advance(), None
            )
            imagination.rollout = rollout.last()
            drawn = network.codebook.most_likely(prediction.logits)
        return self._advance(imagination, prediction, drawn)

    @torch.no_grad()
    def open_loop(
        self, frames: Frames, actions: Tensor, encode: Callable[[Tensor], Condition]
    ) -> OpenLoopPrediction:
        """Predict in one pass that draws the last frame alone; step by step beyond the length of a clip."""
        network, length = self.network, actions.shape[1]
        if length > network.window:
            return super().open_loop(frames, actions, encode)
        codes, state, dtype = self._first(frames, None)
        last = torch.full((len(codes), 1), length - 1, device=codes.device)
        with compute_in(dtype, codes.device):
            prediction = network(codes, state, encode(actions), length, last, frames.context)
        drawn = network.codebook.most_likely(prediction.logits.float())
        return OpenLoopPrediction(
            prediction.done_logit, prediction.proprioception, network.codebook.tokens(drawn[:, 0])
        )

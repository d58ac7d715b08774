"""MaskGIT decoding (Chang et al. 2022, section 3.2): confident tokens are fixed first, and others see them.

K passes a frame. The first is the pass that writes the KV cache and predicts the frame with all tokens
masked, so K = 1 is one-pass decoding, and done, state and cache come about the same way for every K. The
others look at a draft of the frame: tokens already fixed, and the frame before it wherever none is.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lerobot_wmrl.world_models.autoregressive.configuration import AutoregressiveConfig
from lerobot_wmrl.world_models.autoregressive.network import NextFrameNetwork
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.kv_cache import KVCache
from lerobot_wmrl.world_models.layers import ClipMemory, Prediction, Rotation
from lerobot_wmrl.world_models.losses import masked_mean


class FirstPass(NamedTuple):
    """The first pass over frames, which the others refine.

    Its inputs are codes (B, T, S, C) and the condition; its outputs the prediction of the next frames, their
    depth (B, T, S or 0), and the memory that it has filled.
    """

    codes: Tensor
    condition: Condition
    prediction: Prediction
    next_depth: Tensor
    memory: ClipMemory | KVCache


@dataclass
class DraftMemory:
    """Memory of drafts: each sees what the frame before it saw, and itself; no frame sees a draft.

    past: keys and values (B, S, h, K, d) by layer; mask broadcastable to (B, S, h, T, K).
    """

    past: dict[int, tuple[Tensor, Tensor]]
    mask: Tensor
    rotation: Rotation

    @classmethod
    def after(cls, memory: ClipMemory | KVCache) -> "DraftMemory":
        """Return the memory for drafts after each frame of a clip, or after the newest one of a cache."""
        if isinstance(memory, ClipMemory):
            rotation = Rotation.at(memory.positions + 1, memory.head_width)
            return cls(memory.keys_values, memory.mask, rotation)
        past = {layer: memory.past(layer) for layer in range(len(memory.keys))}
        return cls(past, memory.mask(), Rotation.at(memory.position, memory.keys.shape[-1]))

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Attend to the past and to the draft's own key, but to no other draft's. (B, S, h, T, d) each"""
        query, key = self.rotation(query), self.rotation(key)
        keys, values = self.past[layer]
        scores = (query @ keys.transpose(-1, -2)).masked_fill(~self.mask, float("-inf"))
        own_score = (query * key).sum(-1, keepdim=True)
        weights = (torch.cat([scores, own_score], -1) * query.shape[-1] ** -0.5).softmax(-1)
        return weights[..., :-1] @ values + weights[..., -1:] * value


def fixed_counts(tokens: int, passes: int) -> Sequence[int]:
    """Tokens that are fixed after each pass: all but cos(π/2 · k/K) of them, so few at first."""
    return [
        tokens - math.floor(tokens * math.cos(math.pi / 2 * done / passes)) for done in range(1, passes + 1)
    ]


def most_confident(confidence: Tensor, fixed: Tensor, count: int) -> Tensor:
    """Fix `count` tokens a frame: those already fixed and the most confident others. (…, S) → (…, S) bool"""
    best = confidence.masked_fill(fixed, math.inf).topk(count, -1).indices
    return torch.zeros_like(fixed).scatter(-1, best, True)


class MaskGit(nn.Module):
    """`maskgit_steps` passes a frame; in training, a second pass over drafts with a random share masked."""

    def __init__(self, config: AutoregressiveConfig, channels: int) -> None:
        super().__init__()
        self.passes = config.maskgit_steps
        self.mark = nn.Conv2d(1 + channels, config.code_width, 3, padding=1)
        self.role = nn.Parameter(torch.randn(config.width) * 0.02)

    def decode(self, network: NextFrameNetwork, first: FirstPass) -> Tensor:
        """Return the codes of the frames after those of the first pass, (B, T, S, C)."""
        codebook, logits, memory = network.codebook, first.prediction.logits, DraftMemory.after(first.memory)
        codes = codebook.most_likely(logits)
        fixed = torch.zeros_like(codes[..., 0], dtype=torch.bool)
        for count in fixed_counts(codes.shape[2], self.passes)[:-1]:
            fixed = most_confident(-codebook.cross_entropy(logits, codes), fixed, count)
            logits = self.draft_logits(network, first, memory, codes, fixed)
            codes = torch.where(fixed[..., None], codes, codebook.most_likely(logits))
        return codes

    def loss(
        self, network: NextFrameNetwork, first: FirstPass, target: Tensor, weight: Tensor
    ) -> tuple[Tensor, dict[str, float]]:
        """Cross-entropy of masked tokens; a frame's masked share is cos(π/2 · u), u uniform (eq. 1 there).

        The frame after the last one is unknown: the last one stands in for it, and does not count.

        Args:
            network: the one that made the first pass.
            first: pass over frames (B, T, …).
            target: codes (B, T − 1, S, C) of the frames after all but the last.
            weight: weight of their tokens, (B, T − 1, S).
        """
        following = torch.cat([target, first.codes[:, -1:]], 1)  # (B, T, S, C)
        chance = torch.rand(following.shape[:2], device=target.device)[..., None]
        masked = torch.rand(following.shape[:3], device=target.device) < (chance * math.pi / 2).cos()
        memory = DraftMemory.after(first.memory)
        logits = self.draft_logits(network, first, memory, following, ~masked)[:, :-1]
        losses = network.codebook.cross_entropy(logits.float(), target)
        loss = masked_mean(losses, weight * masked[:, :-1])
        return loss, {"draft_loss": loss.item()}

    def draft_logits(
        self, network: NextFrameNetwork, first: FirstPass, memory: DraftMemory, codes: Tensor, fixed: Tensor
    ) -> Tensor:
        """Logits (B, T, S, V) of the next frames, given those of their codes that are `fixed`."""
        draft = torch.where(fixed[..., None], codes, first.codes)
        known = fixed[..., None].float()
        values = network.codebook.values(draft)
        mark = self.mark(network.grids(torch.cat([known, known * values], -1)))
        state = first.prediction.state.detach()
        x, local = network.embed(draft, state, first.condition.mean(), mark)
        added, _ = network.predict_depth(first.next_depth.detach(), x[:, :, :1], first.condition, memory)
        hidden, _ = network.transformer(x + self.role, first.condition, memory, added)
        return network.token_logits(hidden, local, draft)

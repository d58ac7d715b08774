"""MaskGIT decoding (Chang et al. 2022, section 3.2): confident tokens are fixed first, and others see them.

K passes a frame. The first is the pass that writes the cache and predicts the frame with all tokens masked,
so K = 1 is one-pass decoding, and done, state and cache come about the same way for every K. The others look
at a draft of the frame: tokens already fixed, and the frame before it wherever none is.
"""

import math
from collections.abc import Sequence
from typing import Any, Final

import torch
from torch import Tensor, nn

from lerobot_wmrl.common.distributed import draw_own_rows, masked_mean
from lerobot_wmrl.world_models.codebook import gumbel
from lerobot_wmrl.world_models.conditioning import pooled
from lerobot_wmrl.world_models.decoding.shifted import FramesSeen, ShiftedDecoding
from lerobot_wmrl.world_models.next_frame import NextFrameNetwork
from lerobot_wmrl.world_models.temporal_memory import ClipMemory, DraftMemory, TemporalCache

CHOICE_TEMPERATURE: Final = 4.5
"""Of the noise on confidences, annealed to 0, as in the authors' code: without it, of two equally likely
codes the one that the network favours by a hair wins every time. Scaled by the temperature of sampling."""


def fixed_counts(tokens: int, passes: int) -> Sequence[int]:
    """Tokens that are fixed after each pass: all but cos(π/2 · k/K) of them, so few at first."""
    return [
        tokens - math.floor(tokens * math.cos(math.pi / 2 * done / passes)) for done in range(1, passes + 1)
    ]


def largest(confidence: Tensor, fixed: Tensor, count: int) -> Tensor:
    """Those already fixed and the most confident others, `count` a frame. (…, S) → (…, S) bool"""
    best = confidence.masked_fill(fixed, math.inf).topk(count, -1).indices
    return torch.zeros_like(fixed).scatter(-1, best, True)


def drafts_of(seen: FramesSeen) -> DraftMemory:
    """For drafts of the frames after those seen."""
    assert isinstance(seen.memory, ClipMemory | TemporalCache)  # all that an autoregressive network has
    return seen.memory.drafts()


class MaskGitDecoding(ShiftedDecoding):
    """`maskgit_steps` passes a frame; in training, a second pass over drafts with a random share masked."""

    def __init__(self, config: Any, channels: int) -> None:
        super().__init__(config, channels)
        self.passes = config.maskgit_steps
        self.mark = nn.Conv2d(1 + channels, config.code_width, 3, padding=1)
        self.role = nn.Parameter(torch.randn(config.width) * 0.02)

    def decode(
        self,
        network: Any,
        seen: FramesSeen,
        temperature: float,
        generator: torch.Generator | None,
    ) -> Tensor:
        codebook, logits, memory = network.codebook, seen.prediction.logits, drafts_of(seen)
        digits = codebook.sample(logits, temperature, generator)
        fixed = torch.zeros_like(digits[..., 0], dtype=torch.bool)
        for done, count in enumerate(fixed_counts(digits.shape[2], self.passes)[:-1], start=1):
            noise = CHOICE_TEMPERATURE * temperature * (1 - done / self.passes)
            confidence = -codebook.cross_entropy(logits, digits)
            fixed = largest(confidence + noise * gumbel(confidence, generator), fixed, count)
            logits = self.draft_logits(network, seen, memory, digits, fixed)
            drawn = codebook.sample(logits, temperature, generator)
            digits = torch.where(fixed[..., None], digits, drawn)
        return digits

    def loss(
        self, network: Any, seen: FramesSeen, target: Tensor, weight: Tensor
    ) -> tuple[Tensor, dict[str, float]]:
        """Cross-entropy of masked tokens; a frame's masked share is cos(π/2 · u), u uniform (eq. 1 there).

        The last frame's next one is unknown: its draft is made up, nobody sees it and it does not count.
        """
        following = torch.cat([target, seen.digits[:, -1:]], 1)
        chance = draw_own_rows(torch.rand, following.shape[:2], target.device)[..., None]
        drawn = draw_own_rows(torch.rand, following.shape[:3], target.device)
        masked = drawn < (chance * math.pi / 2).cos()
        logits = self.draft_logits(network, seen, drafts_of(seen), following, ~masked)[:, :-1]
        losses = network.codebook.cross_entropy(logits.float(), target)
        loss = masked_mean(losses, weight * masked[:, :-1])
        return loss, {"draft_loss": loss.item()}

    def draft_logits(
        self, network: NextFrameNetwork, seen: FramesSeen, memory: DraftMemory, digits: Tensor, fixed: Tensor
    ) -> Tensor:
        """Logits of the next frames, given those of their digits (B, T, S, C) that are `fixed` (B, T, S)."""
        draft = torch.where(fixed[..., None], digits, seen.digits)
        known = fixed[..., None].float()
        values = network.codebook.values(draft)
        mark = self.mark(network.grids(torch.cat([known, known * values], -1)))
        state = seen.prediction.proprioception.detach()
        x, local = network.embed(draft, state, pooled(*seen.condition), mark)
        fuse, _ = network.depth(seen.prediction.depth.detach(), x[:, :, :1], *seen.condition, memory)
        hidden = network.transformer(x + self.role, *seen.condition, memory, fuse)
        return network.token_logits(hidden, local, draft)

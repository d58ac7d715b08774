"""How a transformer block takes in the condition (eq. 1's c): one small module a kind.

A kind may modulate a block's three branches (space, time, MLP), change the tokens between time and MLP,
or both.
"""

from typing import Final, NamedTuple

from torch import Tensor, nn

from lerobot_wmrl.world_models.attention import attention


class ConditionTokens(NamedTuple):
    """tokens (B, T or 1, M, D), their mask (B, 1, 1, 1, M) or None, and their mean (B, T or 1, D)."""

    tokens: Tensor
    mask: Tensor | None
    mean: Tensor


def pooled(condition: Tensor, mask: Tensor | None) -> Tensor:
    """Mean of the condition tokens (B, T or 1, M, D) that mask (B, 1, 1, 1, M) keeps. → (B, T or 1, D)"""
    if mask is None:
        return condition.mean(2)
    kept = mask[:, :, 0, 0, :, None].to(condition.dtype)
    return (condition * kept).sum(2) / kept.sum(2).clamp_min(1)


class Branch:
    """A branch of a block as it is."""

    def enter(self, normed: Tensor) -> Tensor:
        """What the branch sees: (B, T, S, D) after its norm → same."""
        return normed

    def leave(self, update: Tensor) -> Tensor:
        """What the branch adds to the tokens: (B, T, S, D) → same."""
        return update


class ModulatedBranch(Branch):
    """A branch with scale, shift and gate, (B, T or 1, 1, D) each; 0 leaves it as it is."""

    def __init__(self, scale: Tensor, shift: Tensor, gate: Tensor) -> None:
        self.scale, self.shift, self.gate = scale, shift, gate

    def enter(self, normed: Tensor) -> Tensor:
        return normed * (1 + self.scale) + self.shift

    def leave(self, update: Tensor) -> Tensor:
        return update * (1 + self.gate)


class Conditioning(nn.Module):
    """Base: leaves branches and tokens as they are."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()

    def branches(self, condition: ConditionTokens) -> tuple[Branch, Branch, Branch]:
        """Of space, time and MLP."""
        return Branch(), Branch(), Branch()

    def forward(self, x: Tensor, condition: ConditionTokens) -> Tensor:
        """Tokens (B, T, S, D) between time and MLP → same."""
        return x


class CrossAttention(Conditioning):
    """Tokens ask the condition (the paper's way)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__(width, heads)
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.query = nn.Linear(width, width, bias=False)
        self.key_value = nn.Linear(width, 2 * width, bias=False)
        self.out = nn.Linear(width, width)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: Tensor, condition: ConditionTokens) -> Tensor:
        return x + self.ask(x, self.offer(condition.tokens), condition.mask)

    def offer(self, tokens: Tensor) -> Tensor:
        """Keys and values of the condition's tokens (B, T or 1, M, D). → (B, T or 1, 2, h, M, d)"""
        return self.key_value(tokens).unflatten(-1, (2, self.heads, -1)).movedim(-4, -2)

    def ask(self, x: Tensor, offered: Tensor, mask: Tensor | None = None) -> Tensor:
        """What tokens (B, T, S, D) take from what is offered to them. → same"""
        query = self.query(self.norm(x)).unflatten(-1, (self.heads, -1)).transpose(-2, -3)
        key, value = offered.unbind(-4)
        return self.out(attention(query, key, value, mask).transpose(-2, -3).flatten(-2))


class AdaptiveLayerNorm(Conditioning):
    """The condition's mean scales, shifts and gates the branches (Peebles & Xie 2023, adaLN).

    Zero-initialised around 1: the gates of their adaLN-Zero begin at 0, but here the attentions' output
    layers do already, and two zeros in a row would never learn.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__(width, heads)
        self.modulation = nn.Linear(width, 9 * width)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def branches(self, condition: ConditionTokens) -> tuple[Branch, Branch, Branch]:
        parts = self.modulation(nn.functional.silu(condition.mean))[:, :, None].chunk(9, -1)
        return ModulatedBranch(*parts[:3]), ModulatedBranch(*parts[3:6]), ModulatedBranch(*parts[6:])


class AddedCondition(Conditioning):
    """The condition's mean, projected, is added to every token of its frame."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__(width, heads)
        self.project = nn.Linear(width, width)

    def forward(self, x: Tensor, condition: ConditionTokens) -> Tensor:
        return x + self.project(condition.mean)[:, :, None]


CONDITIONINGS: Final[dict[str, type[Conditioning]]] = {
    "cross_attention": CrossAttention,
    "adaln": AdaptiveLayerNorm,
    "additive": AddedCondition,
}


def make_conditioning(kind: str, width: int, heads: int) -> Conditioning:
    """One block's conditioning. ValueError for an unknown kind."""
    if kind not in CONDITIONINGS:
        raise ValueError(f"--model.conditioning={kind}: choose one of {', '.join(CONDITIONINGS)}")
    return CONDITIONINGS[kind](width, heads)

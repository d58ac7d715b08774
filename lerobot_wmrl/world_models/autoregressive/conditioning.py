"""How a transformer block takes in the condition (eq. 1's c): one small module a kind.

A kind may modulate a block's three branches (space, time, MLP), change the tokens between time and MLP,
or both.
"""

from typing import Final

from torch import Tensor, nn

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.world_models.dynamics import Condition
from lerobot_wmrl.world_models.layers import CrossAttention


class Branch:
    """A branch of a block as it is."""

    def enter(self, normed: Tensor) -> Tensor:
        """Return what the branch sees: (B, T, S, D) after its norm → same."""
        return normed

    def leave(self, update: Tensor) -> Tensor:
        """Return what the branch adds to the tokens: (B, T, S, D) → same."""
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
    """Base: leaves branches and tokens as they are. The mean (B, T or 1, D) is the condition's."""

    def branches(self, mean: Tensor) -> tuple[Branch, Branch, Branch]:
        """Return the branches of space, time and MLP."""
        return Branch(), Branch(), Branch()

    def forward(self, x: Tensor, condition: Condition, mean: Tensor) -> Tensor:
        """Condition the tokens (B, T, S, D) between time and MLP. → same"""
        return x


class CrossAttentionConditioning(Conditioning):
    """Tokens attend to the condition's (the paper's way)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attention = CrossAttention(width, heads)

    def forward(self, x: Tensor, condition: Condition, mean: Tensor) -> Tensor:
        keys_values = self.attention.project_kv(condition.tokens)
        return x + self.attention.cross_attend(x, keys_values, condition.mask)


class AdaptiveLayerNorm(Conditioning):
    """The condition's mean scales, shifts and gates the branches (Peebles & Xie 2023, adaLN).

    Zero-initialised around 1: the gates of their adaLN-Zero begin at 0, but here the attentions' output
    layers do already, and two zeros in a row would never learn.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.modulation = nn.Linear(width, 9 * width)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def branches(self, mean: Tensor) -> tuple[Branch, Branch, Branch]:
        parts = self.modulation(nn.functional.silu(mean))[:, :, None].chunk(9, -1)
        return ModulatedBranch(*parts[:3]), ModulatedBranch(*parts[3:6]), ModulatedBranch(*parts[6:])


class AddedCondition(Conditioning):
    """The condition's mean, projected, is added to every token of its frame."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.project = nn.Linear(width, width)

    def forward(self, x: Tensor, condition: Condition, mean: Tensor) -> Tensor:
        return x + self.project(mean)[:, :, None]


CONDITIONINGS: Final[dict[str, type[Conditioning]]] = {
    "cross_attention": CrossAttentionConditioning,
    "adaln": AdaptiveLayerNorm,
    "additive": AddedCondition,
}


def make_conditioning(kind: str, width: int, heads: int) -> Conditioning:
    """Make one block's conditioning. FieldError for an unknown kind."""
    if kind not in CONDITIONINGS:
        raise FieldError(
            "dynamics.conditioning", kind, "no such conditioning", f"choose one of {', '.join(CONDITIONINGS)}"
        )
    return CONDITIONINGS[kind](width, heads)

"""What training does against drift: inputs that are the model's own predictions of single frames."""

from typing import Final, NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.world_models.codebook import CodeBook
from lerobot_wmrl.world_models.dynamics import Prediction

SELF_ROLLOUT_FROM: Final = 0.75
"""Progress of the training after which clips are replaced by rollouts: earlier ones soon leave the data."""


class Inputs(NamedTuple):
    """What the network sees of clips: codes (B, T, S, C), state (B, T, P) and depth (B, T, S or 0).

    State and depth are normalised.
    """

    codes: Tensor
    state: Tensor
    depth: Tensor


def forced_share(target: float, progress: float) -> float:
    """Share of input frames to replace after `progress` (0 to 1) of the training.

    None in the first quarter, when predictions are noise, then rising to `target` at half time.
    """
    return target * min(1.0, max(0.0, 4 * progress - 1))


def force_predictions(
    guess: Prediction, next_depth: Tensor, codebook: CodeBook, real: Inputs, share: float
) -> Inputs:
    """Replace a share of the input frames by one-pass predictions of them: scheduled sampling in parallel."""
    predicted = codebook.most_likely(guess.logits[:, :-1])
    swap = torch.rand(real.codes.shape[:2], device=real.codes.device)[:, 1:] < share
    frames = torch.where(swap[..., None, None], predicted, real.codes[:, 1:])
    states, depths = (
        torch.where(swap[..., None], own[:, :-1].to(seen.dtype), seen[:, 1:])
        for own, seen in ((guess.proprioception, real.state), (next_depth, real.depth))
    )
    return Inputs(
        torch.cat([real.codes[:, :1], frames], 1),
        torch.cat([real.state[:, :1], states], 1),
        torch.cat([real.depth[:, :1], depths], 1),
    )


def self_rollout_rows(share: float, progress: float, batch: int, device: torch.device) -> Tensor:
    """Draw the clips that show rollouts instead of real frames, after `progress` (0 to 1). → rows (R,)"""
    if share <= 0 or progress < SELF_ROLLOUT_FROM:
        return torch.empty(0, dtype=torch.long, device=device)
    return (torch.rand(batch, device=device) < share).nonzero().squeeze(1)

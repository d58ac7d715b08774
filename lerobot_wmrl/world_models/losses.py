"""Training losses of the next-frame network, and the corruption of its inputs against drift."""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from lerobot_wmrl.common.distributed import draw_own_rows, masked_mean
from lerobot_wmrl.data.clips import Clip, known_transitions, take_rows
from lerobot_wmrl.world_models.codebook import CodeBook
from lerobot_wmrl.world_models.frame_network import STATE_STEP, Prediction

MOTION_LEVELS = 3
"""A token moves when its code changes by so many steps, FSQ's levels or LFQ's signs; less is mostly the
codes' own flicker."""

STATE_PRECISION = 0.1
"""Where the state loss turns from squared to absolute, in `STATE_STEP`s: about a millimetre of the TCP."""

SELF_ROLLOUT_FROM = 0.75
"""Progress of the training after which clips are replaced by rollouts: earlier ones soon leave the data."""


def corrupt_digits(digits: Tensor, codebook: CodeBook, share: float) -> Tensor:
    """Move a share of the code factors (…, C) by one step, so that small errors are met in training."""
    if share <= 0:
        return digits
    neighbors = codebook.neighbors(digits)
    hit = draw_own_rows(torch.rand, digits.shape, digits.device) < share
    return torch.where(hit, neighbors, digits)


def forced_share(target: float, progress: float) -> float:
    """Share of input frames to replace after `progress` (0 to 1) of the training: none in the first
    quarter, when predictions are noise, then rising to `target` at half time."""
    return target * min(1.0, max(0.0, 4 * progress - 1))


def self_rollout_rows(share: float, progress: float, batch: int, device: torch.device) -> Tensor:
    """Indices of the clips that show rollouts instead of real frames, after `progress` (0 to 1)."""
    if share <= 0 or progress < SELF_ROLLOUT_FROM:
        return torch.empty(0, dtype=torch.long, device=device)
    return (draw_own_rows(torch.rand, (batch,), device) < share).nonzero().squeeze(1)


def force_predictions(
    guess: Prediction, codebook: CodeBook, digits: Tensor, state: Tensor, depth: Tensor, share: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Scheduled sampling in parallel: replace a share of the input frames by one-pass predictions of them."""
    predicted = codebook.sample(guess.logits[:, :-1], 0.0, None)
    swap = draw_own_rows(torch.rand, digits.shape[:2], digits.device)[:, 1:] < share
    frames = torch.where(swap[..., None, None], predicted, digits[:, 1:])
    states, depths = (
        torch.where(swap[..., None], own[:, :-1].to(real.dtype), real[:, 1:])
        for own, real in ((guess.proprioception, state), (guess.depth, depth))
    )
    return (
        torch.cat([digits[:, :1], frames], 1),
        torch.cat([state[:, :1], states], 1),
        torch.cat([depth[:, :1], depths], 1),
    )


class NextFrames(NamedTuple):
    """K frames a clip that are to be predicted: digits (B, K, S, C); of their tokens, (B, K, S), what each
    counts, 0 for padding, and which are of valid frames that move."""

    digits: Tensor
    weight: Tensor
    moved: Tensor


def weighted_frames(
    codebook: CodeBook, target: Tensor, reference: Tensor, known: Tensor, motion_weight: float
) -> NextFrames:
    """Frames with digits `target` (B, K, S, C), of which those `known` (B, K) count; tokens that are not as
    in `reference` (B, K or 1, S, C) count `motion_weight` times more."""
    moved = known[..., None] & (codebook.distance(target, reference) >= MOTION_LEVELS)
    return NextFrames(target, (1 + motion_weight * moved) * known[..., None].float(), moved)


def next_frames(codebook: CodeBook, digits: Tensor, clip: Clip, motion_weight: float) -> NextFrames:
    """Frames 1 … T − 1 of clips with digits (B, T, S, C).

    Tokens that move count `motion_weight` times more: most of a frame is still, and what moves decides.
    """
    known = known_transitions(clip.valid)
    return weighted_frames(codebook, digits[:, 1:], digits[:, :-1], known, motion_weight)


def frames_since_start(
    codebook: CodeBook, digits: Tensor, clip: Clip, motion_weight: float, rows: Tensor
) -> NextFrames:
    """The frames after rows (B, K) of clips with digits (B, T, S, C).

    Tokens that are not as in the first frame count `motion_weight` times more.
    """
    known, target = (take_rows(x, rows) for x in (known_transitions(clip.valid), digits[:, 1:]))
    return weighted_frames(codebook, target, digits[:, :1], known, motion_weight)


def draw_rows(valid: Tensor, count: int) -> Tensor:
    """`count` rows of each clip whose next one is valid too, at random: valid (B, T) → (B, count)."""
    chance = draw_own_rows(torch.rand, (len(valid), count), valid.device)
    transitions = (valid[:, 1:].sum(1, keepdim=True)).clamp_min(1)
    return (chance * transitions).long().clamp_max(valid.shape[1] - 2)


def next_frame_loss(
    prediction: Prediction, codebook: CodeBook, frames: NextFrames, state: Tensor, clip: Clip, config: Any
) -> tuple[Tensor, dict[str, float]]:
    """Cross-entropy of the next tokens (eq. 2), done (eqs. 3, 4 with BCE) and the next state.

    Computed in float32, whatever the network computes in. `frames`: those that the first logits are of.
    """
    prediction = Prediction(*(output.float() for output in prediction))
    logits = prediction.logits[:, : frames.digits.shape[1]]
    token_loss = masked_mean(codebook.cross_entropy(logits, frames.digits), frames.weight)
    state_error = (prediction.proprioception[:, :-1] - state[:, 1:]) / STATE_STEP
    state_losses = F.smooth_l1_loss(
        state_error, torch.zeros_like(state_error), reduction="none", beta=STATE_PRECISION
    )
    known = known_transitions(clip.valid)[..., None]
    state_loss = masked_mean(state_losses, known.expand_as(state_losses))
    done_loss = masked_done_loss(prediction.done_logit, clip, config.done_positive_weight)
    loss = token_loss + config.done_weight * done_loss + config.state_weight * state_loss
    right = (codebook.sample(logits.detach(), 0.0, None) == frames.digits).all(-1)
    return loss, {
        "token_loss": token_loss.item(),
        "done_loss": done_loss.item(),
        "state_loss": state_loss.item(),
        "token_accuracy": masked_mean(right, frames.weight > 0).item(),
        "moving_token_accuracy": masked_mean(right, frames.moved).item(),
    }


def masked_done_loss(done_logit: Tensor, clip: Clip, positive_weight: float) -> Tensor:
    """BCE over the rows whose outcome is known; the rare class counts `positive_weight` times."""
    losses = F.binary_cross_entropy_with_logits(
        done_logit,
        clip.done,
        reduction="none",
        pos_weight=torch.tensor(positive_weight, device=done_logit.device),
    )
    return masked_mean(losses, clip.done_known & clip.valid)

"""The loss that both kinds of dynamics share (eqs. 2-4), and the noise on their inputs."""

from typing import Final, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from lerobot_wmrl.data.clips import Clip, known_transitions
from lerobot_wmrl.world_models.codebook import CodeBook
from lerobot_wmrl.world_models.layers import STATE_STEP, Prediction

STATE_WEIGHT: Final = 4.0
"""Weight of the state's loss beside those of tokens and done, which count 1."""

MOVING_TOKEN_WEIGHT: Final = 1.0
"""Extra weight of a token that moves. If it is high, the model imagines motion that does not happen, such as
objects that move although the hand misses them."""

MOTION_LEVELS: Final = 3
"""Steps (levels of FSQ, signs of LFQ) by which a token's codes must change to count as motion. Smaller
changes are mostly noise of the tokenizer."""

FEATURE_WEIGHT: Final = 4.0
"""Weight of the loss of the success classifier's features."""

FEATURE_BETA: Final = 0.3
"""Beta of their smooth L1 loss, in their standard deviations."""

STATE_BETA: Final = 0.1
"""Beta of the state's smooth L1 loss, in `STATE_STEP`s: about a millimetre."""

TOKEN_NOISE = 0.02
"""Share of input code factors moved by one step in training: a level of FSQ, a sign of LFQ."""


def masked_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Σ values · weight / Σ weight, weight broadcastable to values → (); 0 where nothing counts."""
    return (values * weight).sum() / weight.expand_as(values).sum().float().clamp_min(1)


def corrupt_codes(codes: Tensor, codebook: CodeBook) -> Tensor:
    """Move `TOKEN_NOISE` of the code factors (…, C) by one step, so that training meets small errors."""
    if TOKEN_NOISE <= 0:
        return codes
    neighbors = codebook.neighbors(codes)
    hit = torch.rand(codes.shape, device=codes.device) < TOKEN_NOISE
    return torch.where(hit, neighbors, codes)


class TargetFrames(NamedTuple):
    """Targets of the token loss: K frames of every clip.

    codes (B, K, S, C); weight (B, K, S) of each token, 0 for padding; moved (B, K, S), tokens of valid frames
    that move.
    """

    codes: Tensor
    weight: Tensor
    moved: Tensor


def weighted_frames(codebook: CodeBook, target: Tensor, reference: Tensor, known: Tensor) -> TargetFrames:
    """Give the tokens of target frames their weights in the loss.

    Most tokens do not move, and those that do decide success, so they count more.

    Args:
        codebook: measures how far codes are apart.
        target: codes of the frames, (B, K, S, C).
        reference: codes from which motion is measured, (B, K or 1, S, C).
        known: (B, K), False for frames that do not count.
    """
    moved = known[..., None] & (codebook.distance(target, reference) >= MOTION_LEVELS)
    return TargetFrames(target, (1 + MOVING_TOKEN_WEIGHT * moved) * known[..., None].float(), moved)


def next_frame_loss(
    prediction: Prediction, codebook: CodeBook, target: TargetFrames, clip: Clip
) -> tuple[Tensor, dict[str, float]]:
    """Cross-entropy of the next tokens (eq. 2), done (eqs. 3, 4 with BCE) and the next state.

    Computed in float32, whatever the network computes in.

    Args:
        prediction: prediction for every row of the clip. Its first K logits are of the target frames, in
            their order.
        codebook: code book of the tokens.
        target: the frames whose tokens are learnt.
        clip: clip with normalised states.

    Returns:
        The loss (), and its parts by name.
    """
    prediction = Prediction(*(output.float() for output in prediction))
    logits = prediction.logits[:, : target.codes.shape[1]]
    token_loss = masked_mean(codebook.cross_entropy(logits, target.codes), target.weight)
    state_loss = next_state_loss(prediction.state, clip)
    weight = prediction.done_logit.new_tensor(clip.done_pos_weight)
    done = F.binary_cross_entropy_with_logits(
        prediction.done_logit, clip.done, reduction="none", pos_weight=weight
    )
    done_loss = masked_mean(done, clip.done_known & clip.valid)
    loss = token_loss + done_loss + STATE_WEIGHT * state_loss
    right = (codebook.most_likely(logits.detach()) == target.codes).all(-1)
    return loss, {
        "token_loss": token_loss.item(),
        "done_loss": done_loss.item(),
        "state_loss": state_loss.item(),
        "token_accuracy": masked_mean(right, target.weight > 0).item(),
        "moving_token_accuracy": masked_mean(right, target.moved).item(),
    }


def feature_loss(predicted: Tensor, clip: Clip) -> Tensor:
    """Smooth L1 of predicted features (B, T, F) against those of the next rows, averaged over F. → ()"""
    assert clip.features is not None
    losses = F.smooth_l1_loss(
        predicted[:, :-1].float(), clip.features[:, 1:], reduction="none", beta=FEATURE_BETA
    )
    return masked_mean(losses, known_transitions(clip.valid)[..., None])


def next_state_loss(predicted: Tensor, clip: Clip) -> Tensor:
    """Smooth L1 of predicted states (B, T, P) against those of the next rows, in `STATE_STEP`s. → ()"""
    error = (predicted[:, :-1] - clip.state[:, 1:]) / STATE_STEP
    losses = F.smooth_l1_loss(error, torch.zeros_like(error), reduction="none", beta=STATE_BETA)
    return masked_mean(losses, known_transitions(clip.valid)[..., None])

from types import SimpleNamespace

import torch

from lerobot_wmrl.data.clips import Clip
from lerobot_wmrl.world_models.codebook import CodeBook
from lerobot_wmrl.world_models.frame_network import Prediction
from lerobot_wmrl.world_models.losses import (
    corrupt_digits,
    force_predictions,
    next_frame_loss,
    next_frames,
)

CONFIG = SimpleNamespace(motion_weight=3.0, done_weight=1.0, done_positive_weight=2.0, state_weight=1.0)
CODEBOOK = CodeBook((4, 3))


def clip_and_prediction(valid: torch.Tensor) -> tuple[Clip, Prediction, torch.Tensor]:
    torch.manual_seed(0)
    tokens = torch.randint(0, 12, (2, 5, 6))
    flags = torch.ones(2, 5, dtype=torch.bool)
    clip = Clip(tokens, torch.randn(2, 5, 3), torch.zeros(2, 5, 7), torch.zeros(2, 5), valid, flags, ["", ""])
    prediction = Prediction(
        torch.randn(2, 5, 6, 7),
        torch.randn(2, 5),
        torch.randn(2, 5, 3),
        torch.zeros(2, 5, 8),
        torch.randn(2, 5, 6),
    )
    return clip, prediction, CODEBOOK.codes(tokens)


def loss_of(
    prediction: Prediction, digits: torch.Tensor, clip: Clip
) -> tuple[torch.Tensor, dict[str, float]]:
    frames = next_frames(CODEBOOK, digits, clip, CONFIG.motion_weight)
    return next_frame_loss(prediction, CODEBOOK, frames, clip.state, clip, CONFIG)


def test_padding_does_not_count():
    valid = torch.tensor([[True] * 5, [True] * 3 + [False] * 2])
    clip, prediction, digits = clip_and_prediction(valid)
    loss, _ = loss_of(prediction, digits, clip)
    for tensor in prediction[:3]:
        tensor[1, 3:] += 100
    prediction.logits[1, 2] += torch.randn(6, 7)
    prediction.proprioception[1, 2] += 5
    digits[1, 3:] = 0
    again, _ = loss_of(prediction, digits, clip)
    torch.testing.assert_close(loss, again)


def test_no_transition_is_learnt_out_of_padding_before_an_episode():
    """LeRobot pads a window that begins before its episode by repeating the first frame."""
    valid = torch.tensor([[False, False, True, True, True], [True] * 5])
    clip, prediction, digits = clip_and_prediction(valid)
    loss, _ = loss_of(prediction, digits, clip)
    for tensor in (prediction.logits, prediction.proprioception):
        tensor[0, 1] += torch.randn_like(tensor[0, 1])
    again, _ = loss_of(prediction, digits, clip)
    torch.testing.assert_close(loss, again)


def test_perfect_predictions_cost_nothing_and_are_for_the_next_frame():
    clip, prediction, digits = clip_and_prediction(torch.ones(2, 5, dtype=torch.bool))
    logits = torch.roll(CODEBOOK.one_hot(digits), -1, 1) * 100
    state = torch.roll(clip.state, -1, 1)
    perfect = Prediction(logits, torch.full((2, 5), -50.0), state, prediction.hidden, prediction.depth)
    loss, metrics = loss_of(perfect, digits, clip)
    assert loss.item() < 1e-6
    assert metrics["token_accuracy"] == 1
    assert metrics["moving_token_accuracy"] == 1


def test_unknown_outcomes_do_not_train_done():
    clip, prediction, digits = clip_and_prediction(torch.ones(2, 5, dtype=torch.bool))
    clip = clip._replace(done_known=torch.zeros(2, 5, dtype=torch.bool))
    _, metrics = loss_of(prediction, digits, clip)
    assert metrics["done_loss"] == 0


def test_forcing_replaces_later_frames_only_and_only_by_predictions():
    clip, prediction, digits = clip_and_prediction(torch.ones(2, 5, dtype=torch.bool))
    depth = torch.randn(2, 5, 6)
    seen, state, seen_depth = force_predictions(prediction, CODEBOOK, digits, clip.state, depth, share=1.0)
    assert torch.equal(seen[:, 0], digits[:, 0])
    assert torch.equal(state[:, 0], clip.state[:, 0])
    assert torch.equal(seen[:, 1:], CODEBOOK.sample(prediction.logits[:, :-1], 0.0, None))
    assert torch.equal(state[:, 1:], prediction.proprioception[:, :-1])
    assert torch.equal(seen_depth, torch.cat([depth[:, :1], prediction.depth[:, :-1]], 1))


def test_corruption_moves_a_share_of_the_factors_by_one_level():
    digits = torch.randint(1, 3, (20_000, 2))
    noisy = corrupt_digits(digits, CodeBook((4, 4)), 0.1)
    assert (noisy - digits).abs().max() == 1
    assert 0.09 < (noisy != digits).float().mean() < 0.11

import pytest
import torch

from lerobot_wmrl.data.clips import Clip, known_transitions
from lerobot_wmrl.world_models import losses
from lerobot_wmrl.world_models.autoregressive.dynamics import Inputs, replace_by_predictions
from lerobot_wmrl.world_models.codebook import CodeBook
from lerobot_wmrl.world_models.layers import Prediction
from lerobot_wmrl.world_models.losses import corrupt_codes, next_frame_loss, weighted_frames

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
    )
    return clip, prediction, CODEBOOK.codes(tokens)


def loss_of(prediction: Prediction, codes: torch.Tensor, clip: Clip) -> tuple[torch.Tensor, dict[str, float]]:
    target = weighted_frames(CODEBOOK, codes[:, 1:], codes[:, :-1], known_transitions(clip.valid))
    return next_frame_loss(prediction, CODEBOOK, target, clip)


@pytest.fixture(autouse=True)
def moving_tokens_count_more(monkeypatch):
    monkeypatch.setattr(losses, "MOVING_TOKEN_WEIGHT", 3.0)


def test_padding_does_not_count():
    valid = torch.tensor([[True] * 5, [True] * 3 + [False] * 2])
    clip, prediction, codes = clip_and_prediction(valid)
    loss, _ = loss_of(prediction, codes, clip)
    for tensor in prediction[:3]:
        tensor[1, 3:] += 100
    prediction.logits[1, 2] += torch.randn(6, 7)
    prediction.state[1, 2] += 5
    codes[1, 3:] = 0
    again, _ = loss_of(prediction, codes, clip)
    torch.testing.assert_close(loss, again)


def test_no_transition_is_learnt_out_of_padding_before_an_episode():
    """LeRobot pads a window that begins before its episode by repeating the first frame."""
    valid = torch.tensor([[False, False, True, True, True], [True] * 5])
    clip, prediction, codes = clip_and_prediction(valid)
    loss, _ = loss_of(prediction, codes, clip)
    for tensor in (prediction.logits, prediction.state):
        tensor[0, 1] += torch.randn_like(tensor[0, 1])
    again, _ = loss_of(prediction, codes, clip)
    torch.testing.assert_close(loss, again)


def test_perfect_predictions_cost_nothing_and_are_for_the_next_frame():
    clip, prediction, codes = clip_and_prediction(torch.ones(2, 5, dtype=torch.bool))
    logits = torch.roll(CODEBOOK.one_hot(codes), -1, 1) * 100
    state = torch.roll(clip.state, -1, 1)
    perfect = Prediction(logits, torch.full((2, 5), -50.0), state, prediction.hidden)
    loss, metrics = loss_of(perfect, codes, clip)
    assert loss.item() < 1e-6
    assert metrics["token_accuracy"] == 1
    assert metrics["moving_token_accuracy"] == 1


def test_unknown_outcomes_do_not_train_done():
    clip, prediction, codes = clip_and_prediction(torch.ones(2, 5, dtype=torch.bool))
    clip = clip._replace(done_known=torch.zeros(2, 5, dtype=torch.bool))
    _, metrics = loss_of(prediction, codes, clip)
    assert metrics["done_loss"] == 0


def test_rare_success_counts_more_in_the_loss_of_done():
    clip, prediction, codes = clip_and_prediction(torch.ones(2, 5, dtype=torch.bool))
    missed = prediction._replace(done_logit=torch.full((2, 5), -20.0))
    clip = clip._replace(done=torch.eye(5)[:2], done_pos_weight=7.0)
    _, metrics = loss_of(missed, codes, clip)
    assert metrics["done_loss"] == pytest.approx(7 * 20 * 2 / 10)


def test_forcing_replaces_later_frames_only_and_only_by_predictions():
    clip, prediction, codes = clip_and_prediction(torch.ones(2, 5, dtype=torch.bool))
    depth, next_depth = torch.randn(2, 5, 6), torch.randn(2, 5, 6)
    real = Inputs(codes, clip.state, depth)
    seen = replace_by_predictions(prediction, next_depth, CODEBOOK, real, share=1.0)
    for replaced, first in zip(seen, real, strict=True):
        assert torch.equal(replaced[:, 0], first[:, 0])
    assert torch.equal(seen.codes[:, 1:], CODEBOOK.most_likely(prediction.logits[:, :-1]))
    assert torch.equal(seen.state[:, 1:], prediction.state[:, :-1])
    assert torch.equal(seen.depth[:, 1:], next_depth[:, :-1])


def test_corruption_moves_a_share_of_the_factors_by_one_level(monkeypatch):
    monkeypatch.setattr(losses, "TOKEN_NOISE", 0.1)
    codes = torch.randint(1, 3, (20_000, 2))
    noisy = corrupt_codes(codes, CodeBook((4, 4)))
    assert (noisy - codes).abs().max() == 1
    assert 0.09 < (noisy != codes).float().mean() < 0.11

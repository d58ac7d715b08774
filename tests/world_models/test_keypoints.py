import pytest
import torch
from torch import Tensor

from lerobot_wmrl.common.precision import compute_in
from lerobot_wmrl.world_models.autoregressive.keypoints import (
    KEYPOINTS,
    Tracks,
    keypoint_loss,
    most_active,
    surroundings,
    track_tokens,
)
from lerobot_wmrl.world_models.codebook import CodeBook, make_codebook

GRID, TIME, START = 6, 4, 13
CODEBOOK = CodeBook((5, 5, 5))
AROUND = surroundings(GRID, 1, torch.device("cpu"))
VALID = torch.ones(1, TIME, dtype=torch.bool)


def crossing() -> Tensor:
    """A token unlike any other goes right, one place a frame, over a background that stays. (1, T, S, C)"""
    codes = torch.ones(1, TIME, GRID**2, 3, dtype=torch.long)
    for time in range(TIME):
        codes[0, time, START + time] = 4
    return codes


def sure(codes: Tensor) -> Tensor:
    """Logits that leave no uncertainty."""
    return 100 * CODEBOOK.one_hot(codes)


def test_a_place_reaches_its_neighbours_in_its_own_camera():
    around = surroundings(3, 2, torch.device("cpu"))
    assert around[:, 0].tolist() == list(range(18))
    assert set(around[4].tolist()) == set(range(9))
    assert set(around[8].tolist()) == {4, 5, 7, 8}
    assert set(around[9].tolist()) == {9, 10, 12, 13}


def test_a_track_follows_what_moves_and_stays_where_nothing_does():
    places = track_tokens(crossing(), CODEBOOK, AROUND)
    assert places[0, :, START].tolist() == [START + time for time in range(TIME)]
    assert (places[0, :, 0] == 0).all()


def test_flicker_of_codes_is_no_motion():
    torch.manual_seed(0)
    codes = torch.full((1, TIME, GRID**2, 3), 2)
    codes[..., 0] += torch.randint(-1, 2, codes.shape[:-1])
    places = track_tokens(codes, CODEBOOK, AROUND)
    assert (places == places[:, :1]).all()


def test_the_fastest_is_a_keypoint_while_it_is_known():
    places = track_tokens(crossing(), CODEBOOK, AROUND)
    tracks = most_active(places, VALID, 1)
    assert tracks.places[0, :, 0].tolist() == [START + time for time in range(TIME)]
    assert tracks.moving[0, :, 0].all()
    padded = VALID.clone()
    padded[0, 2:] = False
    cut: Tracks = most_active(places, padded, 1)
    assert cut.moving[0, :, 0].tolist() == [True, True, False, False]


def test_every_camera_has_keypoints_of_its_own():
    """However much more moves in the other."""
    start = torch.arange(2 * GRID**2)
    busy = start + torch.arange(TIME)[:, None] % 2 * (start < GRID**2)
    busy[1:, GRID**2 + 7] = GRID**2 + 8
    tracks = most_active(busy[None], VALID, 2)
    assert tracks.places.shape == (1, TIME, 2 * KEYPOINTS)
    assert tracks.places[0, :, KEYPOINTS].tolist() == [GRID**2 + 7, *[GRID**2 + 8] * (TIME - 1)]
    assert tracks.moving[0, 0].sum() == KEYPOINTS + 1


def test_keypoints_that_look_as_at_the_start_cost_nothing_wherever_they_are():
    codes = crossing()
    consistent = sure(codes[:, 1:])
    assert keypoint_loss(consistent, CODEBOOK, codes, VALID, 1) < 1e-6
    faded = codes.clone()
    faded[0, 2, START + 2] = 1
    assert keypoint_loss(sure(faded[:, 1:]), CODEBOOK, codes, VALID, 1) > 0.1
    elsewhere = consistent.clone()
    elsewhere[:, :, 0] += torch.randn(15)
    assert keypoint_loss(elsewhere, CODEBOOK, codes, VALID, 1) < 1e-6


def test_it_is_as_exact_in_a_training_in_bfloat16():
    torch.manual_seed(0)
    logits = torch.randn(1, TIME - 1, GRID**2, 15)
    exact = keypoint_loss(logits, CODEBOOK, crossing(), VALID, 1)
    with compute_in(torch.bfloat16, "cpu"):
        mixed = keypoint_loss(logits, CODEBOOK, crossing(), VALID, 1)
    assert torch.equal(mixed, exact)


def test_without_motion_there_is_no_keypoint():
    codes = crossing()[:, :1].expand(-1, TIME, -1, -1)
    logits = torch.randn(1, TIME - 1, GRID**2, 15)
    assert keypoint_loss(logits, CODEBOOK, codes, VALID, 1) == 0


def test_the_loss_pulls_along_the_track_only():
    logits = torch.zeros(1, TIME - 1, GRID**2, 15, requires_grad=True)
    keypoint_loss(logits, CODEBOOK, crossing(), VALID, 1).backward()
    pulled = logits.grad.abs().sum(-1)[0].nonzero().tolist()
    followed = track_tokens(crossing(), CODEBOOK, AROUND)[0]
    moving = (followed != followed[:1]).any(0)
    expected = {(time, place) for time in range(TIME - 1) for place in followed[time + 1, moving].tolist()}
    assert {tuple(index) for index in pulled} == expected


@pytest.mark.parametrize(("quantizer", "levels"), [("fsq", (5, 4)), ("lfq", (8, 8))])
def test_expected_values_are_those_of_a_sure_prediction_and_even_out_when_unsure(quantizer, levels):
    codebook = make_codebook(quantizer, levels)
    codes = codebook.codes(torch.arange(20))
    sure_of = codebook.expected_values(100 * codebook.one_hot(codes))
    torch.testing.assert_close(sure_of, codebook.values(codes).float())
    unsure = codebook.expected_values(torch.zeros(3, sum(levels)))
    torch.testing.assert_close(unsure, torch.zeros(3, codebook.channels))

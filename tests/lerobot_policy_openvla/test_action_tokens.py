"""Actions become tokens and tokens actions, as the original does it."""

import pytest
import torch

from lerobot_policy_openvla.actions import ActionTokenizer

RELEASE = ActionTokenizer(32000)


def test_the_ends_of_the_range() -> None:
    ids = RELEASE.encode(torch.tensor([-1.0, 1.0, -7.0, 7.0, 0.999]))
    assert ids.tolist() == [31999, 31744, 31999, 31744, 31745]
    assert RELEASE.decode(torch.tensor([31744])).equal(RELEASE.decode(torch.tensor([31745])))


def test_every_action_comes_back_within_half_a_bin() -> None:
    actions = torch.linspace(-1, 1, 4001)
    assert (RELEASE.decode(RELEASE.encode(actions)) - actions).abs().max() <= 1 / 255 + 1e-6


def test_decoding_clips_what_labels_must_not_be() -> None:
    outside = torch.tensor([0, 31743, 32000, 32063])
    low, high = RELEASE.decode(torch.tensor([31999, 31744])).tolist()
    assert RELEASE.decode(outside).tolist() == [high, high, low, low]
    for token in outside.tolist():
        with pytest.raises(ValueError, match=rf"token id {token} is no action token: .* from 31744 to 31999"):
            RELEASE.columns(torch.tensor([[31800, token]]))
    assert RELEASE.columns(torch.tensor([31744, 31999])).tolist() == [0, 255]

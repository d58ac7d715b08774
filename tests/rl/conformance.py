"""What every StochasticPolicy must do, whatever it is made of."""

from typing import Any

import torch

from lerobot_wmrl.common.constants import Observation

DRAWS = 4000


def check_samples_and_log_probs_agree(policy: Any, observation: Observation) -> None:
    """Sampling and measuring use one distribution: `observation` has one row, `DRAWS` samples are drawn.

    The mean of −log π over samples is the entropy; a temperature, a top-k or a clipping that only one of
    both knows shifts it. And what was sampled is measured as it was.
    """
    many = {
        name: value * DRAWS if isinstance(value, list) else value.expand(DRAWS, *value.shape[1:])
        for name, value in observation.items()
    }
    torch.manual_seed(0)
    with torch.no_grad():
        sample = policy.sample(many)
        log_prob, entropy, value = policy.evaluate(many, sample.raw_action)
    assert sample.log_prob.dtype == torch.float32
    assert sample.log_prob.shape == sample.raw_action.shape
    assert torch.allclose(sample.log_prob, log_prob, atol=1e-5)
    assert torch.allclose(sample.value, value, atol=1e-5)
    assert entropy.shape == value.shape == (DRAWS,)
    surprise = -log_prob.flatten(1).sum(dim=1)
    error = surprise.std() / DRAWS**0.5
    assert (surprise.mean() - entropy[0]).abs() < 4 * error + 1e-4, (surprise.mean(), entropy[0])

"""Random numbers of a training: seeds of its episodes and of the policy's noise."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from lerobot.utils.random_utils import get_rng_state, set_rng_state

from lerobot_wmrl.common.seeds import EVALUATION_SEED

NOISE_SEED = 2**31
"""Added to a rollout's seed for the policy's noise, so that it differs from the environment's."""


SEED_STRIDE = 618_034
"""Distance of the first seeds of trainings with consecutive seeds, of a million: by the golden ratio, so that
few trainings share a start, however many there are."""


def first_seed(seed: int, iteration: int, num_envs: int) -> int:
    """Return the first of an iteration's `num_envs` environment seeds, all of them below EVALUATION_SEED."""
    return (seed * SEED_STRIDE + iteration * num_envs) % (EVALUATION_SEED - num_envs)


def start_seeds(first: int, num_envs: int, group_size: int) -> int | list[int]:
    """Return the seed for `env.reset`: `first`, which means consecutive seeds, or a random one a group."""
    if group_size == 1:
        return first
    generator = torch.Generator().manual_seed(first)
    drawn = torch.randint(EVALUATION_SEED, (num_envs // group_size,), generator=generator)
    return drawn.repeat_interleave(group_size).tolist()


@contextmanager
def seeded_noise(seed: int, device: torch.device | str) -> Iterator[None]:
    """Seed the generators for the policy's noise, and restore their states afterwards."""
    on_cuda = torch.device(device).type == "cuda"
    with torch.random.fork_rng([torch.cuda.current_device()] if on_cuda else []):
        torch.manual_seed(seed + NOISE_SEED)
        yield


@contextmanager
def preserved_randomness() -> Iterator[None]:
    """Restore the states of Python's, numpy's and torch's generators after the block."""
    state = get_rng_state()
    try:
        yield
    finally:
        set_rng_state(state)

"""Names of an imagined observation, and a model that says when episodes end."""

import torch

B = 4
"""Environments."""

IMAGE, STATE = "observation.images.third_view", "observation.state"


def always_done(env, flags: torch.Tensor) -> None:
    """Make the model's done logit +20 where `flags` (B,) and −20 elsewhere."""
    step = env.model.step
    env.model.step = lambda *args: step(*args)._replace(done_logit=torch.where(flags, 20.0, -20.0))

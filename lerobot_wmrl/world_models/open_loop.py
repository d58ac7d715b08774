"""What would come of many actions: how done and the state develop, and the last frame. No other is drawn
where the dynamics can do without, so it is much faster than imagining frame by frame."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.world_models.imagination import Imagined


class OpenLoopPrediction(NamedTuple):
    """After each of T actions of B imaginations: done_logit (B, T), proprioception (B, T, P) in the dataset's
    units; tokens (B, S) of the last frame."""

    done_logit: Tensor
    proprioception: Tensor
    tokens: Tensor


@torch.no_grad()
def open_loop(
    model: Any, tokens: Tensor, state: Tensor, actions: Tensor, context: Context = NO_CONTEXT,
    depth: Tensor | None = None,
) -> OpenLoopPrediction:  # fmt: skip
    """Open loop from tokens (B, S), state (B, P) and, if the model looks at them, context and depth (B, S),
    with actions (B, T, A). The same noise at every call."""
    generator = torch.Generator(tokens.device).manual_seed(0)
    ahead: OpenLoopPrediction = model.dynamics.open_loop(
        model, tokens, state, actions, context, depth, generator
    )
    return ahead


def open_loop_stepwise(
    model: Any, tokens: Tensor, state: Tensor, actions: Tensor, context: Context, depth: Tensor | None,
    generator: torch.Generator,
) -> OpenLoopPrediction:  # fmt: skip
    """Frame by frame, as imagination goes."""
    steps = imagined_steps(model, tokens, state, actions, context, depth, generator)
    return OpenLoopPrediction(
        torch.stack([step.done_logit for step in steps], 1),
        torch.stack([step.proprioception for step in steps], 1),
        steps[-1].tokens,
    )


def imagined_steps(
    model: Any, tokens: Tensor, state: Tensor, actions: Tensor, context: Context, depth: Tensor | None,
    generator: torch.Generator,
) -> list[Imagined]:  # fmt: skip
    """What is imagined after each of the actions (B, T, A)."""
    imagination = model.start(tokens, state, depth=depth, context=context)
    return [model.step(imagination, action, generator) for action in actions.unbind(1)]

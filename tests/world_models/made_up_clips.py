"""Text world models on made-up tokens: one start frame, and an end that depends on the instruction."""

from typing import Any

import torch
from torch import Tensor

from lerobot_wmrl.data.clips import Clip
from lerobot_wmrl.world_models.configuration_world_model import TextWorldModelConfig
from lerobot_wmrl.world_models.modeling_world_model import TextWorldModelRewardModel
from tests.trained import SIZES, nested, small_tokenizer

LEVELS = [5, 4]
TOKENS = 16
"""Of a 32x32 frame."""

STATE = 2
INSTRUCTIONS = ["push the red square forward", "pull it back"]
ARRIVAL = 2
"""The frame that first shows the end."""


def text_model(**settings: Any) -> TextWorldModelRewardModel:
    """A small text world model with random weights; no tokenizer is trained, as no picture is looked at."""
    torch.manual_seed(0)
    config = TextWorldModelConfig(
        tokenizer=small_tokenizer(levels=LEVELS),
        state_size=STATE,
        device="cpu",
        **nested(
            {
                **SIZES,
                "dynamics": "autoregressive",
                "conditioning": "cross_attention",
                "window": 8,
                "self_forcing": 0.0,
                "goal_horizon": 6,
                **settings,
            }
        ),
    )
    return TextWorldModelRewardModel(config)


def random_frames(count: int) -> Tensor:
    """Tokens (count, S)."""
    return torch.randint(0, 20, (count, TOKENS), generator=torch.Generator().manual_seed(3))


def made_up_clip() -> Clip:
    """One episode an instruction: the same start, a way of its own, and an end that stays."""
    start, *own = random_frames(1 + 2 * len(INSTRUCTIONS))
    ways, ends = own[: len(INSTRUCTIONS)], own[len(INSTRUCTIONS) :]
    tokens = torch.stack([torch.stack([start, way, end, end]) for way, end in zip(ways, ends, strict=True)])
    batch, length = tokens.shape[:2]
    done = (torch.arange(length) >= ARRIVAL - 1).float().repeat(batch, 1)
    known = torch.ones(batch, length, dtype=torch.bool)
    state, action = torch.zeros(batch, length, STATE), torch.zeros(batch, length, 7)
    return Clip(tokens, state, action, done, known, known, INSTRUCTIONS)


def fit(model: TextWorldModelRewardModel, clip: Clip, steps: int) -> None:
    """Learn the clip by heart, then evaluate."""
    model.train()
    optimizer = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], 1e-2)
    for _ in range(steps):
        loss, _ = model(clip)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    model.eval()

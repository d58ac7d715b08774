"""A short training on made-up arrays: no video, no file and no trained tokenizer stands between machines.

A change of a model, a loss, the sampler or the optimiser shows here first; if it is meant, write the new
numbers down.
"""

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lerobot.rewards.factory import make_reward_model
from lerobot.utils.random_utils import set_seed

from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.clips import ClipSampler, FrameSampler
from lerobot_wmrl.data.episodes import EpisodeTable
from lerobot_wmrl.world_models import losses
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig, TextWorldModelConfig
from lerobot_wmrl.world_models.training import train
from tests.trained import CLIP_LENGTH, SIZES, nested, small_tokenizer, tokenizer_config

EPISODES, ROWS, TOKENS, CODES = 4, 14, 16, 20
GOLDEN = {
    "frame_tokenizer": [0.8046, 1.4138, 1.3305, 1.2068, 1.186, 0.7207, 1.4571, 1.9478],
    "autoregressive": [3.3465, 3.2143, 3.1728, 3.1338, 3.2174, 3.1554, 3.103, 3.1382],
    "cross_attention": [3.5473, 3.3998, 3.2762, 3.2653, 3.3108, 3.2467, 3.1596, 3.2198],
    "action_world_model": [4.9458, 5.0635, 4.8316, 4.4963, 4.4221, 4.3848, 4.3603, 4.2395],
    "text_world_model": [3.4957, 3.2739, 3.2533, 3.2365, 3.2799, 3.2537, 3.1759, 3.1622],
}
WORLD_MODEL: dict[str, Any] = {
    "device": "cpu",
    "tokenizer": small_tokenizer(),
    "clip_length": CLIP_LENGTH,
    **SIZES,
}
AUTOREGRESSIVE = {"dynamics": "autoregressive", "window": 24}
CROSS_ATTENTION = {**AUTOREGRESSIVE, "conditioning": "cross_attention"}


def made_up_episodes() -> EpisodeTable:
    """Drifting numbers; every second episode ends in success."""
    rng, rows = np.random.default_rng(0), EPISODES * ROWS
    state = 0.02 * rng.normal(size=(rows, 8)).cumsum(0).astype(np.float32)
    action = rng.normal(size=(rows, 7)).astype(np.float32)
    done = np.tile(np.arange(2 * ROWS) >= 2 * ROWS - 3, EPISODES // 2)
    start, length = np.arange(EPISODES) * ROWS, np.full(EPISODES, ROWS)
    optimal = {"start.kind": np.zeros(EPISODES, int)}
    instructions = ["push the can", "pull the box"] * (EPISODES // 2)
    dataset: Any = SimpleNamespace(root="made up", features={"next.success"})
    return EpisodeTable(dataset, state, action, done, start, length, instructions, optimal)


def made_up_sampler(model: str) -> ClipSampler | FrameSampler:
    """Pictures that brighten, or tokens of which a few change from row to row."""
    table, rng, episodes = made_up_episodes(), np.random.default_rng(1), np.arange(EPISODES)
    if model == "frame_tokenizer":
        ramp = np.linspace(0, 255, 32) * np.linspace(0.2, 1, EPISODES * ROWS)[:, None]
        frames = np.broadcast_to(ramp[:, None, None, :, None], (EPISODES * ROWS, 1, 32, 32, 3)).astype(
            np.uint8
        )
        return FrameSampler(table, frames, episodes, ["third_view"], batch_size=4, seed=0, device="cpu")
    tokens = rng.integers(0, CODES, TOKENS) + (rng.random((EPISODES * ROWS, TOKENS)) < 0.1).cumsum(0)
    return ClipSampler(table, tokens % CODES, episodes, CLIP_LENGTH, 0.75, 4, seed=0, device="cpu")


@pytest.mark.parametrize("model", GOLDEN)
def test_the_loss_of_a_short_training_is_the_golden_one(model, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(losses, "TOKEN_NOISE", 0.1)
    configs = {
        "frame_tokenizer": tokenizer_config,
        "action_world_model": partial(ActionWorldModelConfig, **nested(WORLD_MODEL)),
        "autoregressive": partial(ActionWorldModelConfig, **nested(WORLD_MODEL | AUTOREGRESSIVE)),
        "cross_attention": partial(ActionWorldModelConfig, **nested(WORLD_MODEL | CROSS_ATTENTION)),
        "text_world_model": partial(TextWorldModelConfig, **nested(WORLD_MODEL | CROSS_ATTENTION)),
    }
    set_seed(0)
    config = configs[model]()
    settings = SimpleNamespace(
        output_dir=tmp_path, steps=8, batch_size=4, save_freq=8, log_freq=1, seed=0, precision="float32"
    )
    (tmp_path / "checkpoints").mkdir()
    train(make_reward_model(config), made_up_sampler(model), settings, lambda folder: None)
    assert [row["loss"] for row in read_metrics(tmp_path)] == pytest.approx(GOLDEN[model], rel=1e-3)

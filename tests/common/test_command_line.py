"""Fields become the flags that were typed, and flags that do not exist lead to those that do."""

from dataclasses import dataclass, field

import pytest

from lerobot_wmrl.common.command_line import RunConfig, near_flag, said_in_flags
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.settings import settings_of
from lerobot_wmrl.scripts.train import TrainConfig


@dataclass
class Reward:
    form: str = "potential"
    gamma: float = 0.97


@dataclass
class Env:
    reward: Reward = field(default_factory=Reward)
    length: int = 40


@dataclass
class Config(RunConfig):
    """Args:
    env: where the policy acts.
    real: where success is measured.
    """

    env: Env = field(default_factory=Env)
    real: Env = field(default_factory=lambda: Env(length=60))
    iterations: int = 3


@pytest.mark.parametrize(
    ("error", "typed", "message"),
    [
        (
            FieldError("reward.form", "odd", "unknown", "choose one of those of `length`"),
            ["--real.reward.form=odd"],
            "--real.reward.form=odd: unknown; choose one of those of --real.length",
        ),
        (
            FieldError("gamma", 2, "too large", "lower it, or set `form=absolute`"),
            ["--env.reward.gamma=2", "--real.reward.gamma=0.5"],
            "--env.reward.gamma=2: too large; lower it, or set --env.reward.form=absolute",
        ),
        (FieldError("length", 60, "too long"), [], "--real.length=60: too long"),
        (FieldError("iterations", "", "is missing"), [], "--iterations: is missing"),
        (FieldError("width", 7, "odd", "see `config.json`"), [], "width=7: odd; see `config.json`"),
        (ValueError("no file"), [], "no file"),
    ],
)
def test_a_field_is_said_as_its_flag(error: ValueError, typed: list[str], message: str) -> None:
    assert said_in_flags(error, Config, typed) == message


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("steps", "iterations"),
        ("iteration", "iterations"),
        ("sead", "seed"),
        ("env.episode_lenght", "env.episode_length"),
        ("policy.alpha", "env.reward.alpha"),
        ("frobnicate", None),
    ],
)
def test_a_flag_that_does_not_exist_leads_to_one_that_does(name: str, near: str | None) -> None:
    assert near_flag(name, list(settings_of(TrainConfig, {"env": "world_model"})), TrainConfig) == near

import pytest

from lerobot_wmrl.common import presets
from lerobot_wmrl.common.presets import expand_preset


@pytest.fixture(autouse=True)
def small_table(monkeypatch: pytest.MonkeyPatch) -> None:
    table = {
        "tiny": {"train": {"steps": 4, "save": True}, "train:a": {"steps": 8}},
        "demo": {"train:b": {"x.y": 0.5}},
        "cpu": {"rl": {"a.type": "ppo", "a.clip": 0.2, "steps": 3}},
    }
    monkeypatch.setattr(presets, "PRESETS", table)


def test_flags_stand_where_the_preset_stood() -> None:
    """So what the user types further right wins, and what is further left is overridden."""
    argv = ["--seed=1", "--preset=tiny", "--steps=9"]
    assert expand_preset(argv, "train") == ["--seed=1", "--steps=4", "--save=true", "--steps=9"]


def test_the_chosen_type_adds_its_own_flags() -> None:
    argv = ["--preset=tiny", "--model.type=a"]
    assert expand_preset(argv, "train") == ["--steps=4", "--save=true", "--steps=8", "--model.type=a"]
    assert expand_preset(["--preset=demo", "--model.type=b"], "train") == ["--x.y=0.5", "--model.type=b"]


def test_another_type_takes_the_preset_s_settings_of_it_along() -> None:
    assert expand_preset(["--preset=cpu"], "rl") == ["--a.type=ppo", "--a.clip=0.2", "--steps=3"]
    assert expand_preset(["--preset=cpu", "--a.type=grpo"], "rl") == ["--steps=3", "--a.type=grpo"]
    same = ["--preset=cpu", "--a.type=ppo"]
    assert expand_preset(same, "rl") == ["--a.type=ppo", "--a.clip=0.2", "--steps=3", "--a.type=ppo"]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--preset=huge"], "--preset=huge: unknown preset; choose one of tiny, demo, cpu"),
        (["--preset=demo", "--x.type=c"], "--preset=demo: train has no such preset; it has: tiny"),
        (["--preset=demo"], "--preset=demo: train has one a type; give a type: b"),
    ],
)
def test_unknown_presets_are_named(argv: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        expand_preset(argv, "train")

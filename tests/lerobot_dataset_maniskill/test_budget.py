"""A recording under a budget: entered when it is finished, and refused before it begins."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from lerobot_dataset_maniskill import simulated
from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.record import run
from lerobot_dataset_maniskill.recorder import record
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.common.seeds import EVALUATION_SEED, GATE_SEED
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.ledger import Ledger, Limits
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from tests.lerobot_dataset_maniskill.made_up import MadeUpRecorder
from tests.rl.checkpoints import save_untrained_policy


@pytest.fixture(autouse=True)
def _made_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is simulated."""
    monkeypatch.setattr(simulated, "PartRecorder", MadeUpRecorder)
    monkeypatch.setattr(simulated.ManiSkillEpisodes, "check", lambda self: None)


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    return Ledger.create(tmp_path / "budget.json", Limits(demonstrations=3, rollouts=2))


def config(ledger: Ledger, name: str, episodes: int, **settings: Any) -> RecordConfig:
    options = {
        "budget": ledger.path,
        "env": WmrlManiSkillEnv(image_size=32),
        "num_workers": 1,
        "kinds": {"optimal": 1.0},
        **settings,
    }
    return RecordConfig(output_dir=ledger.path.parent / name, num_episodes=episodes, **options)


def spent(ledger: Ledger) -> Counter[str]:
    return Counter(entry["spent"] for entry in ledger.read().episodes.values())


def test_a_recording_is_charged_and_reports_completion_again(
    ledger: Ledger, capsys: pytest.CaptureFixture[str]
) -> None:
    for _ in range(2):
        record(config(ledger, "planned", 3))
    assert spent(ledger) == {"demonstrations": 3}
    assert "already recorded: 3 episodes" in capsys.readouterr().out
    with pytest.raises(FieldError, match="1 more demonstrations are wanted, 0 of 3 are left"):
        record(config(ledger, "more", 1, seed=100))
    assert {path.name for path in ledger.path.parent.iterdir()} == {
        ledger.path.name,
        ".budget.json.lock",
        "planned",
    }


def test_a_recording_that_was_killed_before_it_was_charged_is_charged(
    ledger: Ledger, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as killed:
        killed.setattr(Ledger, "charge", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            record(config(ledger, "planned", 2))
    assert not spent(ledger)
    record(config(ledger, "planned", 2))
    assert spent(ledger) == {"demonstrations": 2}


def test_a_policys_episodes_are_rollouts(ledger: Ledger, tmp_path: Path) -> None:
    policy = read_policy_config(str(save_untrained_policy(tmp_path / "policy", actions=7)), [])
    record(config(ledger, "rollouts", 1, policy=policy, seed=GATE_SEED))
    assert spent(ledger) == {"rollouts": 1}
    with pytest.raises(FieldError, match="2 more rollouts are wanted, 1 of 2 are left"):
        record(config(ledger, "more", 2, policy=policy))
    with pytest.raises(FieldError, match="seeds from 1000000 on are for evaluation"):
        record(config(ledger, "more", 1, policy=policy, seed=EVALUATION_SEED))


def test_play_has_a_limit_of_its_own(ledger: Ledger) -> None:
    with pytest.raises(FieldError, match="2 more play are wanted, 0 of 0 are left"):
        record(config(ledger, "play", 2, kinds={"play": 1.0}))


def test_unseen_scenes_are_refused(ledger: Ledger) -> None:
    with pytest.raises(FieldError, match=r"env\.split=ood: under a budget"):
        record(config(ledger, "unseen", 1, env=WmrlManiSkillEnv(image_size=32, split="ood")))


def test_shards_must_be_known(ledger: Ledger) -> None:
    def shard(number: int, **settings: Any) -> RecordConfig:
        options = {"shard": f"{number}/2", "part_episodes": 1, **settings}
        return config(ledger, f"shard_{number}", 2, **options)

    whole = config(ledger, "whole", 2, merge_shards=[shard(number).root for number in range(2)])
    record(shard(0))
    record(shard(1, budget=None))
    with pytest.raises(FieldError, match=r"merge_shards=.*shard_1: 1 of 1 episodes are not in the budget"):
        run(whole)
    record(shard(1))
    run(whole)
    assert spent(ledger) == {"demonstrations": 2}
    ledger.require_known(read_episodes(open_dataset(whole.root)))


def test_imagined_episodes_cost_nothing_and_start_in_known_ones(
    ledger: Ledger, trained_models: dict[str, Path], make_synthetic_dataset: Any, tmp_path: Path
) -> None:
    real = make_synthetic_dataset(tmp_path / "real", episodes=3)
    env = WorldModelEnv(
        world_model_path=str(trained_models["action_world_model"]),
        dataset=StartFrames(root=str(real.root)),
        reward=GeneralConfig(alpha=1.0),
        episode_length=4,
        device="cpu",
    )
    policy = read_policy_config(str(save_untrained_policy(tmp_path / "policy", actions=7)), [])
    imagined = config(ledger, "imagined", 3, env=env, policy=policy)
    with pytest.raises(FieldError, match=r"env\.dataset\.root=.*3 of 3 episodes are not in the budget"):
        record(imagined)
    ledger.charge(read_episodes(real))
    record(imagined)
    assert spent(ledger) == {"demonstrations": 3, "imagined": 3}
    sources = {entry["dataset"] for entry in json.loads(ledger.path.read_text())["episodes"].values()}
    assert sources == {"real", "imagined"}

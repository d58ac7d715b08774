"""The checkpoint that is kept as the best, and when imagined and real success part."""

import inspect
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig, PushtEnv

from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_wmrl.common.errors import TrainingStopped
from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.common.seeds import SELECTION_SEED
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.envs import start_frames, world_model_env
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.envs.start_frames import StartImages
from lerobot_wmrl.evaluation.policy_rollouts import PolicyEvaluation
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.rl import make_callbacks
from lerobot_wmrl.rl.callbacks import Record
from lerobot_wmrl.rl.configuration_callbacks import CallbackSettings, SelectionConfig
from lerobot_wmrl.rl.selection import Measure, Selection, best_iteration, diverged
from lerobot_wmrl.world_models.checkpoint import load_model
from tests.rl.checkpoints import loaded, save_untrained_policy
from tests.rl.point_env import PointEnv
from tests.scripts.point_config import PointConfig

N = 64


def record(real: float | None, imagined: float | None, n: int = N) -> Record:
    """Of these success rates."""
    shares = {"real": real, "imagined": imagined}
    return {
        place: Proportion(round(share * n), n).as_json()
        for place, share in shares.items()
        if share is not None
    }


def measure(successes: int, n: int = 4, steps: int = 30) -> Measure:
    return lambda: PolicyEvaluation({("suite", 0, seed): seed < successes for seed in range(n)}, steps)


def make_selection(tmp_path: Path, **measures: Measure) -> Selection:
    for iteration in (0, 5, 10, 12):
        (tmp_path / "checkpoints" / f"{iteration:06d}").mkdir(parents=True)
    return Selection(5, 12, measures, tmp_path)


def best(tmp_path: Path) -> str:
    return (tmp_path / "checkpoints" / "best").resolve().name


def test_it_measures_before_any_update_at_intervals_and_at_the_end(tmp_path: Path) -> None:
    selection = make_selection(tmp_path, real=measure(1))
    assert [iteration for iteration in range(13) if selection.due(iteration)] == [0, 5, 10, 12]


def test_a_record_has_both_rates_and_the_steps_that_reality_took(tmp_path: Path) -> None:
    selection = make_selection(tmp_path, real=measure(3), imagined=measure(4, steps=99))
    found = selection.run(5, tmp_path, tmp_path)
    assert (found["real"]["k"], found["imagined"]["k"], found["real_steps"]) == (3, 4, 30)
    unreal = make_selection(tmp_path / "unreal", imagined=measure(4, steps=99)).run(5, tmp_path, tmp_path)
    assert unreal["real_steps"] == 0
    assert "real" not in unreal


def test_real_success_decides_and_of_equals_the_earlier(tmp_path: Path) -> None:
    records: dict[int, Any] = {0: record(0.5, 0.5), 5: record(0.75, 0.6), 10: record(0.75, 0.9)}
    selection = make_selection(tmp_path, real=measure(0), imagined=measure(0))
    selection.apply({0: records[0]})
    assert best(tmp_path) == "000000"
    selection.apply(records)
    assert best(tmp_path) == "000005"
    assert best_iteration(records, "imagined") == 10
    make_selection(tmp_path / "unreal", imagined=measure(0)).apply(records)
    assert best(tmp_path / "unreal") == "000010"


def test_imagined_success_is_compared_within_one_world_model(tmp_path: Path) -> None:
    """That of iteration 5 was exploited, and is replaced after iteration 10."""
    for iteration in (5, 10, 12):
        (tmp_path / "checkpoints" / f"{iteration:06d}").mkdir(parents=True)
    records: dict[int, Any] = {5: record(0.53, 0.98), 10: record(0.50, 0.60)}
    Selection(5, 12, {"imagined": measure(0)}, tmp_path, [10]).apply(records)
    assert best(tmp_path) == "000010"
    records[12] = record(0.20, 0.80)  # less than 98 %, and yet more than this world model said
    with pytest.raises(TrainingStopped, match=r"50 % .* at iteration 10\. .*000005 is the best"):
        Selection(5, 12, {"real": measure(0), "imagined": measure(0)}, tmp_path, [10]).apply(records)


@pytest.mark.parametrize(
    ("latest", "expected"),
    [
        (record(0.20, 0.80), True),  # as measured once: imagined 0.55 → 0.80, real 0.53 → 0.20
        (record(0.20, 0.55), True),
        (record(0.34, 0.80), False),  # the intervals touch
        (record(0.20, 0.40), False),  # imagination sees it fail
        (record(0.53, 0.80), False),
        (record(0.02, 0.80, n=5), False),  # too few episodes to say
        (record(None, 0.80), False),
        (record(0.20, None), False),
    ],
)
def test_imagined_and_real_success_part(latest: Record, expected: bool) -> None:
    assert diverged(record(0.53, 0.55), latest) is expected


def test_a_training_whose_imagination_parts_from_reality_is_stopped(tmp_path: Path) -> None:
    selection = make_selection(tmp_path, real=measure(0), imagined=measure(0))
    with pytest.raises(TrainingStopped, match=r"iteration 10: real success has fallen.*53 %.*at iteration 5"):
        selection.apply({0: record(0.40, 0.5), 5: record(0.53, 0.55), 10: record(0.20, 0.80)})
    assert best(tmp_path) == "000005", "the best checkpoint is pointed at nonetheless"


class Imagining(PointEnv):
    """In the place of a world model."""

    config = SimpleNamespace(dataset=StartFrames(root="episodes"))
    model = None


@pytest.mark.parametrize(
    ("real_env", "config", "env", "places"),
    [
        (None, PushtEnv(), PointEnv, ["real"]),
        (None, PointConfig(), PointEnv, ["real"]),
        (PushtEnv(), PointConfig(), Imagining, ["real", "imagined"]),
    ],
)
def test_success_is_measured_on_seeds_that_nothing_is_reported_on(
    real_env: EnvConfig | None,
    config: EnvConfig,
    env: type[PointEnv],
    places: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("evaluate_policy", "evaluate_within"):
        signature = inspect.signature(getattr(make_callbacks, name))

        def seed_of(*given: Any, signature: inspect.Signature = signature, **flags: Any) -> int:
            return int(signature.bind(*given, **flags).arguments["seed"])

        monkeypatch.setattr(make_callbacks, name, seed_of)
    monkeypatch.setattr(make_callbacks, "WorldModelVectorEnv", Imagining)
    monkeypatch.setattr(make_callbacks, "load_spread_starts", lambda *_: range(9))
    monkeypatch.setattr(make_callbacks, "make_success_env", lambda env, *_: env)
    settings, policy = CallbackSettings(real_env=real_env), LoadedPolicy(CnnConfig(), None, None, None)
    measures: dict[str, Any] = make_callbacks.make_measures(settings, policy, env(2), config)
    assert {place: measure() for place, measure in measures.items()} == dict.fromkeys(places, SELECTION_SEED)


def test_tasks_of_maniskill_are_measured_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Together they would share the episodes, and each see scenes that no other one sees."""
    monkeypatch.setattr(make_callbacks, "evaluate_policy", lambda *given: given)
    config = WmrlManiSkillEnv(task="push,pull")
    env: Any = SimpleNamespace(tasks=2, num_envs=6)
    policy, settings = LoadedPolicy(CnnConfig(), None, None, None), CallbackSettings()
    found: Any = make_callbacks.make_measures(settings, policy, env, config)["real"]()
    assert found == (config, policy, settings.selection.n_episodes, SELECTION_SEED, 3)


def test_starts_are_tokenised_once_and_a_refreshed_world_model_is_measured(
    small_dataset: LeRobotDataset,
    trained_models: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing ever succeeds in the first one, everything in the other."""
    path, read = trained_models["action_world_model"], []
    config = WorldModelEnv(
        world_model_path=str(path),
        dataset=StartFrames(root=str(small_dataset.root)),
        reward=GeneralConfig(alpha=1.0),
        done_frames=1,
        episode_length=2,
        device="cpu",
    )
    env: Any = config.create_tensor_env(2)

    def read_start_images(*args: Any) -> StartImages:
        read.append(args)
        return start_frames.read_start_images(*args)

    def always(model: Any, logit: float) -> Any:
        step = model.step
        model.step = lambda *args: step(*args)._replace(done_logit=torch.full((2,), logit))
        return model

    monkeypatch.setattr(world_model_env, "read_start_images", read_start_images)
    policy = loaded(save_untrained_policy(tmp_path / "policy", actions=7))
    settings, dice = CallbackSettings(selection=SelectionConfig(1, 3)), torch.get_rng_state()
    imagined = make_callbacks.make_measures(settings, policy, env, config)["imagined"]
    assert torch.equal(torch.get_rng_state(), dice), "the training's are left alone"
    always(env.model, -20.0)
    assert imagined().successes == [False] * 3
    env.adopt(always(load_model(path, "action_world_model", "cpu"), 20.0))
    assert imagined().successes == [True] * 3
    assert len(read) == 1

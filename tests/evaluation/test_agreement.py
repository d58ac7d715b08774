"""The world model as an evaluator of policies."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.checkpoints import Checkpoint, model_folder
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.evaluation.agreement import Agreement, policy_checkpoints
from lerobot_wmrl.evaluation.policy_rollouts import StepCounter, evaluate_policy
from lerobot_wmrl.evaluation.report import agreement_table
from lerobot_wmrl.scripts.eval_world_model import (
    EvalWorldModelConfig,
    checked_policies,
    eval_world_model,
    policies_imagination,
    policy_agreement,
)
from tests.rl.checkpoints import loaded, save_untrained_policy

IMAGE = "observation.images.third_view"


@pytest.fixture
def imagination(small_dataset, trained_models) -> WorldModelEnv:
    return WorldModelEnv(
        world_model_path=str(trained_models["action_world_model"]),
        dataset=StartFrames(root=str(Path(small_dataset.root))),
        done_threshold=0.0001,
        done_frames=1,
        episode_length=4,
        device="cpu",
    )


def test_every_checkpoint_of_a_training_counts_in_order(tmp_path):
    for step in ("000010", "000002", "last"):
        (tmp_path / "rl" / "checkpoints" / step).mkdir(parents=True)
    found = policy_checkpoints([str(tmp_path / "rl"), str(tmp_path / "one")])
    assert [path.name for path in found] == ["000002", "000010", "one"]
    with pytest.raises(ValueError, match="policies="):
        policy_checkpoints([])


def test_outcomes_are_those_of_the_environment_one_an_episode(imagination, tmp_path):
    """A threshold that the first frame reaches ends every episode in success; one out of reach, none."""
    policy = loaded(save_untrained_policy(tmp_path / "policy", actions=7))
    for imagination.done_threshold, success in ((0.0001, True), (0.9999, False)):
        found = evaluate_policy(imagination, policy, 5, EVALUATION_SEED, num_envs=3)
        assert found.successes == [success] * 5


def test_the_evaluation_reports_policies_beside_reality(imagination, small_dataset, tmp_path):
    """Reality is a world model here too, so that the test needs no simulator."""
    policy = save_untrained_policy(tmp_path / "policy", actions=7)
    cfg = EvalWorldModelConfig(
        model=Checkpoint(imagination.world_model_path),
        dataset=ChosenEpisodes(str(Path(small_dataset.root))),
        output_dir=tmp_path / "check",
        device="cpu",
        policies=[str(policy)],
        policy_episodes=4,
        done_threshold=0.0001,
        done_frames=1,
    )
    with pytest.raises(ValueError, match=r"real_env\.type=None: is missing"):
        eval_world_model(cfg)
    assert not cfg.output_dir.exists()
    cfg.real_env = imagination
    eval_world_model(cfg)
    found = json.loads((cfg.output_dir / "metrics.json").read_text())["policies"]
    assert found["policies"][str(policy)]["real"]["k"] == 4
    assert found["policies"][str(policy)]["imagined"]["k"] == 4
    assert found["pearson"]["value"] is None
    assert "success in `real_env`" in (cfg.output_dir / "metrics.md").read_text()
    assert (cfg.output_dir / "policies.png").is_file()


def test_policies_that_sample_have_the_same_rates_each_time_and_the_world_model_is_made_once(
    imagination, tmp_path, monkeypatch
):
    drawn: list[torch.Tensor] = []
    made: list[WorldModelEnv] = []
    make = WorldModelEnv.create_envs

    def sample(self: CnnPolicy, batch: dict[str, torch.Tensor]) -> torch.Tensor:
        drawn.append(torch.rand(len(batch[IMAGE]), 7))
        return drawn[-1]

    def create_envs(env: WorldModelEnv, *args: object, **kwargs: object) -> object:
        made.append(env)
        return make(env, *args, **kwargs)

    monkeypatch.setattr(CnnPolicy, "select_action", sample)
    monkeypatch.setattr(WorldModelEnv, "create_envs", create_envs)
    cfg = EvalWorldModelConfig(
        model=Checkpoint(imagination.world_model_path),
        policy_episodes=4,
        real_env=replace(imagination),
        policies=[str(save_untrained_policy(tmp_path / name, actions=7)) for name in "ab"],
    )
    for _ in range(2):
        policy_agreement(cfg, imagination, checked_policies(cfg, imagination))
    half = len(drawn) // 2
    assert torch.equal(torch.cat(drawn[:half]), torch.cat(drawn[half:]))
    assert [env is imagination for env in made] == [True, False, False] * 2


@pytest.mark.parametrize(
    ("policy", "said"),
    [
        ({"actions": 3}, "the policy has 3 action components, the environment 7"),
        ({"actions": 7, "camera": "wrist"}, "wrist"),
        ({"actions": 7, "constant": 1000.0}, "was trained on actions .* is 1000 on average"),
    ],
)
def test_a_policy_that_cannot_act_there_is_refused_before_anything_is_replayed(
    imagination, small_dataset, tmp_path, policy, said
):
    cfg = EvalWorldModelConfig(
        model=Checkpoint(imagination.world_model_path),
        dataset=ChosenEpisodes(str(Path(small_dataset.root))),
        policies=[str(save_untrained_policy(tmp_path / "policy", **policy))],
        policy_episodes=4,
        real_env=imagination,
        output_dir=tmp_path / "check",
        device="cpu",
    )
    with pytest.raises(ValueError, match=f"^policies=.*{said}"):
        eval_world_model(cfg)
    assert not cfg.output_dir.exists()


def test_imagined_episodes_are_as_long_as_real_ones_and_none_is_repeated(imagination, small_dataset):
    """Those of a simulator's task, or of another environment."""
    for real in (WmrlManiSkillEnv(task="push"), imagination):
        cfg = EvalWorldModelConfig(
            model=Checkpoint(imagination.world_model_path),
            dataset=ChosenEpisodes(str(small_dataset.root)),
            policies=["policy"],
            policy_episodes=2,
            real_env=real,
            device="cpu",
        )
        table = read_episodes(cfg.dataset.open())
        assert policies_imagination(cfg, table).episode_length == real.horizon
        cfg.policy_episodes = 7
        with pytest.raises(ValueError, match=r"^policy_episodes=7: the dataset has \d starts"):
            policies_imagination(cfg, table)


def test_a_world_model_without_a_known_success_is_refused_by_the_commands_own_flag_before_anything_is_made(
    imagination, small_dataset, tmp_path
):
    root = tmp_path / "model"
    shutil.copytree(model_folder(imagination.world_model_path), root)
    config = json.loads((root / "config.json").read_text())
    (root / "config.json").write_text(json.dumps({**config, "learnt_successes": 0}))
    cfg = EvalWorldModelConfig(
        model=Checkpoint(str(root)),
        dataset=ChosenEpisodes(str(Path(small_dataset.root))),
        policies=["policy"],
        real_env=imagination,
        output_dir=tmp_path / "check",
    )
    with pytest.raises(
        ValueError, match=r"^model\.path=.*has learnt from no episode that is known to succeed"
    ):
        eval_world_model(cfg)
    assert not cfg.output_dir.exists()


def test_agreement_is_pearsons_correlation_with_fishers_interval():
    """r by hand; with four policies arctanh(r) ± 1.96 / √(4 − 3)."""
    shares = zip((2, 4, 6, 8), (1, 4, 5, 8), strict=True)
    agreement = Agreement({str(i): (Proportion(a, 10), Proportion(b, 10)) for i, (a, b) in enumerate(shares)})
    r, low, high = agreement.correlation()
    assert r == pytest.approx(0.98387, abs=1e-4)
    assert (low, high) == pytest.approx(
        (np.tanh(np.arctanh(r) - 1.96), np.tanh(np.arctanh(r) + 1.96)), abs=1e-3
    )
    assert agreement.as_json()["r_squared"] == pytest.approx(r * r)
    equal = Agreement({str(i): (Proportion(5, 10), Proportion(i, 10)) for i in range(4)})
    assert equal.as_json()["pearson"]["value"] is None
    assert "No correlation" in agreement_table(equal)


class Ending:
    """Two environments, whose episodes end after one step and after three."""

    num_envs = 2

    def reset(self, **_: object) -> tuple[None, dict[str, object]]:
        self.elapsed = 0
        return None, {}

    def step(self, _: object) -> tuple[object, ...]:
        self.elapsed += 1
        ended = np.array([self.elapsed == 1, self.elapsed == 3])
        return None, None, ended, np.zeros(2, bool), {}


def test_the_steps_of_first_episodes_alone_are_counted() -> None:
    env = StepCounter(Ending())
    for _ in range(2):
        env.reset()
        for _ in range(3):
            env.step(None)
    assert env.steps == 2 * (1 + 3)

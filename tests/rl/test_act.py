"""LeRobot's ACT in its adapter: its own actions, exact log-probs, its own checkpoint afterwards."""

import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs.default import PeftConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from safetensors.torch import load_file
from torch.distributions import Normal

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.common.policies import with_new_adapters
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.evaluation.policy_rollouts import evaluate_policy
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.configuration_distillation import DistillationConfig
from lerobot_wmrl.rl.distillation import Distillation
from lerobot_wmrl.rl.minibatches import read_batch
from lerobot_wmrl.rl.policy_adapters import INITIAL_STD, ActAdapter
from lerobot_wmrl.rl.ppo import PPO
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect
from lerobot_wmrl.rl.trainer import Schedule, train
from lerobot_wmrl.scripts.train import main
from tests.rl.act_checkpoint import ACTED, IMAGE, SCENE, STATE, save_small_act, small_act
from tests.rl.checkpoints import loaded
from tests.rl.conformance import check_samples_and_log_probs_agree
from tests.rl.point_env import PointEnv

ENVS, STEPS = 4, 8
OBSERVATION = {SCENE: torch.rand(2, 4), STATE: torch.rand(2, 4)}


class SeenPointEnv(PointEnv):
    """Shows its state as that of an environment too."""

    def _observe(self) -> dict[str, Any]:
        seen = super()._observe()
        return {**seen, SCENE: seen[STATE]}


def improve(policy: ACTPolicy, pipeline: Pipeline, output_dir: Path, iterations: int) -> PPO:
    """The trainer with ACT in the point environment."""
    torch.manual_seed(7)
    algorithm = PPO(policy, PPOConfig(value_iterations=0, minibatch_size=8, epochs=1, policy_lr=1e-6))
    buffer = RolloutBuffer(STEPS, ENVS, "cpu")
    env = SeenPointEnv(ENVS, horizon=5)
    output_dir.mkdir(exist_ok=True)
    train(env, algorithm, pipeline, buffer, Schedule(iterations, 1, 0), output_dir, policy.save_pretrained)
    return algorithm


def test_it_samples_around_act_s_own_actions() -> None:
    policy = small_act()
    adapter = ActAdapter(policy).eval()
    observation = {IMAGE: torch.rand(2, 3, 32, 32), STATE: torch.rand(2, 4)}
    adapter.set_std(0.3)
    sample = adapter.sample(observation)
    assert sample.raw_action.shape == sample.log_prob.shape == (2, ACTED, 3)
    chunk = policy.predict_action_chunk(observation)[:, :ACTED]
    expected = Normal(chunk, 0.3).log_prob(sample.raw_action)
    log_prob, entropy, value = adapter.evaluate(observation, sample.raw_action)
    assert torch.allclose(log_prob, expected, atol=1e-5)
    assert torch.allclose(log_prob, sample.log_prob, atol=1e-6)
    assert torch.allclose(entropy, Normal(chunk, 0.3).entropy().sum(dim=(1, 2)))
    assert torch.equal(value, adapter.value(observation))
    assert value.shape == (2,)
    assert policy.select_action(observation).shape == (2, 3)


def test_samples_and_log_probs_are_of_one_distribution() -> None:
    one = {name: value[:1] for name, value in OBSERVATION.items()}
    check_samples_and_log_probs_agree(ActAdapter(small_act(images=False)).eval(), one)


def test_the_first_ratio_is_one_and_the_value_leaves_act_alone(pipeline: Pipeline) -> None:
    policy = small_act()
    algorithm = PPO(policy, PPOConfig(value_iterations=1))
    buffer = RolloutBuffer(STEPS, ENVS, "cpu")
    collect(PointEnv(ENVS, horizon=5, image_size=32), algorithm.policy, pipeline, buffer, 0)
    assert buffer.raw_action.shape == (STEPS, ENVS, ACTED, 3)
    assert set(buffer.age.unique().tolist()) == {0, 1, 2}
    chosen, _ = algorithm.add_targets(buffer)
    algorithm.add_reference(buffer, pipeline)
    batch = read_batch(buffer, chosen.flatten().nonzero()[:, 0], pipeline)
    loss, record = algorithm.losses(batch)
    assert record["ratio_error"].max() < 1e-3
    loss.sum().backward()
    assert all(parameter.grad is None for parameter in policy.parameters())
    assert all(parameter.grad is not None for parameter in algorithm.policy.critic.parameters())


def test_it_has_no_encoder_to_keep(tmp_path: Path) -> None:
    with pytest.raises(FieldError, match=r"algorithm\.train_encoder=False: this policy has no encoder"):
        PPO(small_act(), PPOConfig(train_encoder=False))
    with pytest.raises(FieldError, match=r"algorithm\.train_encoder=False: this policy has no encoder"):
        Distillation(small_act(), DistillationConfig(train_encoder=False), tmp_path)


def test_act_is_saved_as_act_and_what_was_added_with_the_algorithm(
    pipeline: Pipeline, tmp_path: Path
) -> None:
    algorithm = improve(small_act(images=False), pipeline, tmp_path / "whole", 2)
    last = tmp_path / "whole" / "checkpoints" / "last"
    loaded = ACTPolicy.from_pretrained(last / "pretrained_model")
    changed = algorithm.lerobot_policy.predict_action_chunk(OBSERVATION)
    assert torch.equal(loaded.predict_action_chunk(OBSERVATION), changed)
    assert not torch.equal(changed, small_act(images=False).predict_action_chunk(OBSERVATION))
    added = load_file(last / "algorithm" / "model.safetensors")
    assert {name for name in added if name.startswith("adapter.")} == {
        "adapter.log_std",
        *(f"adapter.critic.{i}.{kind}" for i in (0, 2) for kind in ("weight", "bias")),
    }
    assert not torch.equal(added["adapter.log_std"].exp(), torch.full((3,), INITIAL_STD))


def test_resumed_it_ends_where_the_other_does(pipeline: Pipeline, tmp_path: Path) -> None:
    whole = improve(small_act(images=False), pipeline, tmp_path / "whole", 2)
    improve(small_act(images=False), pipeline, tmp_path / "cut", 1)
    resumed = improve(small_act(images=False), pipeline, tmp_path / "cut", 2)
    for name, value in whole.policy.state_dict().items():
        assert torch.equal(resumed.policy.state_dict()[name], value), name


def test_averaged_chunks_are_refused() -> None:
    policy = small_act()
    policy.config.temporal_ensemble_coeff = 0.01
    with pytest.raises(FieldError, match=r"temporal_ensemble_coeff=0.01: .*set `policy\..*` to null"):
        PPO(policy, PPOConfig())


def test_the_command_improves_act_in_a_world_model_and_lerobot_evaluates_it(
    small_dataset, trained_models: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = save_small_act(tmp_path / "act", state=8, actions=7)
    models = {
        "world_model_path": str(trained_models["action_world_model"]),
        "text_world_model_path": str(trained_models["text_world_model"]),
    }
    flags = [
        f"--policy.path={policy}",
        "--policy.n_action_steps=2",
        "--env.type=world_model",
        *(f"--env.{name}={path}" for name, path in models.items()),
        "--env.episode_length=4",
        f"--env.dataset.root={small_dataset.root}",
        "--num_envs=2",
        "--iterations=2",
        "--algorithm.type=ppo",
        "--algorithm.policy_lr=1e-6",
        "--algorithm.value_iterations=1",
        "--gate.action=off",
        f"--output_dir={tmp_path / 'rl'}",
    ]
    monkeypatch.setattr(sys, "argv", ["lerobot-wmrl-train", *flags])
    main()
    lines = read_metrics(tmp_path / "rl")
    assert [line["step"] for line in lines] == [1, 2]
    assert lines[0]["first_ratio_error"] < 1e-3
    last = tmp_path / "rl" / "checkpoints" / "last" / "pretrained_model"
    assert ACTPolicy.from_pretrained(last).config.n_action_steps == 2
    env = WorldModelEnv(**models, dataset=StartFrames(root=str(small_dataset.root)), episode_length=4)
    assert len(evaluate_policy(env, loaded(last), episodes=2, seed=0, num_envs=2).successes) == 2


def test_adapters_of_act_are_trained_too() -> None:
    act = small_act(images=False)
    act.config.pretrained_path = Path("cloned")  # which LeRobot asks of what it adapts
    policy = with_new_adapters(act, PeftConfig(method_type="LORA", target_modules=["linear1"], r=2))
    algorithm = PPO(policy, PPOConfig(initial_std=0.2))
    sample = algorithm.policy.sample(OBSERVATION)
    assert sample.raw_action.shape == (2, ACTED, 3)
    names = {id(value): name for name, value in policy.named_parameters()}
    trained = {names.get(id(each), "") for each in algorithm.policy_parameters}
    assert any("lora_A" in name for name in trained)

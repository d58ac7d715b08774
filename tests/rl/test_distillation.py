"""Distillation of the planner: labels, and lerobot-wmrl-train with it."""

import json
import shutil
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.tdmpc.configuration_tdmpc import TDMPCConfig
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
from lerobot.policies.vqbet.modeling_vqbet import VQBeTPolicy
from lerobot.processor import UnnormalizerProcessorStep
from lerobot.utils.constants import ACTION
from safetensors.torch import load_file
from torch import Tensor

from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.checkpoints import model_folder
from lerobot_wmrl.common.errors import FieldError, TrainingStopped
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.pipeline import action_unit, unchanged
from lerobot_wmrl.common.policy_checks import require_distillable
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.envs.world_model_env import WorldModelVectorEnv
from lerobot_wmrl.rl import distillation
from lerobot_wmrl.rl.configuration_distillation import DistillationConfig
from lerobot_wmrl.rl.expert_labels import (
    ExpertLabelBatch,
    ExpertLabels,
    Windows,
    action_windows,
    imagined_labels,
    recorded_successes,
    require_memory,
    successes,
)
from lerobot_wmrl.rl.observations import ObservationBuffer
from lerobot_wmrl.scripts.train import main
from lerobot_wmrl.world_models.configuration_planner import PlannerSettings
from lerobot_wmrl.world_models.planning import Planner
from tests.hub_server import Hub
from tests.lerobot_policy_openvla.small import small_policy
from tests.rl.act_checkpoint import IMAGE, STATE, save_small_act
from tests.rl.checkpoints import save_untrained_policy
from tests.rl.small_pi0 import publish_tokenizer, shrink_pi0, small_pi0
from tests.rl.small_smolvla import save_small_smolvlm, small_smolvla

FAST = [
    "--algorithm.type=distillation",
    "--algorithm.planner.horizon=6",
    "--algorithm.planner.samples=4",
    "--algorithm.planner.elites=2",
    "--algorithm.planner.iterations=1",
    "--algorithm.planner.knots=3",
    "--algorithm.planner.execute=2",
    "--algorithm.longest_lead=2",
    "--algorithm.updates=2",
    "--algorithm.last_updates=3",
    "--algorithm.batch_size=4",
    "--algorithm.recorded=false",
    "--num_envs=3",
    "--iterations=3",
    "--save_freq=1",
]


@pytest.fixture
def imagined(trained_models: dict[str, Path], small_dataset: LeRobotDataset) -> list[str]:
    """Flags of a world model in which every episode succeeds after four frames."""
    return [
        "--env.type=world_model",
        f"--env.world_model_path={trained_models['action_world_model']}",
        "--env.reward.type=general",
        "--env.reward.alpha=1",
        f"--env.dataset.root={small_dataset.root}",
        "--env.episode_length=6",
        "--env.done_frames=4",
        "--env.done_threshold=1e-6",
        "--env.device=cpu",
        "--gate.action=off",
    ]


def train(monkeypatch: pytest.MonkeyPatch, *flags: str) -> None:
    monkeypatch.setattr(sys, "argv", ["lerobot-wmrl-train", *flags])
    main()


def distil(
    made: Any, stats: dict[str, Any], policy: Path, flags: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Save a policy with processors for data of these statistics, and fit it to recorded episodes too."""
    made.save_pretrained(policy)
    for processor in make_pre_post_processors(made.config, dataset_stats=stats):
        processor.save_pretrained(policy)
    train(monkeypatch, f"--policy.path={policy}", *FAST, "--algorithm.recorded=true", *flags)


def weights(output_dir: Path) -> dict[str, Tensor]:
    return load_file(output_dir / "checkpoints" / "last" / "pretrained_model" / "model.safetensors")


def test_it_trains_on_the_planners_successes_and_resumes_as_if_nothing_had_happened(
    imagined: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, output_dir = save_untrained_policy(tmp_path / "policy", actions=7), tmp_path / "rl"
    flags = [f"--policy.path={policy}", *FAST, *imagined, f"--output_dir={output_dir}"]
    train(monkeypatch, *flags)
    lines = read_metrics(output_dir)
    assert [line["success_rate"] for line in lines] == [1, 1, 1]
    assert lines[0]["lead"] == 0
    assert lines[0]["labels"] == 3 * 4
    expected = 0
    for line in lines:
        expected += 3 * (4 - int(line["lead"]))
        assert line["labels"] == expected
    assert [line["updates"] for line in lines] == [2, 2, 3]
    before = load_file(policy / "model.safetensors")
    after = weights(output_dir)
    assert any(not torch.equal(before[name], value) for name, value in after.items())
    for step in ("000002", "000003"):
        shutil.rmtree(output_dir / "checkpoints" / step)
    train(monkeypatch, *flags)
    assert all(torch.equal(value, after[name]) for name, value in weights(output_dir).items())


def test_the_planner_has_its_turn_however_long_the_rollout_may_take(
    imagined: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The policy's lead ends before the first episode can."""
    policy, longer = save_untrained_policy(tmp_path / "policy", actions=7), "--algorithm.longest_lead=50"
    unending = [flag for flag in imagined if "done_" not in flag] + ["--env.done_frames=2"]
    whole_step = WorldModelVectorEnv.step

    def step(env: WorldModelVectorEnv, actions: Tensor) -> tuple[Any, ...]:
        """End every episode in success at its last step."""
        observation, reward, terminated, truncated, info = whole_step(env, actions)
        return observation, reward, terminated | truncated, torch.zeros_like(truncated), info

    monkeypatch.setattr(WorldModelVectorEnv, "step", step)
    flags = [f"--policy.path={policy}", *FAST, *unending, longer, "--rollout_steps=15", "--iterations=6"]
    train(monkeypatch, *flags, f"--output_dir={tmp_path / 'rl'}")
    labels = [int(line["labels"]) for line in read_metrics(tmp_path / "rl")]
    assert all(later > earlier for earlier, later in zip([0, *labels], labels, strict=False))


def test_an_encoder_may_stay_as_it_was(
    imagined: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = save_untrained_policy(tmp_path / "policy", IMAGE, actions=7)
    flags = [f"--policy.path={policy}", *FAST, *imagined, "--iterations=1", f"--output_dir={tmp_path / 'rl'}"]
    train(monkeypatch, *flags, "--algorithm.train_encoder=false")
    before, after = load_file(policy / "model.safetensors"), weights(tmp_path / "rl")
    kept = {name for name, value in before.items() if torch.equal(value, after[name])}
    encoder = {name for name in before if name.startswith("encoder.")}
    assert encoder
    assert encoder <= kept
    assert any(name.startswith("actor.") for name in before.keys() - kept)


def test_imagined_frames_are_kept_as_small_as_they_are_imagined(
    imagined: list[str], trained_models: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The policy sees them in the size of its camera's, and recorded ones in full."""
    world_model = tmp_path / "world_model"
    shutil.copytree(model_folder(trained_models["action_world_model"]), world_model)
    config = json.loads((world_model / "config.json").read_text())
    config["tokenizer"]["frame_sizes"] = [[48, 80]]
    write_json(world_model / "config.json", config)
    policy = save_untrained_policy(tmp_path / "policy", size=(48, 80), actions=7)
    given = [flag for flag in imagined if "world_model_path" not in flag]
    flags = [f"--policy.path={policy}", f"--env.world_model_path={world_model}", *given]
    own = [*FAST, "--algorithm.recorded=true", f"--output_dir={tmp_path / 'distilled'}"]
    train(monkeypatch, *flags, *own)
    for file in (tmp_path / "distilled" / "labels").iterdir():
        stored = load_file(file)
        assert stored[IMAGE].shape[1:] == (3, 32, 32)
        assert {*stored} == {IMAGE, "task", ACTION, "rows"}, "the policy has no input for the state"
    seen = []
    evaluate = CnnPolicy.evaluate
    monkeypatch.setattr(
        CnnPolicy,
        "evaluate",
        lambda self, observation, raw: (
            seen.append(observation[IMAGE].shape[1:]) or evaluate(self, observation, raw)
        ),
    )
    train(monkeypatch, *flags, "--num_envs=2", "--iterations=1", f"--output_dir={tmp_path / 'ppo'}")
    assert {*seen} == {(3, 48, 80)}


def test_a_limit_of_zero_limits_no_gradient(
    imagined: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in lerobot-train: it leaves the same weights as a limit that is never reached."""
    policy, found = save_untrained_policy(tmp_path / "policy", actions=7), []
    for limit in ("0", "1e9"):
        folder = tmp_path / limit
        flags = [f"--policy.path={policy}", f"--policy.optimizer_grad_clip_norm={limit}", *FAST, *imagined]
        train(monkeypatch, *flags, "--iterations=1", f"--output_dir={folder}")
        found.append(weights(folder))
    assert all(torch.equal(value, found[1][name]) for name, value in found[0].items())


def test_the_planners_search_begins_at_what_the_policy_would_do(
    imagined: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With one sample the plan is the proposal."""
    policy_actions, plan = WorldModelVectorEnv.policy_actions, Planner.plan
    proposals, plans, steps_left = [], [], []

    def spied_policy_actions(*args: Any) -> Tensor:
        proposals.append(policy_actions(*args))
        return proposals[-1]

    def spied_plan(*args: Any) -> Tensor:
        plans.append(plan(*args))
        steps_left.append(args[-1])
        return plans[-1]

    monkeypatch.setattr(WorldModelVectorEnv, "policy_actions", spied_policy_actions)
    monkeypatch.setattr(Planner, "plan", spied_plan)
    policy = save_untrained_policy(tmp_path / "policy", actions=7)
    single = ["samples=1", "elites=1", "iterations=1", "knots=3", "execute=2"]
    flags = [f"--policy.path={policy}", *FAST, *(f"--algorithm.planner.{each}" for each in single)]
    train(monkeypatch, *flags, "--iterations=1", *imagined, f"--output_dir={tmp_path / 'rl'}")
    assert len(plans) == 2
    assert plans[0].shape == (3, 6, 7)
    assert steps_left == [6, 4], "the second plan begins after two steps"
    assert all(torch.allclose(*pair) for pair in zip(plans, proposals, strict=True))


def test_nothing_is_labelled_after_an_episode_has_ended(
    imagined: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole_step, steps = WorldModelVectorEnv.step, count()

    def step(env: WorldModelVectorEnv, actions: Tensor) -> tuple[Any, ...]:
        """End the first environment's episode after two steps, those of the others after four."""
        observation, reward, terminated, truncated, info = whole_step(env, actions)
        terminated[0] |= next(steps) == 1
        return observation, reward, terminated, truncated, info

    monkeypatch.setattr(WorldModelVectorEnv, "step", step)
    policy, output_dir = save_untrained_policy(tmp_path / "policy", actions=7), tmp_path / "rl"
    flags = [f"--policy.path={policy}", *FAST, "--iterations=1", *imagined]
    train(monkeypatch, *flags, f"--output_dir={output_dir}")
    assert read_metrics(output_dir)[-1]["labels"] == 2 + 4 + 4


@pytest.mark.parametrize("windows", [Windows(), Windows(None, [0, 1, 2]), Windows([-1, 0], [-1, 0, 1])])
def test_recorded_successes_are_labels_as_lerobots_datasets_give_them(
    small_dataset: LeRobotDataset, windows: Windows
) -> None:
    camera = "observation.images.third_view"
    source = StartFrames(root=str(small_dataset.root), max_starts=1, branches=2)
    (part,) = recorded_successes(source, {camera: (3, 32, 32)}, state_size=8, windows=windows)
    table = read_episodes(small_dataset)
    episodes = table.success.nonzero()[0]
    assert len(part) == table.length[episodes].sum()
    wanted = {ACTION: windows.actions, STATE: windows.observations, camera: windows.observations}
    seconds = {name: [step / small_dataset.fps for step in steps] for name, steps in wanted.items() if steps}
    given = LeRobotDataset(small_dataset.repo_id, small_dataset.root, delta_timestamps=seconds)
    for number, episode in enumerate(episodes):
        frames = part.observations["task"][part.rows.reshape(len(part), -1)[:, -1]]
        labels = (frames == number).nonzero()[:, 0]  # in the order of their steps
        assert len(labels) == table.length[episode]
        for step in (0, len(labels) - 1):
            label = {name: value[0] for name, value in part.batch(labels[step : step + 1]).items()}
            item = given[int(table.start[episode]) + step]
            assert label["task"] == item["task"]
            assert (label[camera] - item[camera]).abs().max() < 0.01
            assert torch.equal(label[STATE], item[STATE])
            assert torch.equal(label[ACTION], item[ACTION])
            if windows.actions:
                assert torch.equal(label["action_is_pad"], item["action_is_pad"])


def test_recorded_frames_that_do_not_fit_into_memory_are_refused(
    small_dataset: LeRobotDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = "observation.images.third_view"
    table, episodes = successes(StartFrames(root=str(small_dataset.root)))
    frames = int(table.length[episodes].sum())
    size = frames * 3 * 32 * 32
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=size))
    require_memory(frames, {camera: (3, 32, 32)})
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    with pytest.raises(FieldError, match=r"recorded=True: .* 0.0 GB of memory, and 0.0 GB are free"):
        require_memory(frames, {camera: (3, 32, 32)})


def test_windows_of_imagined_observations_end_with_the_step_itself() -> None:
    """Before the episode, the first is repeated. What was done before the planner took over is no label."""
    buffer = ObservationBuffer(steps=3, num_envs=2)
    for step in range(3):
        state = torch.tensor([[10.0 * step], [10.0 * step + 1]])
        buffer.write(step, {STATE: state, "task": [f"first {step}", f"second {step}"]})
    labelled = torch.tensor([[False, True], [True, False], [True, False]])
    actions = torch.tensor([[0.0, 1], [10, 11], [20, 21]])[..., None]
    part = imagined_labels(buffer, actions, labelled, Windows([-2, -1, 0], [-1, 0, 1]))
    batch = part.batch(torch.arange(3))
    assert batch[STATE][..., 0].tolist() == [[1, 1, 1], [0, 0, 10], [0, 10, 20]]
    assert batch["task"] == ["second 0", "first 1", "first 2"]
    assert batch[ACTION][..., 0].tolist() == [[1, 1, 1], [0, 10, 20], [10, 20, 20]]
    assert batch["action_is_pad"].tolist() == [
        [True, False, True],
        [True, False, False],
        [False, False, True],
    ]
    assert len(part.observations[STATE]) == 4, "each observation is kept once"
    part = imagined_labels(buffer, actions, labelled, Windows())
    assert part.batch(torch.arange(3))[STATE][:, 0].tolist() == [1, 10, 20]


def test_recorded_successes_are_learnt_too_and_a_resumed_training_reads_them_again(
    imagined: list[str], small_dataset: LeRobotDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, output_dir = save_untrained_policy(tmp_path / "policy", actions=7), tmp_path / "rl"
    flags = [f"--policy.path={policy}", *FAST, "--algorithm.recorded=true", *imagined]
    train(monkeypatch, *flags, f"--output_dir={output_dir}")
    table = read_episodes(small_dataset)
    recorded = table.length[table.success.nonzero()[0]].sum()
    assert recorded
    assert read_metrics(output_dir)[0]["labels"] == recorded + 3 * 4
    after = weights(output_dir)
    shutil.rmtree(output_dir / "checkpoints" / "000003")
    train(monkeypatch, *flags, f"--output_dir={output_dir}")
    assert all(torch.equal(value, after[name]) for name, value in weights(output_dir).items())


def test_policies_of_chunks_learn_chunks(
    imagined: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, output_dir = save_small_act(tmp_path / "act", state=8, actions=7), tmp_path / "rl"
    train(monkeypatch, f"--policy.path={policy}", *FAST, *imagined, f"--output_dir={output_dir}")
    assert read_metrics(output_dir)[-1]["labels"] >= 3 * 4
    assert len(weights(output_dir))


FEATURES: dict[str, Any] = {
    "device": "cpu",
    "pretrained_backbone_weights": None,
    "crop_shape": None,
    "use_group_norm": True,
    "spatial_softmax_num_keypoints": 4,
    "input_features": {
        IMAGE: PolicyFeature(FeatureType.VISUAL, (3, 32, 32)),
        STATE: PolicyFeature(FeatureType.STATE, (8,)),
    },
    "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (7,))},
}


def small_vqbet(observations: int) -> VQBeTPolicy:
    return VQBeTPolicy(
        VQBeTConfig(
            **FEATURES,
            n_obs_steps=observations,
            n_vqvae_training_steps=1,
            vqvae_embedding_dim=8,
            vqvae_enc_hidden_dim=8,
            gpt_input_dim=16,
            gpt_output_dim=16,
            gpt_hidden_dim=16,
            gpt_n_layer=1,
            gpt_n_head=2,
        )
    )


def small_diffusion(observations: int) -> DiffusionPolicy:
    return DiffusionPolicy(
        DiffusionConfig(
            **FEATURES,
            n_obs_steps=observations,
            horizon=8,
            n_action_steps=4,
            down_dims=(16, 32),
            n_groups=4,
            diffusion_step_embed_dim=16,
            num_train_timesteps=4,
        )
    )


@pytest.mark.parametrize(("make", "observations"), [(small_vqbet, 1), (small_vqbet, 3), (small_diffusion, 2)])
def test_policies_of_several_observations_learn_from_as_many(
    make: Callable[[int], Any],
    observations: int,
    imagined: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """VQ-BeT learns from observations (B, n, …), also where n is 1."""
    made, policy, output_dir = make(observations), tmp_path / "policy", tmp_path / "rl"
    stats = {
        key: {"min": torch.full(size, -1.0), "max": torch.ones(size)}
        for key, size in ((STATE, (8,)), (ACTION, (7,)))
    }
    stats[IMAGE] = {"mean": torch.zeros(3, 1, 1), "std": torch.ones(3, 1, 1)}
    distil(made, stats, policy, [*imagined, f"--output_dir={output_dir}"], monkeypatch)
    assert read_metrics(output_dir)[-1]["labels"] >= 3 * 4
    before = load_file(policy / "model.safetensors")
    assert any(not torch.equal(before[name], value) for name, value in weights(output_dir).items())


def test_openvla_learns_from_the_planner(
    imagined: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its actions are tokens, not normalised numbers."""
    action = PolicyFeature(type=FeatureType.ACTION, shape=(7,))
    made = small_policy(output_features={"action": action})
    policy, output_dir = tmp_path / "policy", tmp_path / "rl"
    limits = {"min": torch.full((7,), -1.0), "max": torch.ones(7)}
    stats = {ACTION: {**limits, "q01": limits["min"], "q99": limits["max"]}}
    distil(made, stats, policy, [*imagined, f"--output_dir={output_dir}"], monkeypatch)
    assert read_metrics(output_dir)[-1]["labels"] >= 3 * 4
    before = load_file(policy / "model.safetensors")
    assert any(not torch.equal(before[name], value) for name, value in weights(output_dir).items())


def test_a_unit_is_what_the_policys_normalisation_makes_of_one() -> None:
    features = {ACTION: PolicyFeature(FeatureType.ACTION, (2,))}
    config = CnnConfig(device="cpu", output_features=features)
    stats = {ACTION: {"mean": torch.tensor([5.0, 0.0]), "std": torch.tensor([0.5, 2.0])}}
    unnormalised = UnnormalizerProcessorStep(
        features, {FeatureType.ACTION: NormalizationMode.MEAN_STD}, stats=stats
    )
    plain = UnnormalizerProcessorStep(features, {FeatureType.ACTION: NormalizationMode.IDENTITY}, stats=stats)
    unit = action_unit(config, SimpleNamespace(steps=[unnormalised]))
    torch.testing.assert_close(unit, torch.tensor([0.5, 2.0]), atol=1e-4, rtol=1e-4)
    assert action_unit(config, SimpleNamespace(steps=[plain])) is None


def test_policies_of_relative_actions_are_refused() -> None:
    """Those that are taken later in a chunk would be relative to another state."""
    with pytest.raises(FieldError, match="this pi0 predicts relative actions"):
        require_distillable(PI0Config(use_relative_actions=True))


@pytest.mark.parametrize("kind", ["smolvla", "pi0"])
def test_a_vla_with_action_chunks_learns_from_the_planner(
    kind: str, imagined: list[str], hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It reads the task. The weights of SmolVLA's language model stay as they are."""
    features = {name: FEATURES[name] for name in ("device", "input_features", "output_features")}
    if kind == "smolvla":
        made: Any = small_smolvla(save_small_smolvlm(tmp_path / "smolvlm"), **features)
    else:
        shrink_pi0(monkeypatch)
        publish_tokenizer(hub, tmp_path / "tokenizer")
        made = small_pi0(**features)
    policy, output_dir = tmp_path / "policy", tmp_path / "rl"
    stats = {
        key: {"mean": torch.zeros(size), "std": torch.ones(size)} for key, size in ((STATE, 8), (ACTION, 7))
    }
    distil(made, stats, policy, [*imagined, f"--output_dir={output_dir}"], monkeypatch)
    assert read_metrics(output_dir)[-1]["labels"] >= 3 * 4
    before, after = load_file(policy / "model.safetensors"), weights(output_dir)
    learnt = {name for name in before if not torch.equal(before[name], after[name])}
    expert = ".lm_expert." if kind == "smolvla" else ".gemma_expert."
    assert any(expert in name for name in learnt)
    assert not any(".vlm." in name for name in learnt)


def test_what_hardly_varied_where_the_policy_was_trained_is_left_as_it_is(
    imagined: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its normalisation would make errors in it outweigh all others."""
    stuck, output_dir = save_untrained_policy(tmp_path / "policy", actions=7, constant=0.01), tmp_path / "rl"
    flags = [f"--policy.path={stuck}", *FAST, *imagined, f"--output_dir={output_dir}"]
    with pytest.raises(SystemExit):
        train(monkeypatch, *(flag.replace("recorded=false", "recorded=true") for flag in flags))
    assert (
        "x varies in the recorded episodes, and hardly where the policy was trained"
        in capsys.readouterr().err
    )
    train(monkeypatch, *flags)
    labels = ExpertLabels(output_dir / "labels", 0)
    labels.load(3)
    for part in labels.imagined:
        actions = part.actions["action"]
        torch.testing.assert_close(actions, torch.full_like(actions, 0.01), atol=1e-3, rtol=0)


def test_where_nothing_recorded_succeeds_nothing_of_it_is_learnt_and_it_is_read_once(
    imagined: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That something in it varied and did not for the policy is no reason to stop."""
    reads = []
    monkeypatch.setattr(distillation, "recorded_successes", lambda *given: reads.append(given) or [])
    stuck = save_untrained_policy(tmp_path / "policy", actions=7, constant=0.01)
    flags = [f"--policy.path={stuck}", *FAST, *imagined, "--algorithm.recorded=true"]
    train(monkeypatch, *flags, "--env.dataset.episodes=[2,5]", f"--output_dir={tmp_path / 'rl'}")
    assert len(reads) == 1
    assert len(read_metrics(tmp_path / "rl")) == 3


def test_without_a_success_there_is_nothing_to_learn_from(
    imagined: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = save_untrained_policy(tmp_path / "policy", actions=7)
    flags = [f"--policy.path={policy}", *FAST, *imagined, f"--output_dir={tmp_path / 'rl'}"]
    with pytest.raises(SystemExit):
        train(monkeypatch, *flags, "--env.done_threshold=0.999999")
    assert "raise --algorithm.planner.samples or" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["--env.type=wmrl_maniskill"], "--algorithm.type=distillation: its planner looks ahead"),
        (
            ["--env.done_frames=8", "--env.episode_length=20"],
            "--algorithm.planner.horizon=6: must be",
        ),
        (["--algorithm.planner.elites=5"], "--algorithm.planner.elites=5: must be at most"),
        (["--algorithm.updates=-1"], "--algorithm.updates=-1: must be at least 0"),
    ],
)
def test_what_cannot_be_is_refused_by_its_flag(
    flags: list[str],
    named: str,
    imagined: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    policy = save_untrained_policy(tmp_path / "policy", actions=7)
    given = imagined if not flags[0].startswith("--env.type") else []
    with pytest.raises(SystemExit):
        train(
            monkeypatch, f"--policy.path={policy}", *FAST, *given, *flags, f"--output_dir={tmp_path / 'rl'}"
        )
    assert named in capsys.readouterr().err
    assert not (tmp_path / "rl").exists()


def test_policies_that_learn_from_what_follows_are_refused_before_anything_is_made(
    imagined: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    TDMPCConfig(device="cpu").save_pretrained(tmp_path / "tdmpc")
    flags = [f"--policy.path={tmp_path / 'tdmpc'}", *FAST, *imagined, f"--output_dir={tmp_path / 'rl'}"]
    with pytest.raises(SystemExit):
        train(monkeypatch, *flags)
    assert "tdmpc learns from later observations, and a planner's labels have none" in capsys.readouterr().err
    assert not (tmp_path / "rl").exists()


def test_settings_of_the_planner_are_checked_where_they_are():
    with pytest.raises(FieldError, match=r"^planner.knots=1"):
        DistillationConfig(planner=PlannerSettings(knots=1))


def test_a_chunk_ends_with_its_run_and_repeats_the_last_action():
    actions = torch.arange(4.0)[:, None, None] + torch.tensor([0.0, 10.0])[:, None]  # (T, B, 1)
    labelled = torch.tensor([[True, False], [True, True], [True, True], [False, True]])
    found = action_windows(actions, labelled, [0, 1])
    assert found["action"][..., 0].tolist() == [[0, 1], [1, 2], [11, 12], [2, 2], [12, 13], [13, 13]]
    assert found["action_is_pad"].tolist() == [
        [False, False],
        [False, False],
        [False, False],
        [False, True],
        [False, False],
        [False, True],
    ]
    assert action_windows(actions, labelled, None)["action"][:, 0].tolist() == [0, 1, 11, 2, 12, 13]


def labels_of(iteration: int) -> ExpertLabelBatch:
    """As many as twice the number of the iteration."""
    count = 2 * iteration
    part = {
        "observation.images.top": torch.full((count, 3, 2, 2), 51 * iteration, dtype=torch.uint8),
        "task": torch.zeros(count, dtype=torch.long),
    }
    actions = {"action": iteration + torch.arange(float(count))[:, None] / 10}
    return ExpertLabelBatch(part, actions, torch.arange(count), [f"task {iteration}"])


@pytest.mark.parametrize("damage", ["missing", "torn"])
def test_labels_that_cannot_be_read_are_named(damage: str, tmp_path: Path) -> None:
    labels = ExpertLabels(tmp_path, 0)
    for iteration in range(2):
        labels.add(iteration, labels_of(iteration))
    labels.path(1).unlink() if damage == "missing" else labels.path(1).write_bytes(b"")
    with pytest.raises(ValueError, match=r"000001-0\.safetensors: cannot be read .* iteration 2; restore it"):
        ExpertLabels(tmp_path, 0).load(2)


def test_labels_that_do_not_fit_into_memory_end_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    labels, size = ExpertLabels(tmp_path, 0), 4 * (12 + 8 + 4 + 8)  # images, task, action, row
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=size))
    labels.add(0, labels_of(2))
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    with pytest.raises(TrainingStopped, match=r"^iteration 2: .*: lower `num_envs` or `iterations`"):
        labels.add(1, labels_of(2))
    assert len(labels) == 4


def test_labels_are_the_same_when_they_are_read_again(tmp_path: Path):
    labels = ExpertLabels(tmp_path, 0)
    for iteration in range(3):  # the first iteration has none
        labels.add(iteration, labels_of(iteration))
    again = ExpertLabels(tmp_path, 0)
    again.load(3)
    assert len(again) == len(labels) == 6
    for store in (labels, again):
        torch.manual_seed(0)
        batch = store.draw(40, unchanged)
        values = batch["action"][:, 0]
        assert set(values.tolist()) == set(torch.tensor([1, 1.1, 2, 2.1, 2.2, 2.3]).tolist())
        assert torch.allclose(batch["observation.images.top"].mean((1, 2, 3)), values.floor() / 5)
        assert batch["task"] == [f"task {int(value)}" for value in values]

"""The small image policy: one distribution samples and measures, constants stay constant, it learns."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import draccus
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors
from torch import nn
from torch.distributions import Normal

from lerobot_policy_cnn.configuration_cnn import MAX_STD, MIN_STD, CnnConfig
from lerobot_policy_cnn.modeling_cnn import SUMMARY, UNKNOWN_POLICY, CnnPolicy
from lerobot_policy_cnn.networks import ImageEncoder, InstructionEncoder, instance_norm
from lerobot_policy_cnn.processor_cnn import make_cnn_pre_post_processors
from lerobot_wmrl.common.images import random_shift
from lerobot_wmrl.common.policies import load_processors, read_policy_config
from tests.commands import run_here
from tests.hub_server import Hub

IMAGE = "observation.images.third_view"
TRAINED = Path("checkpoints/last/pretrained_model")


def image_feature(size: int) -> PolicyFeature:
    return PolicyFeature(type=FeatureType.VISUAL, shape=(3, size, size))


def build(
    cameras: int = 1, size: int = 32, actions: int = 7, state: bool = True, **settings: Any
) -> CnnPolicy:
    torch.manual_seed(0)
    inputs = {f"observation.images.camera{index}": image_feature(size) for index in range(cameras)}
    if state:
        inputs["observation.state"] = PolicyFeature(type=FeatureType.STATE, shape=(8,))
    outputs = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(actions,))}
    config = CnnConfig(device="cpu", input_features=inputs, output_features=outputs, width=8, **settings)
    policy = CnnPolicy(config).eval()
    nn.init.normal_(policy.actor[-1].weight, std=0.3)
    return policy


def observe(policy: CnnPolicy, batch: int = 6) -> dict[str, Any]:
    inputs = policy.config.input_features or {}
    observation: dict[str, Any] = {
        name: torch.rand(batch, *feature.shape) for name, feature in inputs.items()
    }
    return {**observation, "task": ["push the red cube forward"] * batch}


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_channels_are_normalised_as_by_instance_normalisation(layout: torch.memory_format) -> None:
    maps = (3 + 5 * torch.randn(4, 6, 8, 12)).contiguous(memory_format=layout)
    assert torch.allclose(instance_norm(maps), nn.functional.instance_norm(maps), atol=1e-5)


@pytest.fixture(scope="module")
def cloning(small_dataset: LeRobotDataset) -> tuple[CnnPolicy, Any, Any, dict[str, Any]]:
    """A policy that has learnt 48 frames by heart, its processors, and those frames."""
    torch.manual_seed(0)
    meta = deepcopy(small_dataset.meta)
    policy = make_policy(CnnConfig(device="cpu", max_shift=0, width=8), ds_meta=meta)
    pre, post = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    rows = [small_dataset[index] for index in range(48)]
    raw = {name: torch.stack([row[name] for row in rows]) for name in (IMAGE, "observation.state", "action")}
    batch = {**raw, "task": [row["task"] for row in rows]}
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=policy.config.optimizer_lr)
    policy.train()
    for _ in range(250):
        optimizer.zero_grad()
        policy(pre(dict(batch)))[0].backward()
        optimizer.step()
    return policy.eval(), pre, post, batch


def test_sampling_and_evaluating_use_one_distribution() -> None:
    policy, observation = build(), observe(build())
    policy.set_std(0.2)
    sample = policy.sample(observation)
    log_prob, entropy, value = policy.evaluate(observation, sample.raw_action)
    assert log_prob.shape == sample.raw_action.shape == (6, 7)
    assert log_prob.dtype == torch.float32
    assert torch.equal(log_prob, sample.log_prob)
    assert torch.equal(value, sample.value)
    mean = policy.select_action(observation)
    assert torch.allclose(log_prob, Normal(mean, 0.2).log_prob(sample.raw_action), atol=1e-4)
    assert torch.allclose(entropy, Normal(mean, 0.2).entropy().sum(dim=1), atol=1e-4)


def test_samples_spread_as_the_std_says() -> None:
    policy = build(initial_std=0.4)
    one = observe(policy, 1)
    observation = {
        name: value * 800 if name == "task" else torch.cat([value] * 800) for name, value in one.items()
    }
    raw = policy.sample(observation).raw_action
    assert torch.allclose(raw.std(dim=0), torch.full((7,), 0.4), atol=0.06)
    assert (raw.mean(dim=0) - policy.select_action(one)).abs().max() < 0.06


def test_the_std_stays_within_its_bounds_and_can_leave_them() -> None:
    policy = build()
    for logit in (-50.0, 50.0):
        nn.init.constant_(policy.std_logit, logit)
        assert (policy.std() >= MIN_STD - 1e-4).all()
        assert (policy.std() <= MAX_STD + 1e-4).all()
    policy.set_std(MAX_STD)
    policy.std().sum().backward()
    assert policy.std_logit.grad is not None
    assert (policy.std_logit.grad > 0).all()
    with pytest.raises(ValueError, match=r"initial_std=0\.04.*0\.05"):
        policy.set_std(0.04)


def test_no_layer_depends_on_the_rest_of_the_batch() -> None:
    policy = build(cameras=2).train()
    assert not [module for module in policy.modules() if isinstance(module, nn.modules.batchnorm._BatchNorm)]
    observation = observe(policy)
    alone = {name: value[:1] for name, value in observation.items()}
    assert torch.allclose(policy.value(observation)[:1], policy.value(alone), atol=1e-5)


def test_training_the_policy_leaves_the_value_alone() -> None:
    policy, observation = build(), observe(build())
    policy.train()
    policy({**observation, "action": torch.randn(6, 7)})[0].backward()
    assert all(parameter.grad is None for parameter in policy.value_parameters())
    owned = {id(parameter) for group in policy.get_optim_params() for parameter in group["params"]}
    assert owned.isdisjoint({id(parameter) for parameter in policy.value_parameters()})
    assert len(owned) + len(list(policy.value_parameters())) == len(list(policy.parameters()))


def test_it_overfits_one_batch(cloning: tuple[CnnPolicy, Any, Any, dict[str, Any]]) -> None:
    policy, pre, post, batch = cloning
    action = post(policy.select_action(pre(dict(batch))))
    error = (action - batch["action"])[:, :2].square().mean().sqrt()
    assert error < 0.3 * batch["action"][:, :2].std()


def test_the_std_after_cloning_is_that_of_the_residuals(
    cloning: tuple[CnnPolicy, Any, Any, dict[str, Any]],
) -> None:
    policy, pre, _, batch = cloning
    prepared = pre(dict(batch))
    residual = (policy.select_action(prepared) - prepared["action"])[:, policy.varies()]
    learnt = policy.std()[policy.varies()]
    expected = residual.square().mean(dim=0).sqrt().clamp(MIN_STD, MAX_STD)
    assert (learnt < policy.config.initial_std).all()
    assert (learnt / expected).log().abs().max() < 0.7


def test_constant_components_are_neither_sampled_nor_blown_up(
    cloning: tuple[CnnPolicy, Any, Any, dict[str, Any]],
) -> None:
    """Rotations are 0 and the gripper closed in every frame, whatever normalisation makes of a std of 0."""
    policy, pre, post, batch = cloning
    assert policy.varies().tolist() == [True, True, False, False, False, False, False]
    prepared = pre(dict(batch))
    assert prepared["action"].abs().max() < 10
    assert prepared["observation.state"].abs().max() < 10
    with torch.no_grad():
        policy.actor[-1].bias += 1.0
        sample = policy.sample(prepared)
        policy.actor[-1].bias -= 1.0
    assert torch.allclose(post(sample.raw_action)[:, 2:], batch["action"][:, 2:], atol=1e-6)
    assert (sample.log_prob[:, 2:] == 0).all()
    assert (sample.log_prob[:, :2] != 0).all()


def test_a_policy_that_is_cloned_further_does_not_blow_up_constants_either(
    small_dataset: LeRobotDataset, tmp_path: Path
) -> None:
    """lerobot-train then gives a checkpoint's processors the statistics of its dataset."""
    data = [
        "--dataset.repo_id=local/synthetic",
        f"--dataset.root={small_dataset.root}",
        "--steps=1",
        "--batch_size=2",
        "--num_workers=0",
        "--env_eval_freq=0",
        "--policy.push_to_hub=false",
    ]
    first, further = tmp_path / "first", tmp_path / "further"
    run_here("lerobot-train", "--policy.type=cnn", "--policy.device=cpu", *data, f"--output_dir={first}")
    run_here("lerobot-train", f"--policy.path={first / TRAINED}", *data, f"--output_dir={further}")
    state = small_dataset[0]["observation.state"]
    for folder in (first, further):
        pre, _ = load_processors(read_policy_config(str(folder / TRAINED), []))
        seen = pre({"observation.state": state + 1e-3, "action": torch.full((7,), 1e-6)})
        still = pre({"observation.state": state, "action": torch.zeros(7)})
        for name, unit in (("observation.state", 0.1), ("action", 0.01)):
            assert (seen[name] - still[name]).abs().max() <= unit + 1e-4


def test_actions_survive_normalisation_and_back(small_dataset: LeRobotDataset) -> None:
    policy = build(actions=7)
    pre, post = make_cnn_pre_post_processors(policy.config, small_dataset.meta.stats)
    action = small_dataset[3]["action"][None]
    prepared = pre({"action": action, "observation.state": torch.zeros(1, 8)})
    assert torch.allclose(post(prepared["action"]), action, atol=1e-6)


def test_a_checkpoint_gives_the_same_actions(
    cloning: tuple[CnnPolicy, Any, Any, dict[str, Any]], tmp_path: Path
) -> None:
    policy, pre, _, batch = cloning
    policy.save_pretrained(tmp_path)
    prepared = pre(dict(batch))
    loaded = CnnPolicy.from_pretrained(tmp_path)
    assert torch.equal(loaded.select_action(prepared), policy.select_action(prepared))
    assert torch.equal(loaded.std(), policy.std())
    assert torch.equal(loaded.varies(), policy.varies())


@pytest.mark.parametrize("size", [32, 64, 96])
def test_features_tell_where_something_is(size: int) -> None:
    """A square moved by one pixel, anywhere in an image of any size, changes the features."""
    torch.manual_seed(0)
    encoder = ImageEncoder(8)
    images = torch.zeros(3, 3, size, size)
    for index, (row, column) in enumerate(((10, 10), (10, 11), (20, 10))):
        images[index, :, row : row + 4, column : column + 4] = 1
    features = encoder(images)
    assert features.shape == (3, encoder.size)
    assert (features[0] - features[1]).abs().max() > 1e-3
    assert (features[0] - features[2]).abs().max() > 1e-2


def test_every_instruction_has_an_embedding_of_its_own() -> None:
    encoder = InstructionEncoder()
    texts = ["push the can forward", "pull the can back", "", "нечто новое", "push the can forward"]
    embedded = encoder(texts)
    assert torch.equal(embedded[0], embedded[4])
    assert all((embedded[0] - embedded[index]).abs().max() > 1e-3 for index in (1, 2, 3))


def test_a_random_shift_moves_images_by_whole_pixels() -> None:
    torch.manual_seed(0)
    image = torch.rand(1, 3, 16, 16)
    shifted = random_shift(image.expand(40, -1, -1, -1), 2)
    inner = {
        (top, left): image[0, :, 4 + top : 12 + top, 4 + left : 12 + left]
        for top in range(-2, 3)
        for left in range(-2, 3)
    }
    moves = [
        [move for move, window in inner.items() if torch.equal(one[:, 4:12, 4:12], window)] for one in shifted
    ]
    assert all(len(move) == 1 for move in moves)
    assert len({move[0] for move in moves}) > 10


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"initial_std": 1.5}, "initial_std=1.5"),
        ({"n_obs_steps": 2}, "n_obs_steps=2"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CnnConfig(device="cpu", **settings)


def test_a_policy_with_nothing_to_see_is_refused() -> None:
    with pytest.raises(ValueError, match="needs an image"):
        build(cameras=0, state=False)


def test_cameras_do_not_share_weights_and_state_can_be_left_out() -> None:
    policy = build(cameras=2, use_state=False)
    assert set(policy.config.input_features) == set(policy.config.image_features)
    observation = observe(policy)
    action = policy.select_action(observation)
    swapped = dict(observation)
    swapped["observation.images.camera0"] = observation["observation.images.camera1"]
    swapped["observation.images.camera1"] = observation["observation.images.camera0"]
    assert not torch.allclose(action, policy.select_action(swapped), atol=1e-4)
    observation["observation.state"] = torch.full((6, 8), 9.0)
    assert torch.equal(action, policy.select_action(observation))


def test_depth_maps_are_left_out() -> None:
    inputs = dict(build().config.input_features or {})
    depth = PolicyFeature(type=FeatureType.VISUAL, shape=(1, 32, 32))
    config = CnnConfig(
        device="cpu",
        input_features={**inputs, "observation.images.camera0_depth": depth},
        output_features=build().config.output_features,
    )
    assert CnnPolicy(config).config.input_features == inputs


def test_a_published_policy_is_the_trained_one_and_its_card_says_what_it_is(
    hub: Hub, cloning: tuple[CnnPolicy, Any, Any, dict[str, Any]]
) -> None:
    policy, pre, _, batch = cloning
    policy.config.repo_id = "somebody/cnn"
    policy.push_model_to_hub(TrainPipelineConfig(DatasetConfig("somebody/data"), policy=policy.config))
    published = hub.repos["models", "somebody/cnn"].head
    assert {"config.json", "model.safetensors", "train_config.json", "README.md"} <= published.keys()
    card = published["README.md"].decode()
    assert SUMMARY in card
    assert "somebody/data" in card
    assert UNKNOWN_POLICY not in card
    prepared = pre(dict(batch))
    loaded = CnnPolicy.from_pretrained("somebody/cnn")
    assert torch.equal(loaded.select_action(prepared), policy.select_action(prepared))


def test_a_chunk_of_one_action_is_no_setting_that_is_saved(tmp_path: Path) -> None:
    """lerobot-train asks for `chunk_size` where it weights samples."""
    config = CnnConfig(device="cpu")
    assert config.chunk_size == 1
    assert "chunk_size" not in draccus.encode(config)
    config._save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path) == config

"""One categorical samples and measures; the value learns from the state and not the reverse; it clones."""

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors

from lerobot_policy_openvla.loading import compute_dtype
from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.ppo import PPO
from tests.lerobot_policy_openvla.small import (
    ACTIONS,
    CAMERA,
    SMALL_SIZES,
    observe,
    random_ids,
    row_of,
    small_config,
    small_policy,
)


@torch.no_grad()
@pytest.mark.parametrize("temperature", [0.5, 1.0, 1.7])
def test_samples_have_the_log_probs_that_they_are_evaluated_to(temperature: float) -> None:
    """So the ratio of a first minibatch is 1, at any temperature, with a cache and with padded rows."""
    policy, observation = small_policy(temperature=temperature), observe()
    sample = policy.sample(observation)
    log_prob, entropy, value = policy.evaluate(observation, sample.raw_action)
    assert sample.raw_action.shape == log_prob.shape == (4, ACTIONS)
    assert sample.raw_action.dtype == torch.int64
    assert sample.log_prob.dtype == log_prob.dtype == torch.float32
    assert ((log_prob - sample.log_prob).sum(dim=1).exp() - 1).abs().max() < 1e-3
    assert torch.allclose(value, sample.value, atol=1e-5)
    assert torch.allclose(value, policy.value(observation), atol=1e-5)
    states = policy.model.states(policy._observed(observation), sample.raw_action[:, :-1])
    logits = policy.model.logits(states)[..., 320:576] / temperature
    expected = logits.log_softmax(dim=2)
    columns = (sample.raw_action - 320)[..., None]
    assert torch.allclose(log_prob, expected.gather(2, columns)[..., 0], atol=1e-4)
    assert torch.allclose(entropy, -(expected.exp() * expected).sum(dim=(1, 2)), atol=1e-3)


@torch.no_grad()
def test_samples_are_as_frequent_as_their_log_probs_say() -> None:
    """Of the 256 action tokens, none hidden by a top-k; a temperature flattens them."""
    policy = small_policy(temperature=2.0)
    observation = {name: value * 3000 for name, value in row_of(observe(), 0).items() if name == "task"}
    observation[CAMERA] = observe()[CAMERA][:1].expand(3000, -1, -1, -1)
    sample = policy.sample(observation)
    first = sample.raw_action[:, 0]
    assert first.min() >= 320
    assert first.max() <= 575
    counts = torch.bincount(first - 320, minlength=256) / 3000
    probabilities = torch.zeros(256).index_put((first - 320,), sample.log_prob[:, 0].exp())
    assert (counts > 0).sum() > 60
    assert (counts - probabilities).abs().max() < 0.03


def test_it_acts_by_the_likeliest_tokens_or_by_drawn_ones() -> None:
    observation, greedy, drawing = observe(), small_policy(), small_policy(sampling=True)
    assert torch.equal(greedy.select_action(observation), greedy.select_action(observation))
    torch.manual_seed(3)
    actions = drawing.select_action(observation)
    torch.manual_seed(3)
    assert torch.equal(actions, drawing.sample(observation).raw_action)
    assert not torch.equal(actions, greedy.select_action(observation))


def test_an_id_that_is_no_action_is_no_label() -> None:
    policy, ids = small_policy(), random_ids(small_policy(), 4)
    ids[2, 1] = 576
    with pytest.raises(ValueError, match="token id 576 is no action"):
        policy.evaluate(observe(), ids)


def test_the_value_does_not_move_the_network() -> None:
    policy = small_policy()
    policy.value(observe()).sum().backward()
    moved = {name.split(".")[0] for name, p in policy.named_parameters() if p.grad is not None}
    assert moved == {"value_head"}
    owned = {id(parameter) for parameter in policy.value_parameters()}
    assert owned.isdisjoint(id(parameter) for parameter in policy.get_optim_params())
    assert len(owned) + len(policy.get_optim_params()) == len(list(policy.parameters()))


def test_a_fresh_value_is_zero() -> None:
    assert not OpenVLAPolicy(small_config()).value(observe()).any()


def test_the_loss_is_the_mean_of_the_rows() -> None:
    policy = small_policy()
    batch = {**observe(), "action": torch.rand(4, ACTIONS) * 3 - 1.5}
    loss, metrics = policy(batch)
    rows = policy(batch, reduction="none")[0]
    assert rows.shape == (4,)
    assert torch.allclose(loss, rows.mean())
    assert 0 <= metrics["action_accuracy"] <= 1
    alone = {**row_of(batch, 1), "action": batch["action"][1:2]}
    assert torch.allclose(policy(alone)[0], rows[1], atol=1e-4)


def test_it_learns_a_batch_by_heart() -> None:
    policy = small_policy()
    batch = {**observe(), "action": torch.tensor([[-1.0, 0.0, 0.4], [1.0, -0.3, 0.9]] * 2)}
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=3e-3)
    for _ in range(80):
        optimizer.zero_grad()
        policy.train()(batch)[0].backward()
        optimizer.step()
    ids = policy.eval().select_action(batch)
    assert torch.equal(ids, policy.action_tokens.encode(batch["action"]))


def test_a_checkpoint_is_the_same_policy(tmp_path: Path) -> None:
    policy = small_policy()
    policy.save_pretrained(tmp_path)
    loaded = OpenVLAPolicy.from_pretrained(tmp_path)
    assert loaded.state_dict().keys() == policy.state_dict().keys()
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in policy.state_dict().items())
    assert torch.equal(loaded.select_action(observe()), policy.select_action(observe()))
    assert torch.equal(loaded.value(observe()), policy.value(observe()))
    copied = copy.deepcopy(policy)
    assert torch.equal(copied.select_action(observe()), policy.select_action(observe()))


def test_bfloat16_keeps_log_probs_and_value_in_float32(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lerobot_policy_openvla.loading.multiplies_bfloat16", lambda device: True)
    small_policy().save_pretrained(tmp_path)
    config = small_config(dtype="bfloat16")
    policy = OpenVLAPolicy.from_pretrained(tmp_path, config=config)
    assert policy.model.projector.fc1.weight.dtype == torch.bfloat16
    assert policy.value_head[0].weight.dtype == torch.float32
    sample = policy.sample(observe())
    log_prob, _, value = policy.evaluate(observe(), sample.raw_action)
    assert sample.log_prob.dtype == value.dtype == torch.float32
    exact = small_policy().evaluate(observe(), sample.raw_action)[0]
    assert (log_prob - sample.log_prob).abs().max() < 0.15
    assert (log_prob - exact).abs().max() < 0.3


def test_bfloat16_leaves_positions_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounded frequencies turn position 280, where the release's actions are, by up to half a radian."""
    monkeypatch.setattr("lerobot_policy_openvla.loading.multiplies_bfloat16", lambda device: True)
    rounded, exact = (small_policy(dtype=dtype).model for dtype in ("bfloat16", "float32"))
    assert {parameter.dtype for parameter in rounded.parameters()} == {torch.bfloat16}
    embeddings = [model.language_model.model.rotary_emb for model in (rounded, exact)]
    state, position = torch.zeros(1, 1, 32), torch.tensor([[280]])
    for found, expected in zip(*(each(state, position) for each in embeddings), strict=True):
        assert torch.equal(found, expected)


def test_what_is_bfloat16_is_not_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    """By cloning or by PPO; a random start, which must be trained whole, is never so by itself."""
    monkeypatch.setattr("lerobot_policy_openvla.loading.multiplies_bfloat16", lambda device: True)
    policy = small_policy(dtype="bfloat16")
    for train in (policy.get_optim_params, lambda: PPO(policy, PPOConfig())):
        with pytest.raises(
            ValueError, match=r"policy\.dtype=bfloat16: such weights cannot.*=float32`, or .*LORA"
        ):
            train()
    policy.model.requires_grad_(False)
    assert policy.get_optim_params() == []
    assert compute_dtype("auto", "cuda") == torch.bfloat16
    assert compute_dtype("auto", "cuda", random_start=True) == torch.float32


def test_a_cpu_without_bfloat16_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lerobot_policy_openvla.loading.multiplies_bfloat16", lambda device: False)
    with pytest.raises(ValueError, match=r"dtype=bfloat16: this CPU has no instructions.*float32"):
        compute_dtype("bfloat16", "cpu")
    assert compute_dtype("auto", "cpu") == torch.float32


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dtype": "float16"}, "dtype=float16: choose one of auto"),
        ({"temperature": 0.0}, r"temperature=0\.0"),
        ({"n_obs_steps": 2}, "n_obs_steps=2"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small_config(**settings)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (
            {"observation.images.wrist": torch.zeros(1, 3, 8, 8), "task": ["x"]},
            "third_view, the environment or",
        ),
        ({CAMERA: torch.zeros(1, 3, 8, 8)}, "needs one instruction per image, 1; there are none"),
        ({CAMERA: torch.zeros(1, 3, 8, 8), "task": ["x", "y"]}, "there are 2"),
        ({CAMERA: torch.zeros(1, 8, 8, 3), "task": ["x"]}, r"the policy needs \(B, 3, H, W\)"),
    ],
)
def test_observations_that_lack_something_are_refused(observation: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small_policy().select_action(observation)


def test_of_several_cameras_one_must_be_named() -> None:
    image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, 32, 32))
    depth = PolicyFeature(type=FeatureType.VISUAL, shape=(1, 32, 32))
    state = PolicyFeature(type=FeatureType.STATE, shape=(8,))
    inputs = {CAMERA: image, f"{CAMERA}_depth": depth, "observation.state": state}
    config = small_config(input_features=dict(inputs))
    assert OpenVLAPolicy(config).config.input_features == {CAMERA: image}
    inputs["observation.images.wrist"] = image
    with pytest.raises(ValueError, match=r"camera=None: .*third_view, observation\.images\.wrist"):
        OpenVLAPolicy(small_config(input_features=dict(inputs)))
    config = small_config(input_features=dict(inputs), camera="observation.images.wrist")
    assert list(OpenVLAPolicy(config).config.input_features or {}) == ["observation.images.wrist"]
    with pytest.raises(ValueError, match=r"camera=front: no such camera"):
        OpenVLAPolicy(small_config(input_features=dict(inputs), camera="front"))


def test_it_starts_from_nothing_on_a_dataset(small_dataset: LeRobotDataset) -> None:
    """As lerobot-train builds it; its tokenizer knows the dataset's instruction."""
    config = small_config(input_features={}, output_features={})
    meta = LeRobotDatasetMetadata(small_dataset.repo_id, root=small_dataset.root)
    policy = make_policy(config, ds_meta=meta)
    preprocess, postprocess = make_pre_post_processors(config, dataset_stats=meta.stats)
    row = small_dataset[3]
    batch = preprocess({CAMERA: row[CAMERA], "action": row["action"], "task": row["task"]})
    knows_nothing = OpenVLAPolicy(small_config()).prompts
    assert len(policy.prompts.encode(row["task"])) < len(knows_nothing.encode(row["task"])) - 10
    assert policy(batch)[0].item() > 0
    action = postprocess(policy.action_tokens.encode(batch["action"]))
    low, high = (torch.as_tensor(meta.stats["action"][name]) for name in ("q01", "q99"))
    clipped = row["action"].double().clamp(low, high)
    assert ((action[0] - clipped).abs() <= (high - low) / 2 / 255 + 1e-6).all()


def test_default_adapters_sit_where_something_is_learnt() -> None:
    from peft import LoraConfig, get_peft_model

    policy = small_policy()
    adapted = get_peft_model(policy, LoraConfig(r=2, **policy._get_default_peft_targets()))
    adapted.model(observe() | {"action": torch.zeros(4, ACTIONS)})[0].backward()
    trained = {name: p for name, p in adapted.named_parameters() if p.requires_grad}
    without = {name for name, p in trained.items() if p.grad is None and "value_head" not in name}
    assert not without
    adapted_layers = {name.split(".lora_A")[0] for name in trained if ".lora_A" in name}
    assert len(adapted_layers) == 4 * (2 + 1) + 3 + 7 * SMALL_SIZES.llama.depth

"""The network's layout is the release's; a cache, padding and checkpointing change no number."""

from typing import Any

import pytest
import torch
from accelerate import init_empty_weights

from lerobot_policy_openvla.network import OpenVLANetwork
from lerobot_policy_openvla.sizes import RELEASED as RELEASED_SIZES
from lerobot_policy_openvla.sizes import LlamaSizes, Sizes, ViTSizes, sizes_from_weights
from tests.lerobot_policy_openvla.reference import RELEASED
from tests.lerobot_policy_openvla.small import (
    ACTIONS,
    SMALL_SIZES,
    observe,
    random_ids,
    row_of,
    small_policy,
)


def released_shapes() -> dict[str, tuple[int, ...]]:
    """All 982 weights of openvla/openvla-7b."""
    return {
        name.replace("*", str(index)): tuple(shape)
        for name, (layers, shape) in RELEASED.items()
        for index in range(max(layers, 1))
    }


def test_the_release_has_these_weights() -> None:
    with init_empty_weights():
        network = OpenVLANetwork(RELEASED_SIZES)
    shapes = {name: tuple(weight.shape) for name, weight in network.state_dict().items()}
    assert shapes == released_shapes()
    assert len(shapes) == 982
    assert sum(parameter.numel() for parameter in network.parameters()) == 7_541_237_184


def test_sizes_are_read_from_names_and_shapes() -> None:
    assert sizes_from_weights(released_shapes(), {"pad_to_multiple_of": 64}, {}) == RELEASED_SIZES
    small = {name: tuple(weight.shape) for name, weight in OpenVLANetwork(SMALL_SIZES).state_dict().items()}
    heads = {"vision_backbone.featurizer.": 1, "vision_backbone.fused_featurizer.": 2}
    config = {"text_config": {"num_attention_heads": 4}}
    assert sizes_from_weights(small, config, heads) == SMALL_SIZES


def test_a_weight_without_which_nothing_is_known_is_named() -> None:
    shapes = {name: shape for name, shape in released_shapes().items() if "embed_tokens" not in name}
    with pytest.raises(ValueError, match=r"language_model\.model\.embed_tokens\.weight is missing"):
        sizes_from_weights(shapes, {}, {})


@pytest.mark.parametrize(
    ("sizes", "settings", "message"),
    [
        (ViTSizes, {"depth": 1}, "depth=1"),
        (ViTSizes, {"width": 30, "heads": 4}, "width=30"),
        (Sizes, {"image_size": 60, "patch_size": 8}, "image_size=60"),
        (LlamaSizes, {"width": 36, "heads": 4}, r"sizes\.llama\.width=36: .* twice heads=4"),
        (LlamaSizes, {"width": 48, "heads": 6, "kv_heads": 4}, r"sizes\.llama\.heads=6: .* kv_heads=4"),
    ],
)
def test_impossible_sizes_are_named(sizes: Any, settings: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sizes(**settings)


@torch.no_grad()
def test_cached_decoding_is_the_uncached_one() -> None:
    """Also where rows are padded: every next state is that of the whole sequence encoded anew."""
    policy = small_policy()
    prefix = policy._observed(observe())
    assert prefix.mask is not None
    seen = []

    def choose(logits: torch.Tensor) -> torch.Tensor:
        seen.append(logits)
        return logits.argmax(dim=1)

    ids, first = policy.model.decode(prefix, ACTIONS, choose)
    states = policy.model.states(prefix, ids[:, :-1])
    assert torch.allclose(torch.stack(seen, dim=1), policy.model.logits(states), atol=1e-4)
    assert torch.allclose(first, states[:, 0], atol=1e-5)
    assert torch.allclose(first, policy.model.last_state(prefix), atol=1e-5)


@torch.no_grad()
def test_a_batch_of_mixed_prompts_is_every_row_alone() -> None:
    policy, observation = small_policy(), observe()
    ids = random_ids(policy, 4)
    together = policy.model.states(policy._observed(observation), ids)
    greedy = policy.select_action(observation)
    for row in range(4):
        alone = row_of(observation, row)
        prefix = policy._observed(alone)
        assert prefix.mask is None
        assert torch.allclose(policy.model.states(prefix, ids[row : row + 1])[0], together[row], atol=1e-5)
        assert torch.equal(policy.select_action(alone)[0], greedy[row])


@torch.no_grad()
def test_every_part_of_the_input_is_looked_at() -> None:
    policy, observation = small_policy(), row_of(observe(), 0)
    state = policy.model.last_state(policy._observed(observation))
    for name, other in (("task", ["pull"]), ("observation.images.third_view", torch.zeros(1, 3, 32, 32))):
        changed = policy.model.last_state(policy._observed({**observation, name: other}))
        assert (changed - state).abs().max() > 1e-3


def test_no_token_sees_what_follows_it() -> None:
    policy = small_policy()
    ids = random_ids(policy, 4)
    prefix = policy._observed(observe())
    states = policy.model.states(prefix, ids)
    ids[:, 1] = policy.action_tokens.first_id
    changed = policy.model.states(prefix, ids)
    assert torch.equal(states[:, :2], changed[:, :2])
    assert (states[:, 2] - changed[:, 2]).abs().max() > 1e-3


def test_checkpointing_changes_no_gradient_and_leaves_the_cache_alone() -> None:
    """In evaluation mode, as PPO differentiates."""
    gradients, greedy = [], []
    for checkpointing in (False, True):
        policy = small_policy(gradient_checkpointing=checkpointing)
        ids = random_ids(policy, 4)
        policy.evaluate(observe(), ids.sort(dim=1).values)[0].sum().backward()
        gradients.append({name: p.grad for name, p in policy.model.named_parameters() if p.grad is not None})
        greedy.append(policy.select_action(observe()))
        assert not any(module.training for module in policy.modules())
    assert gradients[0].keys() == gradients[1].keys()
    assert all(torch.allclose(gradients[1][name], value, atol=1e-4) for name, value in gradients[0].items())
    assert torch.equal(*greedy)


def test_checkpointing_keeps_fewer_activations() -> None:
    kept = []
    for checkpointing in (False, True):
        policy, count = small_policy(gradient_checkpointing=checkpointing), [0]

        def pack(tensor: torch.Tensor, count: list[int] = count) -> torch.Tensor:
            count[0] += tensor.numel()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            policy.evaluate(observe(), random_ids(policy, 4))
        kept.append(count[0])
    assert kept[1] < 0.6 * kept[0]

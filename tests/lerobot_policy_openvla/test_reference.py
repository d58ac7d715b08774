"""The numbers of OpenVLA's original code come out: pixels, features, logits, tokens, actions, losses."""

import hashlib

import numpy as np
import pytest
import torch
from torch import Tensor

from lerobot_policy_openvla.images import to_pixel_values
from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
from lerobot_policy_openvla.network import Prefix
from lerobot_policy_openvla.processor_openvla import make_openvla_pre_post_processors
from lerobot_policy_openvla.prompts import padded
from tests.lerobot_policy_openvla.reference import WHOLE, Reference, whole_reference

FEATURES, LOGITS, ACTIONS = 5e-5, 2e-4, 1e-6
"""Largest differences between float32 on two versions of everything."""

KEYS = ("bridge_orig", "fractal20220817_data", "legacy_no_mask", "toy_8d")
INSTRUCTIONS = (
    "pick up the red block",
    "put the carrot on the yellow plate next to the spoon",
    "close the drawer",
)


def pixels(reference: Reference, sample: int) -> Tensor:
    return to_pixel_values(reference.image(sample), 224)


def stacked(reference: Reference, name: str) -> Tensor:
    return torch.stack([reference(f"s{sample}_{name}") for sample in reference.samples])


def all_pixels(reference: Reference) -> Tensor:
    return torch.cat([pixels(reference, sample) for sample in reference.samples])


def prefix(policy: OpenVLAPolicy, reference: Reference, name: str = "input_ids") -> Prefix:
    """The samples' pixels, and their ids with the lone space that the original adds where it is missing."""
    rows, space = (
        [reference(f"s{sample}_{name}").tolist() for sample in reference.samples],
        policy.prompts.space_id,
    )
    ids, mask = padded([row if row[-1] == space else [*row, space] for row in rows])
    return policy._encoded(all_pixels(reference), ids, mask)


def test_pixels_are_equal_bit_by_bit(reference: Reference) -> None:
    for sample in reference.samples:
        digest = hashlib.sha256(pixels(reference, sample).numpy().tobytes()).digest()
        assert digest == reference.pixel_digest(sample)


@torch.no_grad()
def test_features(reference: Reference, original: OpenVLAPolicy) -> None:
    features = original.model.vision_backbone(all_pixels(reference))
    projected = original.model.projector(features)
    for found, name in ((features, "patch_features"), (projected, "projected_features")):
        expected = stacked(reference, name)
        assert (found[:, reference.patches] - expected).abs().max() < FEATURES


@torch.no_grad()
def test_states_of_the_language_model(reference: Reference, original: OpenVLAPolicy) -> None:
    for sample in reference.samples:
        ids = reference(f"s{sample}_gen_input_ids")[None]
        prefix = original.model.prefix(pixels(reference, sample), ids)
        states = original.model._run(prefix)[0, -20:]
        assert (states - reference(f"s{sample}_llm_hidden_last20")).abs().max() < LOGITS


@torch.no_grad()
@pytest.mark.parametrize("name", ["input_ids", "gen_input_ids"])
def test_logits_and_log_probs_of_a_padded_batch(
    reference: Reference, original: OpenVLAPolicy, name: str
) -> None:
    """Whether or not the prompts end with the lone space that the original adds."""
    actions = stacked(reference, "tf_action_token_ids")
    states = original.model.states(prefix(original, reference, name), actions[:, :-1])
    logits = original._action_logits(states)
    assert logits.shape == (len(reference.samples), 7, 256)
    assert (logits - stacked(reference, "tf_logits_action")).abs().max() < LOGITS
    columns = original.action_tokens.columns(actions)[..., None]
    log_probs = logits.log_softmax(dim=2).gather(2, columns)[..., 0]
    assert (log_probs - stacked(reference, "tf_logprobs_action256")).abs().max() < LOGITS


@pytest.mark.parametrize("num_ids", [7, 8])
def test_greedy_ids_of_a_padded_batch(reference: Reference, original: OpenVLAPolicy, num_ids: int) -> None:
    ids = original._greedy(prefix(original, reference), num_ids)
    assert stacked(reference, "gen_margin").min() > LOGITS
    assert torch.equal(ids, stacked(reference, "gen8_token_ids")[:, :num_ids])


@pytest.mark.parametrize("key", KEYS)
def test_actions_of_every_dataset(reference: Reference, key: str) -> None:
    policy = OpenVLAPolicy.from_openvla(reference.folder, unnorm_key=key)
    _, postprocess = make_openvla_pre_post_processors(policy.config)
    ids = stacked(reference, "gen8_token_ids")[:, : policy.config.action_size]
    expected = np.stack([reference.arrays[f"s{sample}_action__{key}"] for sample in reference.samples])
    assert np.abs(postprocess(ids).double().numpy() - expected).max() < ACTIONS


def test_training_ids(reference: Reference, original: OpenVLAPolicy) -> None:
    for sample in reference.samples:
        expected = reference(f"s{sample}_train_input_ids")
        actions = original.action_tokens.encode(reference(f"s{sample}_train_action"))
        assert torch.equal(actions, expected[-8:-1])
        assert expected[-9] == original.prompts.space_id


def test_the_tables_of_the_action_tokens(reference: Reference, original: OpenVLAPolicy) -> None:
    tokens = original.action_tokens
    assert torch.equal(tokens.encode(reference("encode_values")), reference("encode_token_ids"))
    assert (tokens.decode(reference("table_token_ids")) - reference("table_decoded")).abs().max() < ACTIONS


@pytest.fixture(scope="module")
def whole() -> Reference:
    if not WHOLE.is_dir():
        pytest.skip("needs all rows of the embeddings: the whole reference checkpoint beside the repository")
    return whole_reference()


def test_the_loss_of_a_padded_batch_and_its_gradients(whole: Reference) -> None:
    policy = OpenVLAPolicy.from_openvla(whole.folder)
    actions = policy.action_tokens.encode(stacked(whole, "train_action"))
    losses, _ = policy._token_losses(prefix(policy, whole), actions)
    labelled = whole("batch_labels")[:, 1:] != -100
    assert (losses.flatten() - whole("batch_nll")[labelled]).abs().max() < LOGITS
    assert losses.mean().item() == pytest.approx(whole.arrays["batch_loss"].item(), abs=LOGITS)
    losses.mean().backward()
    parts = (
        "vision_backbone.featurizer.",
        "vision_backbone.fused_featurizer.",
        "projector.",
        "language_model.",
    )
    for part, expected in zip(parts, whole.arrays["batch_gradnorm"], strict=True):
        named = [p for name, p in policy.model.named_parameters() if name.startswith(part)]
        norm = torch.stack([p.grad.norm() for p in named if p.grad is not None]).norm()
        assert norm.item() == pytest.approx(expected, rel=1e-4)


def test_instructions_become_the_same_ids(whole: Reference) -> None:
    policy = OpenVLAPolicy.from_openvla(whole.folder)
    for sample, instruction in enumerate(INSTRUCTIONS):
        ids = whole.arrays[f"s{sample}_gen_input_ids"].tolist()
        assert policy.prompts.encode(instruction) == ids
        assert policy.prompts.encode(instruction.title()) == ids


def test_a_lerobot_observation_leads_to_the_same_action(whole: Reference) -> None:
    policy = OpenVLAPolicy.from_openvla(whole.folder, unnorm_key="bridge_orig")
    preprocess, postprocess = make_openvla_pre_post_processors(policy.config)
    for sample, instruction in enumerate(INSTRUCTIONS):
        images = {"observation.images.front": whole.image(sample).float() / 255}
        action = postprocess(policy.select_action(preprocess({**images, "task": [instruction]})))[0]
        expected = whole.arrays[f"s{sample}_action__bridge_orig"]
        assert np.abs(action.double().numpy() - expected).max() < ACTIONS

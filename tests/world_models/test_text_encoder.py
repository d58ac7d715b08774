import pytest
import torch

from lerobot_wmrl.world_models.text import (
    MAX_TOKENS,
    ByteTextEncoder,
    FrozenT5,
    FrozenTextEncoder,
    TextEncoder,
    check_one_each,
)
from tests.world_models.pretrained_t5 import FAMILY, save_t5

WIDTH = 48
SHORT, LONG = "push the red square", "pull the green square back"


@pytest.fixture(scope="module", params=["embedded", *FAMILY])
def encoder(request, tmp_path_factory) -> TextEncoder:
    torch.manual_seed(0)
    if request.param == "embedded":
        return ByteTextEncoder(WIDTH)
    folder = save_t5(tmp_path_factory.mktemp("t5"), request.param)
    return FrozenTextEncoder(WIDTH, FrozenT5.load(str(folder)))


def test_shapes_and_scale_are_those_cross_attention_expects(encoder):
    condition, mask, _ = encoder([SHORT, LONG])
    length = len(encoder.tokenizer(LONG).input_ids)
    assert condition.shape == (2, 1, length, WIDTH)
    assert mask.shape == (2, 1, 1, 1, length)
    assert mask.sum((1, 2, 3, 4)).tolist() == [
        len(encoder.tokenizer(text).input_ids) for text in (SHORT, LONG)
    ]
    assert 0.3 < condition[mask[:, :, 0, 0]].std() < 1.5


@torch.no_grad()
def test_an_instruction_means_the_same_whatever_is_beside_it(encoder):
    alone, *_ = encoder([SHORT])
    beside, mask, _ = encoder([LONG, SHORT, LONG])
    kept = mask[1, 0, 0, 0]
    torch.testing.assert_close(beside[1, :, kept], alone[0], atol=1e-5, rtol=1e-4)
    assert torch.equal(beside[0], beside[2])
    assert (beside[0, :, : int(kept.sum())] - beside[1, :, kept]).abs().max() > 0.1


def test_equal_instructions_share_one_encoding_and_its_gradient(encoder):
    weight = encoder.project.weight
    repeated = torch.autograd.grad(encoder([SHORT, SHORT, SHORT])[0].square().sum(), weight)[0]
    once = torch.autograd.grad(encoder([SHORT])[0].square().sum(), weight)[0]
    torch.testing.assert_close(repeated, 3 * once)


def test_non_ascii_text_is_told_apart_byte_by_byte():
    encoder = ByteTextEncoder(WIDTH)
    german, chinese, emoji = (encoder([text])[0] for text in ("schiebe den Würfel", "推动红色方块", "🟥➡️"))
    assert german.shape[2] == len("schiebe den Würfel".encode()) + 1
    assert chinese.shape[2] == 3 * 6 + 1
    assert not torch.allclose(chinese[:, :, 0], emoji[:, :, 0])


@pytest.mark.parametrize("empty", ["", "  \n"])
def test_an_empty_instruction_is_named(encoder, empty):
    with pytest.raises(ValueError, match=r"task='': an instruction is empty.*give every episode a task"):
        encoder([SHORT, empty])


def test_an_endless_instruction_is_refused_with_the_limit(encoder):
    with pytest.raises(ValueError, match=r"task='push .*of 10000 characters .* at most 512: shorten it"):
        encoder([SHORT, "push " * 2000])


def test_the_longest_instruction_that_may_be_is_taken():
    encoder = ByteTextEncoder(WIDTH)
    assert encoder(["x" * (MAX_TOKENS - 1)])[0].shape[2] == MAX_TOKENS
    with pytest.raises(ValueError, match="has 513 tokens"):
        encoder(["x" * MAX_TOKENS])


def test_a_pretrained_tokenizers_own_maximum_counts(tmp_path):
    t5 = FrozenT5.load(str(save_t5(tmp_path)))
    t5.tokenizer.model_max_length = 3
    with pytest.raises(ValueError, match="at most 3: shorten it"):
        t5.embed(SHORT, torch.device("cpu"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["push", "pull"], "2 instructions for 3 episodes"),
        ("push", "a single string for 3 episodes"),
    ],
)
def test_an_instruction_is_needed_for_each_episode(given, message):
    with pytest.raises(ValueError, match=f"task: {message}; give a list with one instruction for each"):
        check_one_each(given, 3)


def test_a_frozen_t5_gives_what_transformers_gives_and_computes_it_once(tmp_path):
    t5 = FrozenT5.load(str(save_t5(tmp_path)))
    first, again = (t5.embed(SHORT, torch.device("cpu")) for _ in range(2))
    assert again is first
    assert not t5.model.training
    batch = t5.tokenizer([SHORT, LONG], padding=True, return_tensors="pt")
    with torch.no_grad():
        expected = t5.model(**batch).last_hidden_state[0, : len(first)]
    torch.testing.assert_close(first, expected)


def test_a_frozen_t5_is_no_part_of_the_models_parameters(tmp_path):
    encoder = FrozenTextEncoder(WIDTH, FrozenT5.load(str(save_t5(tmp_path)))).train()
    assert {name for name, _ in encoder.named_parameters()} == {
        "norm.weight",
        "norm.bias",
        "project.weight",
        "project.bias",
    }
    assert encoder.state_dict().keys() == dict(encoder.named_parameters()).keys()
    assert not encoder.t5.model.training
    encoder([SHORT])[0].sum().backward()
    assert all(parameter.grad is None for parameter in encoder.t5.model.parameters())

"""Instructions become the ids that OpenVLA's training had, with the padding where it does no harm."""

import pytest

from lerobot_policy_openvla.prompts import PromptTokenizer, train_tokenizer

TASKS = ["push the can forward", "pull the sponge back"]
SPACE = 9


@pytest.fixture(scope="module")
def prompts() -> PromptTokenizer:
    return PromptTokenizer(train_tokenizer(TASKS, 1024).to_str())


def test_a_tokenizer_made_from_instructions_has_llamas_layout(prompts: PromptTokenizer) -> None:
    tokenizer = prompts.tokenizer
    assert [tokenizer.id_to_token(index) for index in (0, 1, 2, 3, 258)] == [
        "<unk>",
        "<s>",
        "</s>",
        "<0x00>",
        "<0xFF>",
    ]
    assert tokenizer.token_to_id("<PAD>") == 1024
    actions = [tokenizer.id_to_token(index) for index in range(768, 1024)]
    assert all(len(token) == 1 for token in actions)
    assert len(set(actions)) == 256
    text = f"In: What?\nOut: {actions[0]}{actions[255]}"
    assert tokenizer.encode(text).ids[-3:] == [prompts.space_id, 768, 1023]


def test_any_text_comes_back(prompts: PromptTokenizer) -> None:
    for text in ("push the can forward", "Öffne die Tür 扉", "a\tb"):
        ids = prompts.encode(text)
        assert ids[0] == 1
        assert ids[-1] == prompts.space_id
        assert 0 not in ids
        assert text.lower() in prompts.tokenizer.decode(ids)


def test_known_instructions_take_few_tokens(prompts: PromptTokenizer) -> None:
    assert len(prompts.encode(TASKS[0])) < 20 < len(prompts.encode("juggle three oranges quickly"))


def test_too_small_a_vocabulary_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"vocab_size=500 \+ extra_ids: .* at least 516 ids; raise `sizes\.llama\.vocab"
    ):
        train_tokenizer(TASKS, 500)


def test_batches_are_padded_behind_the_first_token(prompts: PromptTokenizer) -> None:
    ids, mask = prompts.batch(["push the can forward", "push"])
    assert mask is not None
    assert mask[0].all()
    assert mask[:, 0].all()
    assert ids[1][mask[1]].tolist() == prompts.encode("push")
    assert prompts.batch(["push", "push"])[1] is None

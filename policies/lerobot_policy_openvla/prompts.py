"""What the policy takes from an observation: the images of one camera, and instructions as token ids.

B batch, L tokens.
"""

import json
from collections.abc import Sequence
from typing import Any, Final

import torch
from lerobot.utils.constants import OBS_IMAGE
from tokenizers import (
    AddedToken,
    Tokenizer,
    decoders,
    models,
    normalizers,
    pre_tokenizers,
    processors,
    trainers,
)
from torch import Tensor

from lerobot_policy_openvla.actions import BINS
from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_wmrl.common.constants import INSTRUCTIONS
from lerobot_wmrl.common.errors import FieldError

PROMPT: Final = "In: What action should the robot take to {instruction}?\nOut:"
SPACE: Final = "▁"
UNKNOWN, BEGIN, END, PAD = "<unk>", "<s>", "</s>", "<PAD>"
BEGIN_ID, END_ID = 1, 2
BYTES: Final = tuple(f"<0x{value:02X}>" for value in range(256))
ACTION_CHARACTERS: Final = range(0x4E00, 0x4E00 + BINS)
"""Rare characters, as Llama's last 256 tokens are: 256 of the CJK ideographs."""


class PromptTokenizer:
    """Turns instructions into prompts as OpenVLA was trained on them.

    They are in lower case and end with a lone space, which training had between the colon and the first
    action token.

    Args:
        definition: content of a `tokenizer.json`.
    """

    def __init__(self, definition: str) -> None:
        self.tokenizer = Tokenizer.from_str(definition)
        space_id = self.tokenizer.token_to_id(SPACE)
        if space_id is None:
            raise ValueError(f"tokenizer.json: has no token {SPACE!r}: this is no tokenizer of a Llama")
        self.space_id: int = space_id
        self.known: dict[str, list[int]] = {}

    def encode(self, instruction: str) -> list[int]:
        """Return the ids of one prompt, from <s> to the lone space."""
        if instruction not in self.known:
            prompt = PROMPT.format(instruction=instruction.lower())
            self.known[instruction] = [*self.tokenizer.encode(prompt).ids, self.space_id]
        return self.known[instruction]

    def batch(self, instructions: Sequence[str]) -> tuple[Tensor, Tensor | None]:
        """Return the prompts' ids (B, L), and the mask (B, L) or None if nothing is padded."""
        return padded([self.encode(instruction) for instruction in instructions])


def padded(rows: Sequence[Sequence[int]]) -> tuple[Tensor, Tensor | None]:
    """Pad prompts behind their first token, <s>.

    Returns:
        Ids (B, L), and the mask (B, L) or None if nothing is padded.
    """
    longest = max(map(len, rows))
    if all(len(row) == longest for row in rows):
        return torch.tensor(rows), None
    padding = [longest - len(row) for row in rows]
    ids = [[BEGIN_ID] * (count + 1) + [*row[1:]] for row, count in zip(rows, padding, strict=True)]
    mask = [[1] + [0] * count + [1] * (len(row) - 1) for row, count in zip(rows, padding, strict=True)]
    return torch.tensor(ids), torch.tensor(mask, dtype=torch.bool)


def train_tokenizer(instructions: Sequence[str], vocabulary: int) -> Tokenizer:
    """Train a small tokenizer in the layout of Llama's, for a model that starts from random weights.

    It is byte-pair encoding (Sennrich et al. 2016) that falls back on bytes, learnt from prompts. Its ids are
    <unk>, <s>, </s>, the bytes, what was learnt, and last the 256 action tokens.

    Args:
        instructions: instructions to learn from.
        vocabulary: number of ids.

    Raises:
        FieldError: if the vocabulary is too small.
    """
    learnable = vocabulary - BINS
    fixed = [UNKNOWN, BEGIN, END, *BYTES, SPACE]
    if learnable < len(fixed):
        raise FieldError(
            "sizes.llama.vocab_size",
            f"{vocabulary} + extra_ids",
            f"the tokenizer needs at least {len(fixed) + BINS} ids",
            "raise `sizes.llama.vocab_size`",
        )
    learnt = Tokenizer(models.BPE(unk_token=UNKNOWN))
    learnt.normalizer = _normalizer()
    learnt.pre_tokenizer = pre_tokenizers.Split(SPACE, behavior="merged_with_next")
    trainer = trainers.BpeTrainer(vocab_size=learnable, special_tokens=fixed, show_progress=False)
    learnt.train_from_iterator([PROMPT.format(instruction=text.lower()) for text in instructions], trainer)
    return _whole_tokenizer(learnt, learnable, fixed)


def _whole_tokenizer(learnt: Tokenizer, learnable: int, fixed: Sequence[str]) -> Tokenizer:
    """Complete a tokenizer: what was learnt, unused ids, the action tokens last, and <PAD> after them."""
    model = json.loads(learnt.to_str())["model"]
    vocab: dict[str, int] = model["vocab"]
    vocab |= {f"<unused{index}>": index for index in range(len(vocab), learnable)}
    vocab |= {chr(code): learnable + index for index, code in enumerate(ACTION_CHARACTERS)}
    merges = [tuple(merge) for merge in model["merges"]]
    tokenizer = Tokenizer(models.BPE(vocab, merges, unk_token=UNKNOWN, byte_fallback=True, fuse_unk=True))
    tokenizer.normalizer = _normalizer()
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{BEGIN} $A", special_tokens=[(BEGIN, vocab[BEGIN])]
    )
    steps = [
        decoders.Replace(SPACE, " "),
        decoders.ByteFallback(),
        decoders.Fuse(),
        decoders.Strip(" ", 1, 0),
    ]
    tokenizer.decoder = decoders.Sequence(steps)
    tokenizer.add_special_tokens([AddedToken(name, normalized=False) for name in (*fixed[:3], PAD)])
    return tokenizer


def _normalizer() -> normalizers.Normalizer:
    """Return Llama's normaliser: a space before the text, and a visible character for every space."""
    return normalizers.Sequence([normalizers.Prepend(SPACE), normalizers.Replace(" ", SPACE)])


def select_inputs(config: OpenVLAConfig, observation: dict[str, Any]) -> tuple[Tensor, list[str]]:
    """Return images (B, 3, H, W) and instructions. Raises ValueError if the observation lacks them."""
    camera = camera_name(config, observation)
    images = observation[camera]
    instructions = observation.get(INSTRUCTIONS)
    if isinstance(instructions, str):
        instructions = [instructions] * len(images)
    if instructions is None or len(instructions) != len(images):
        count = "none" if instructions is None else len(instructions)
        raise ValueError(
            f"observation.task: needs one instruction per image, {len(images)}; there are {count}"
        )
    return images, list(instructions)


def camera_name(config: OpenVLAConfig, observation: dict[str, Any]) -> str:
    """Return the camera the policy was trained on; else the one that is named, or the only one."""
    shown = sorted(name for name in observation if name.startswith(OBS_IMAGE))
    wanted = list(config.input_features or ()) or ([config.camera] if config.camera else shown)
    if len(wanted) != 1 or wanted[0] not in shown:
        raise FieldError(
            "camera",
            config.camera,
            f"the policy needs {', '.join(wanted) or 'a camera'}, the environment or dataset shows "
            f"{', '.join(shown) or 'none'}",
            "use one with the camera that the policy was trained on, or name one of them as `camera`",
        )
    return wanted[0]

"""Settings as flags: draccus and shells read what was meant."""

import shlex
from dataclasses import dataclass, field
from pathlib import Path

import draccus
import pytest

from lerobot_wmrl.common.flags import flag_as_typed, format_flags, format_lerobot_flags


@dataclass
class Texts:
    text: str = "default"
    texts: list[str] = field(default_factory=list)
    numbers: list[int] | None = None


@pytest.mark.parametrize(
    "text",
    [
        "outputs/push, a/policy",
        "it's",
        'a "b"',
        "'a'",
        '"a"',
        "a [b]",
        "]",
        "{a: b}",
        "a: b",
        "a:",
        "b=c",
        " a ",
        "",
        "#a",
        "a #b",
        "- a",
        "*a",
        "!include a",
        "=",
        "null",
        "true",
        "12",
        "1e-4",
        "2026-01-01",
        "ä😀, b",
        "a\nb",
        "\\",
        "2024_01_15",
        "1.10",
        "0123",
    ],
)
def test_texts_and_lists_are_parsed_as_they_were_written(text: str) -> None:
    texts = [text, "outputs/b", text]
    flags = format_flags({"texts": texts, "numbers": [3, -1]})
    lerobot = format_lerobot_flags({"text": text})
    assert draccus.parse(Texts, args=[*lerobot, *flags]) == Texts(text, texts, [3, -1])
    assert "outputs/b" in flags[0].split(",")
    assert flags[1] == "--numbers=[3,-1]"


def test_lerobot_gets_checkpoints_and_plain_texts_without_quotation_marks() -> None:
    flags = {"policy.path": "1.10", "config_path": "12", "dataset.root": "1.10", "task": "push it", "n": 3}
    assert format_lerobot_flags(flags) == [
        "--policy.path=1.10",
        "--config_path=12",
        '--dataset.root="1.10"',
        "--task=push it",
        "--n=3",
    ]


def test_a_flag_is_one_word_of_a_shell() -> None:
    for root in ("data/push", "my data/it's $HOME"):
        assert shlex.split(f"command {flag_as_typed('dataset.root', Path(root))}")[1:] == [
            f"--dataset.root={root}"
        ]

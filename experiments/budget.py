"""Keep a study within its budget of real episodes: every command obeys, `lerobot-train` too.

Commands of this project are given the ledger by `--budget`. Other commands have no such flag, so the runner
itself looks for the datasets that a command names, and asks the ledger whether it knows their episodes.
"""

import re
import shlex
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Final, NamedTuple

import yaml

from experiments.study import Step, Study
from lerobot_wmrl.common.errors import FieldError, renamed
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.ledger import Ledger, Limits

COMMANDS: Final = ("lerobot-wmrl-record", "lerobot-wmrl-train", "lerobot-wmrl-train-world-model")
"""Commands that are given the ledger."""

MODULES: Final = (
    "lerobot_dataset_maniskill.record",
    "lerobot_wmrl.scripts.train",
    "lerobot_wmrl.scripts.train_world_model",
)
"""The same, as `torchrun -m` starts them."""

ROOTS: Final = ("dataset.root", "env.dataset.root", "gate.dataset.root")
"""Flags with the folder of one dataset."""

LISTS: Final = ("dataset.more",)
"""Flags with the folders of several."""

DIVIDING: Final = ";|&<>()"
"""Characters between the commands of a line of bash."""

SUBSTITUTION: Final = r"\$\((?:[^()]|\((?:[^()]|\([^()]*\))*\))*\)"
"""`$(…)` and `$((…))`, with brackets in them up to two deep."""

INSERTED: Final = "$inserted"
"""What stands for something that the shell inserts."""


class StudyError(RuntimeError):
    """A study cannot go on; the message says why and what to do."""


class Source(NamedTuple):
    """A dataset that a command reads: the flag that names it, its folder, the episodes (None: all)."""

    flag: str
    root: str
    episodes: tuple[int, ...] | None

    @property
    def recorded(self) -> bool:
        """Whether the dataset is there."""
        return (Path(self.root) / "meta" / "info.json").is_file()


def begin(study: Study) -> None:
    """Create the ledger of a study with a budget, or open it again.

    Raises:
        StudyError: a command is not given the ledger, names a dataset that only the shell knows, or the
            ledger has other limits.
    """
    if study.limits is None:
        return
    check_commands(study)
    try:
        Ledger.create(study.budget, Limits(**study.limits))
    except TypeError:
        names = ", ".join(study.limits)
        raise StudyError(f"budget: {names}: there are demonstrations, rollouts and play") from None
    except FieldError as error:
        raise StudyError(str(error)) from error


def check_commands(study: Study) -> None:
    """Raise StudyError unless every command that records or trains has the ledger, and says what it reads."""
    for step in study.steps:
        for words in simple_commands(step.command):
            if spaced := [word for word in words if word.removeprefix("--") in (*ROOTS, *LISTS)]:
                raise StudyError(
                    f"{step.name}: {spaced[0]} needs an equals sign before its value in a study with a budget"
                )
            programs = [word for word in words if Path(word).name in COMMANDS or word in MODULES]
            if programs and f"--budget={study.budget}" not in words:
                raise StudyError(
                    f"{step.name}: {programs[0]} needs --budget=$budget in a study with a budget"
                )
        for source in sources(step):
            if "$" in source.root:
                raise StudyError(
                    f"{step.name}: --{source.flag}={source.root}: only the shell knows this dataset, so its "
                    "episodes cannot be looked up in the budget; write the folder out"
                )


def check_datasets(study: Study, step: Step, checked: frozenset[Source] = frozenset()) -> frozenset[Source]:
    """Look the episodes of the datasets that a step reads up in the ledger, where these are recorded.

    Args:
        study: has a budget, or nothing is looked up.
        step: its command.
        checked: datasets that need not be looked up again.

    Returns:
        The datasets that were looked up, beside those in `checked`.

    Raises:
        StudyError: an episode is not there.
    """
    if study.limits is None:
        return checked
    found = {each for each in sources(step) if each.recorded} - checked
    for source in sorted(found, key=lambda each: each[:2]):
        try:
            with renamed("dataset.root", source.flag):
                table = read_episodes(open_dataset(source.root))
                chosen = None if source.episodes is None else table.among(source.episodes).nonzero()[0]
                Ledger(study.budget).require_known(table, chosen)
        except FieldError as error:
            raise StudyError(f"{step.name}: --{error}") from error
    return checked | found


def sources(step: Step) -> Iterator[Source]:
    """Yield the datasets that the commands of a step name."""
    for words in simple_commands(step.command):
        flags = dict(word[2:].split("=", 1) for word in words if re.match(r"--[\w.]+=", word))
        for flag in ROOTS:
            if flags.get(flag):
                literal = re.fullmatch(r"\[[\d, ]*\]", flags.get("dataset.episodes", ""))
                own = literal is not None and flag == "dataset.root"
                chosen = tuple(yaml.safe_load(flags["dataset.episodes"])) if own else None
                yield Source(flag, flags[flag], chosen)
        for flag in LISTS:
            for root in listed(flags.get(flag, "[]")):
                yield Source(flag, root, None)


def listed(value: str) -> list[str]:
    """Return the folders of a flag with a list, `[a,b]`; what the shell inserts counts as one."""
    return [value] if "$" in value else [str(each) for each in yaml.safe_load(value) or ()]


def simple_commands(command: str) -> Iterator[list[str]]:
    """Yield the words of each command in a line of bash, which `&&`, `;`, `|` and brackets divide."""
    plain = re.sub(SUBSTITUTION, lambda _: INSERTED, command)
    lexer = shlex.shlex(plain, posix=True, punctuation_chars=DIVIDING)
    lexer.whitespace_split, lexer.commenters = True, ""
    for divides, words in groupby(lexer, key=lambda word: set(word) <= set(DIVIDING)):
        if not divides:
            yield list(words)

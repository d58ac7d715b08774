"""What every console command shares: presets, parsing, claimed output folders, errors without tracebacks."""

import json
import logging
import re
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from types import NoneType
from typing import Any, ClassVar, get_args, get_type_hints

import draccus
from draccus.utils import ParsingError
from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import flatten_dict, init_logging

from lerobot_wmrl.common.files import foreign_files, write_json
from lerobot_wmrl.common.suggestion import nearest

CONFIG_FILE = "train_config.json"


@dataclass
class RunConfig:
    """Base of the commands' configurations: parsed by draccus, saved beside what the run makes."""

    path_fields: ClassVar[list[str]] = []

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Fields that are loaded from a checkpoint given as `--<field>.path`."""
        return cls.path_fields

    def save_pretrained(self, folder: Path) -> None:
        """Write the configuration as LeRobot does, `train_config.json`."""
        write_json(folder / CONFIG_FILE, draccus.encode(self))


def claim_output_dir(output_dir: Path, config: dict[str, Any], free: Collection[str] = ()) -> None:
    """Mark a new folder as this run's, or recognise it. ValueError if it holds something else."""
    require_free(output_dir, config, free)
    if not (output_dir / CONFIG_FILE).is_file():
        write_json(output_dir / CONFIG_FILE, config)


def require_free(output_dir: Path, config: dict[str, Any], free: Collection[str] = ()) -> None:
    """ValueError unless the folder is new, empty or this run's; it is left as it is.

    Only `output_dir`, for a run may be moved, and the settings called `free` may differ between the first
    call and its continuation.
    """
    marker = output_dir / CONFIG_FILE
    if output_dir.exists() and not output_dir.is_dir():
        raise ValueError(f"--output_dir={output_dir} is a file; choose a new folder")
    if marker.is_file():
        differing = different_settings(json.loads(marker.read_text()), config, {"output_dir", *free})
        if differing:
            raise ValueError(
                f"--output_dir={output_dir} holds a run with other settings ({'; '.join(differing)}); "
                "choose another folder, or repeat the settings of the first run to continue it"
            )
    elif foreign_files(output_dir, CONFIG_FILE):
        raise ValueError(f"--output_dir={output_dir} holds something else; choose a new folder")


def different_settings(
    stored: Mapping[str, Any], given: Mapping[str, Any], free: Collection[str]
) -> list[str]:
    """`name 'stored' → 'given'` of every setting that differs and is not `free`, alone or with its group."""
    before, now = (flatten_dict(dict(settings), sep=".") for settings in (stored, given))
    return [
        f"{name} {before.get(name)!r} → {now.get(name)!r}"
        for name in {**before, **now}
        if before.get(name) != now.get(name)
        and not any(name == each or name.startswith(f"{each}.") for each in free)
    ]


def run_command[Config: RunConfig](
    function: Callable[[Config], None],
    config_class: type[Config],
    expand: Callable[[Sequence[str]], list[str]],
) -> None:
    """Parse the command line for `function`, run it, and turn bad input into one clear line, exit code 1.

    `expand` replaces the flags that stand for others.
    """
    register_third_party_plugins()
    init_logging()
    logging.getLogger("lerobot.configs").setLevel(logging.ERROR)
    try:
        sys.argv[1:] = expand(sys.argv[1:])
        function(parse_flags(config_class))
    except (ValueError, OSError, ParsingError) as error:
        reason = error.__cause__ if isinstance(error, ParsingError) and error.__cause__ else error
        print(f"error: {reason}", file=sys.stderr)
        sys.exit(1)


def parse_flags[Config: RunConfig](config_class: type[Config]) -> Config:
    """The command line as LeRobot parses it. ValueError if it cannot, in one line: without the page of usage
    that argparse prints, and with the reason that draccus keeps to itself."""

    @parser.wrap()
    def parsed(cfg: config_class) -> Config:  # type: ignore[valid-type]
        return cfg

    said = StringIO()
    try:
        with redirect_stderr(said):
            return parsed()
    except SystemExit as stopped:
        if stopped.code in (None, 0):  # --help
            raise
        raise ValueError(parsing_error(said.getvalue().strip(), config_class)) from None


def parsing_error(said: str, config_class: type[RunConfig]) -> str:
    """What argparse or draccus has against the command line, who `said` so at length."""
    if undecoded := re.match(r"error: `(\w+)`: Could not decode the value into any", said):
        return refusal(undecoded[1], config_class) or said
    usage, _, reason = said.rpartition("error: ")
    known = sorted({*re.findall(r"--[\w.]+", usage)})
    unknown = re.findall(r"--[\w.-]+", reason) if reason.startswith("unrecognized arguments") else []
    hints = [f"did you mean {near}?" if (near := nearest(name, known)) else "see --help" for name in unknown]
    found = [f"there is no flag {name}: {hint}" for name, hint in zip(unknown, hints, strict=True)]
    return "; ".join(found) or reason


def refusal(name: str, config_class: type[RunConfig]) -> str | None:
    """Why the configuration of an optional field refuses its settings: of a type that may also be None,
    draccus only says that it does."""
    kind = next(each for each in get_args(get_type_hints(config_class)[name]) if each is not NoneType)
    chosen = kind.get_choice_class(parser.get_type_arg(name))
    try:
        draccus.parse(chosen, args=parser.get_cli_overrides(name))
    except ParsingError as error:
        return str(error.__cause__ or error).replace("--env.", f"--{name}.")
    return None

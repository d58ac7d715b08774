"""What every console command shares: presets, parsing, claimed output folders, errors without tracebacks."""

import json
import logging
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import draccus
from draccus.utils import ParsingError
from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_wmrl.files import foreign_files, write_json

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


def claim_output_dir(output_dir: Path, config: dict[str, Any]) -> None:
    """Mark a new folder as this run's, or recognise it. ValueError if it holds something else."""
    require_free(output_dir, config)
    if not (output_dir / CONFIG_FILE).is_file():
        write_json(output_dir / CONFIG_FILE, config)


def require_free(output_dir: Path, config: dict[str, Any]) -> None:
    """ValueError unless the folder is new, empty or this run's; it is left as it is.

    Only `output_dir` may differ between the first call and its continuation: a run may be moved.
    """
    marker = output_dir / CONFIG_FILE
    if output_dir.exists() and not output_dir.is_dir():
        raise ValueError(f"--output_dir={output_dir} is a file; choose a new folder")
    if marker.is_file():
        stored = json.loads(marker.read_text())
        differing = [key for key in config if key != "output_dir" and stored.get(key) != config[key]]
        if differing:
            raise ValueError(
                f"--output_dir={output_dir} holds a run with other settings ({', '.join(differing)}); "
                "choose another folder, or repeat the settings of the first run to continue it"
            )
    elif foreign_files(output_dir, CONFIG_FILE):
        raise ValueError(f"--output_dir={output_dir} holds something else; choose a new folder")


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

        @parser.wrap()
        def parsed(cfg: config_class) -> None:  # type: ignore[valid-type]
            function(cfg)

        parsed()
    except (ValueError, OSError, ParsingError) as error:
        reason = error.__cause__ if isinstance(error, ParsingError) and error.__cause__ else error
        print(f"error: {reason}", file=sys.stderr)
        sys.exit(1)

"""Writes lerobot_wmrl/help: what every console command answers to `--help`."""

import subprocess
import sys
from importlib.metadata import distribution

from lerobot_wmrl.common.stored_help import FOLDER

FOLDER.mkdir(exist_ok=True)
for command in distribution("lerobot_env_wmrl").entry_points.select(group="console_scripts"):
    asked = [sys.executable, "-m", command.module, "--help"]  # by its module a command answers itself
    page = subprocess.run(asked, check=True, capture_output=True, text=True).stdout
    (FOLDER / f"{command.name}.txt").write_text(page)

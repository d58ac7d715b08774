"""Improvements of data that does not exist."""

from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig

from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.improve.configuration_improve import ImproveConfig
from lerobot_wmrl.improve.findings import Findings
from lerobot_wmrl.improve.plan import Plan
from lerobot_wmrl.improve.progress import Progress
from lerobot_wmrl.improve.stages import list_stages


def improvement_of(
    folder: Path, size: str = "demo", policy: PreTrainedConfig | None = None, **found: Any
) -> Progress:
    """Return one with data of which this was found: 40 short episodes unless something else is said."""
    policy = policy or CnnConfig(device="cpu", pretrained_path=folder)
    data = {
        "cameras": ["top"],
        "frame_side": 96,
        "pixels": 96**2,
        "held_out": 2,
        "held_out_tell": False,
        "tasks": 1,
        "fewest": 40,
        "longest": 40,
        "usual": 40,
        "success_frames": 1000,
        "failures": 0,
        "total": 40,
        "held": 2,
    }
    config = ImproveConfig(policy=policy, dataset=ChosenEpisodes("data"), size=size, output_dir=folder)
    found = {**data, "root": Path("data"), "columns": {}, **found}
    return Progress(Plan(config, Findings([], [], **found)))


def commands_of(improvement: Progress, *names: str) -> dict[str, list[str]]:
    """Return the commands of an improvement's stages by name, by default of all."""
    return {
        stage.name: stage.command() for stage in list_stages(improvement) if not names or stage.name in names
    }


def made_commands(folder: Path, *given: Any, **found: Any) -> dict[str, list[str]]:
    """Return the commands of such stages by name."""
    return commands_of(improvement_of(folder, *given, **found))

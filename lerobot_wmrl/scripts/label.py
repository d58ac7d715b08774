"""lerobot-wmrl-label: copy a dataset with a column `next.success`, which says where the task is solved.

    lerobot-wmrl-label --dataset.root=data/demonstrations --success.type=ends --output_dir=data/labelled
    lerobot-wmrl-label --dataset.root=data/rollouts --success.type=ends --success.episodes=[0,3,7] \\
        --output_dir=data/labelled
    lerobot-wmrl-label --dataset.root=data/rollouts --success.type=first_frames \\
        --success.first='{0: 120, 3: 95}' --output_dir=data/labelled
    lerobot-wmrl-label --dataset.root=data/rollouts --success.type=column --success.column=next.reward \\
        --success.threshold=0.95 --output_dir=data/labelled
    lerobot-wmrl-label --dataset.root=data/rollouts --success.type=reward_model \\
        --success.path=user/classifier --output_dir=data/labelled
    lerobot-wmrl-label --dataset.root=data/rollouts --success.type=by_hand --output_dir=data/labelled

World models learn from this column when an imagined episode succeeds. The dataset itself stays as it is. The
command says how many episodes succeed and for how long, and what cannot be learnt from such labels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from lerobot_wmrl.common.command_line import RunConfig, run_command
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import require_new, whole_folder, writing
from lerobot_wmrl.common.flags import flag_as_typed
from lerobot_wmrl.common.lerobot_commands import edit_advice
from lerobot_wmrl.data.dataset import DatasetSource
from lerobot_wmrl.data.episodes import SUCCESS
from lerobot_wmrl.data.features import name_notes_anew
from lerobot_wmrl.play import labels  # noqa: F401 (registers `by_hand`)
from lerobot_wmrl.rewards.success_rules import (
    ColumnRule,
    EndsRule,
    SuccessRule,
    duration_lines,
    frame_positions,
    longest_run,
)

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset


@dataclass
class LabelConfig(RunConfig):
    """Copy a dataset with a column that says where the task is solved.

    Args:
        dataset: the dataset to label.
        success: what counts as success.
        output_dir: folder of the labelled dataset.
        repo_id: its name, for the hub; by default `local/` and the folder's.
    """

    dataset: DatasetSource = field(default_factory=DatasetSource)
    success: SuccessRule = field(default_factory=EndsRule)
    output_dir: Path = Path("outputs/labelled")
    repo_id: str | None = None


def label(cfg: LabelConfig) -> None:
    """Write the labelled dataset and say what is in it."""

    dataset = cfg.dataset.open()
    require_unlabelled(cfg, dataset)
    success = cfg.success.labels(dataset)
    with writing("output_dir", cfg.output_dir, resumes=False):
        write_labelled(dataset, success, cfg.output_dir, cfg.repo_id or f"local/{cfg.output_dir.name}")
    _, frame, _ = frame_positions(dataset)
    runs = [longest_run(rows) for rows in np.split(success, np.flatnonzero(frame == 0)[1:])]
    print("\n".join(report(runs, cfg)))


def require_unlabelled(cfg: LabelConfig, dataset: "LeRobotDataset") -> None:
    """Raise FieldError if the dataset is labelled already, or there is something at `output_dir`.

    A column `next.success` of numbers becomes one of truth values where the rule reads it.
    """
    read = cfg.success.column if isinstance(cfg.success, ColumnRule) else None
    if SUCCESS in dataset.features and read != SUCCESS:
        raise FieldError(
            "dataset.root",
            cfg.dataset.root,
            f"has a column {SUCCESS} already",
            "train with it, or remove it first: "
            + edit_advice(dataset.root, "remove_feature", {"operation.feature_names": [SUCCESS]}),
        )
    require_new("output_dir", cfg.output_dir)


def write_labelled(dataset: "LeRobotDataset", success: np.ndarray, output_dir: Path, repo_id: str) -> None:
    """Copy a dataset with `next.success` (N,) by LeRobot's own function; the folder is whole or absent."""
    from lerobot.datasets.dataset_tools import add_features, remove_feature

    column = {SUCCESS: (success[:, None], {"dtype": "bool", "shape": (1,), "names": None})}
    output_dir.parent.mkdir(parents=True, exist_ok=True)
    with whole_folder(output_dir) as partial, TemporaryDirectory(dir=output_dir.parent) as numbers:
        if SUCCESS in dataset.features:
            dataset = remove_feature(
                dataset, SUCCESS, output_dir=Path(numbers, "unlabelled"), repo_id=repo_id
            )
        add_features(dataset, column, output_dir=partial, repo_id=repo_id)
        name_notes_anew(partial)


def report(runs: Sequence[int], cfg: LabelConfig) -> list[str]:
    """Return what the labels say, and what cannot be learnt from them.

    Args:
        runs: the most frames in a row in which the task is solved, of each episode.
        cfg: the command's settings.
    """
    held = np.array([count for count in runs if count])
    failures = len(runs) - len(held)
    lines = [f"{cfg.output_dir}: {len(runs)} episodes, of which {len(held)} succeed and {failures} fail."]
    lines += duration_lines(runs)
    if isinstance(cfg.success, EndsRule) and cfg.success.episodes is None:
        lines.append(
            "Every episode was taken for a success. If some fail, label the dataset again, with "
            "--success.episodes=[…], those that succeed, or by another --success.type."
        )
    if not failures:
        lines.append(
            "There is no failure: a world model cannot learn to predict one from this dataset alone, and "
            "nothing measured on it says how many failures are taken for successes. Record rollouts of the "
            "policy, and label them too."
        )
    if not len(held):
        lines.append("There is no success: a world model learns no reward from this dataset alone.")
    lines.append(
        "Next: lerobot-wmrl-train-world-model --preset=cpu --model.type=frame_tokenizer "
        f"{flag_as_typed('dataset.root', cfg.output_dir)} …"
    )
    return lines


def main() -> None:
    """Run the console command."""
    run_command(label, LabelConfig, list)


if __name__ == "__main__":
    main()

"""Dyna rounds (Sutton 1991): the world model learns what the policy does by now, and training goes on in it.

A round records the policy in ManiSkill, as it is and noisy, or takes what was recorded elsewhere, and
trains the world model further on that and on what it has learnt from. Both are commands of the package, so a
round that was killed goes on where it was.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from lerobot.utils.constants import PRETRAINED_MODEL_DIR

from lerobot_wmrl.common.constants import EVALUATION_SEED
from lerobot_wmrl.common.presets import Flags, format_flags
from lerobot_wmrl.common.subcommand import run_subcommand
from lerobot_wmrl.data.dataset_source import DatasetSource
from lerobot_wmrl.data.episode_table import open_dataset
from lerobot_wmrl.envs.world_model_env import WorldModelVectorEnv
from lerobot_wmrl.rl.callbacks import REAL_STEPS, Record, record_folder
from lerobot_wmrl.rl.configuration_callbacks import DYNA_SEEDS, DynaConfig
from lerobot_wmrl.rl.policy_gradient import TrainingStopped
from lerobot_wmrl.rl.recording import RolloutRecorder
from lerobot_wmrl.world_models.checkpoint import load_model

MANNERS: Final = {"calm": 0.0, "noisy": 0.4}
"""How the policy acts while it is recorded: exploration. A policy that is only ever seen noisy is
believed when it fails calmly."""

WORLD_MODEL = "action_world_model"


def round_iterations(rounds: int, iterations: int) -> list[int]:
    """After which iterations there is a round: evenly spread, none at either end."""
    return [round(iterations * number / (rounds + 1)) for number in range(1, rounds + 1)]


@dataclass
class DynaRounds:
    """Refreshes the world model of `env` after some of the iterations.

    Args:
        config: how much to record and to train.
        env: the imagination that the policy is trained in.
        recorder: of the policy; None where `config.dataset.roots` are taken.
        learnt: the dataset that the world model has learnt from.
        output_dir: of the training; total: its iterations.
    """

    config: DynaConfig
    env: WorldModelVectorEnv
    recorder: RolloutRecorder | None
    learnt: DatasetSource
    output_dir: Path
    total: int
    name: str = "dyna"

    def __post_init__(self) -> None:
        self.iterations = round_iterations(self.config.rounds, self.total)

    def due(self, iteration: int) -> bool:
        return iteration in self.iterations

    def run(self, iteration: int, checkpoint: Path, folder: Path) -> Record:
        """A new world model in `folder`, and the steps in reality that it took."""
        new = self._new_datasets(iteration, checkpoint, folder)
        self._train(iteration, [*self._earlier(iteration), *map(str, new)], folder / WORLD_MODEL)
        metas = [open_dataset(root).meta for root in new]
        return {
            "episodes": sum(meta.total_episodes for meta in metas),
            REAL_STEPS: sum(meta.total_frames for meta in metas),
        }

    def apply(self, records: Mapping[int, Record]) -> None:
        """Imagine with the newest world model from now on."""
        model = load_model(self._world_model(max(records)), WORLD_MODEL, self.env.device.type)
        self.env.adopt(model)

    def _new_datasets(self, iteration: int, checkpoint: Path, folder: Path) -> list[Path]:
        """What this round adds. TrainingStopped if it has to be recorded elsewhere first."""
        number, given = self.iterations.index(iteration), self.config.dataset.roots or []
        if self.recorder is not None:
            return [self._record(manner, number, checkpoint, folder) for manner in MANNERS]
        if number < len(given):
            return [Path(given[number])]
        raise TrainingStopped(
            f"Dyna round {number + 1} of {len(self.iterations)}, after iteration {iteration}: record what "
            f"the policy in {checkpoint / PRETRAINED_MODEL_DIR} does, add the dataset to "
            f"--dyna.dataset.roots ({len(given)} there now), and repeat the command: it goes on from here"
        )

    def _record(self, manner: str, number: int, checkpoint: Path, folder: Path) -> Path:
        assert self.recorder is not None
        place, every = list(MANNERS).index(manner), self.config.n_episodes
        first = EVALUATION_SEED - DYNA_SEEDS + number * every + place * (every // 2)
        self.recorder.record(checkpoint, (every + place) // 2, first, folder / manner, MANNERS[manner])
        return folder / manner

    def _earlier(self, iteration: int) -> list[str]:
        """What earlier rounds have added."""
        rounds = [number for number, at in enumerate(self.iterations) if at < iteration]
        if self.recorder is None:
            return [(self.config.dataset.roots or [])[number] for number in rounds]
        folders = [self._folder(self.iterations[number]) for number in rounds]
        return [str(folder / manner) for folder in folders for manner in MANNERS]

    def _train(self, iteration: int, more: list[str], output_dir: Path) -> None:
        """Of the datasets in `more` every second step's batch, of the old one the others."""
        number, before = self.iterations.index(iteration), self.env.config.world_model_path
        if number:
            before = str(self._world_model(self.iterations[number - 1]))
        flags: Flags = {
            "model.path": before, "model.device": self.env.device.type, "dataset.root": self.learnt.root,
            "dataset.more": str(more), "model.learning_rate": self.config.learning_rate,
            "steps": self.config.steps, "batch_size": self.config.batch_size,
            "save_freq": max(1, self.config.steps // 4), "seed": number, "output_dir": str(output_dir),
            **({"dataset.repo_id": self.learnt.repo_id} if self.learnt.repo_id else {}),
        }  # fmt: skip
        run_subcommand(["lerobot-wmrl-train-world-model", *format_flags(flags)])

    def _folder(self, iteration: int) -> Path:
        return record_folder(self.output_dir, self.name, iteration, self.total)

    def _world_model(self, iteration: int) -> Path:
        """Of the round after this iteration."""
        return self._folder(iteration) / WORLD_MODEL

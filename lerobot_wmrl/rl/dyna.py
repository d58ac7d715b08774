"""Dyna rounds (Sutton 1991): train the world model further on what the policy does by then.

A round records the policy in `real_env`, with and without noise, or takes a dataset recorded elsewhere. It
then trains the world model on that and on its first dataset. Recording and training run as commands of this
package, so a round that was killed continues where it was.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from lerobot.utils.constants import PRETRAINED_MODEL_DIR

from lerobot_wmrl.common.constants import DYNA
from lerobot_wmrl.common.errors import TrainingStopped
from lerobot_wmrl.common.flags import Flags, program_call
from lerobot_wmrl.common.precision import device_setting
from lerobot_wmrl.common.processes import run_subcommand
from lerobot_wmrl.common.seeds import dyna_seed
from lerobot_wmrl.data.dataset import DatasetSource, open_dataset
from lerobot_wmrl.data.ledger import budget_flags
from lerobot_wmrl.envs.world_model_env import WorldModelVectorEnv
from lerobot_wmrl.rl.callbacks import REAL_STEPS, Record, record_folder
from lerobot_wmrl.rl.configuration_callbacks import DynaConfig
from lerobot_wmrl.rl.recorders import Recorder
from lerobot_wmrl.world_models.checkpoint import load_model

NOISE_LEVELS: Final = {"calm": 0.0, "noisy": 0.4}
"""Exploration noise of the recorded policy, by the name of the recording. A world model that was trained on
noisy episodes alone calls failures of the noise-free policy successes."""

LEARNING_RATE: Final = 3e-4
"""Peak learning rate of a round, below that of a training from scratch."""

WORLD_MODEL: Final = "action_world_model"


def round_iterations(rounds: int, iterations: int) -> list[int]:
    """Return the iterations after which there is a round: evenly spread, none before the first or after the
    last iteration."""
    return [round(iterations * number / (rounds + 1)) for number in range(1, rounds + 1)]


@dataclass
class DynaRounds:
    """Trains the world model of `env` further after some of the iterations.

    Args:
        config: how much to record and to train.
        env: the world model as the environment of the training.
        recorder: records the policy; None if datasets are recorded elsewhere (`config.dataset.roots`).
        learnt: the dataset that the world model was trained on.
        output_dir: the training's output folder.
        total: iterations of the training.
        seed: seed of the training, from which those of starts and of the world model's training follow.
        budget: ledger that knows every dataset; None without.
    """

    config: DynaConfig
    env: WorldModelVectorEnv
    recorder: Recorder | None
    learnt: DatasetSource
    output_dir: Path
    total: int
    seed: int
    budget: Path | None = None
    name: str = DYNA

    def __post_init__(self) -> None:
        self.iterations = round_iterations(self.config.rounds, self.total)

    def due(self, iteration: int) -> bool:
        """Return whether there is a round after so many iterations."""
        return iteration in self.iterations

    def run(self, iteration: int, checkpoint: Path, folder: Path) -> Record:
        """Train a new world model in `folder`; return the recorded episodes and their steps."""
        new = self._new_datasets(iteration, checkpoint, folder)
        self._train(iteration, [*self._earlier(iteration), *map(str, new)], folder / WORLD_MODEL)
        metas = [open_dataset(root).meta for root in new]
        return {
            "episodes": sum(meta.total_episodes for meta in metas),
            REAL_STEPS: sum(meta.total_frames for meta in metas),
        }

    def apply(self, records: Mapping[int, Record]) -> None:
        """Give the environment the world model of the latest round."""
        model = load_model(self._world_model(max(records)), WORLD_MODEL, device_setting(self.env.device))
        self.env.adopt(model)

    def _new_datasets(self, iteration: int, checkpoint: Path, folder: Path) -> list[Path]:
        """Return the datasets of this round. TrainingStopped if one has to be recorded elsewhere first."""
        number, roots = self.iterations.index(iteration), self.config.dataset.roots or []
        if self.recorder is not None:
            return [self._record(self.recorder, name, number, checkpoint, folder) for name in NOISE_LEVELS]
        if number < len(roots):
            return [Path(roots[number])]
        raise TrainingStopped(
            f"Dyna round {number + 1} of {len(self.iterations)}, after iteration {iteration}: record what "
            f"the policy in {checkpoint / PRETRAINED_MODEL_DIR} does, add the dataset to "
            f"`dyna.dataset.roots` ({len(roots)} there now), and repeat the command: it continues from here"
        )

    def _record(self, recorder: Recorder, noise: str, number: int, checkpoint: Path, folder: Path) -> Path:
        half = list(NOISE_LEVELS).index(noise)
        count, seed = (self.config.n_episodes + half) // 2, self.start(number, half)
        recorder.record(checkpoint, count, seed, folder / noise, NOISE_LEVELS[noise])
        return folder / noise

    def start(self, number: int, half: int) -> int:
        """Return the seed of the first episode of one half, 0 or 1, of a round's recording."""
        n_episodes = self.config.n_episodes
        place = (self.seed * self.config.rounds + number) * n_episodes + half * (n_episodes // 2)
        return dyna_seed(place, n_episodes)

    def _earlier(self, iteration: int) -> list[str]:
        """Return the datasets of earlier rounds."""
        rounds = [number for number, at in enumerate(self.iterations) if at < iteration]
        if self.recorder is None:
            return [(self.config.dataset.roots or [])[number] for number in rounds]
        folders = [self._folder(self.iterations[number]) for number in rounds]
        return [str(folder / noise) for folder in folders for noise in NOISE_LEVELS]

    def _train(self, iteration: int, more: list[str], output_dir: Path) -> None:
        """Train on the datasets in `more` in every second step, and on the first dataset in the others."""
        number, initial = self.iterations.index(iteration), self.env.config.world_model_path
        if number:
            initial = str(self._world_model(self.iterations[number - 1]))
        flags: Flags = {
            "model.path": initial,
            "model.device": device_setting(self.env.device),
            **self.learnt.flags(),
            "dataset.more": more,
            "model.learning_rate": LEARNING_RATE,
            "steps": self.config.steps,
            "batch_size": self.config.batch_size,
            "save_freq": max(1, self.config.steps // 4),
            "seed": self.seed + number,
            "output_dir": str(output_dir),
            **budget_flags(self.budget),
        }
        run_subcommand(program_call("lerobot-wmrl-train-world-model", flags))

    def _folder(self, iteration: int) -> Path:
        return record_folder(self.output_dir, self.name, iteration, self.total)

    def _world_model(self, iteration: int) -> Path:
        """Return the folder of the world model of the round after this iteration."""
        return self._folder(iteration) / WORLD_MODEL

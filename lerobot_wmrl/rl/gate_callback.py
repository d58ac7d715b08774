"""The gate: a check that the world model does not call too many failures successes.

It replays recorded episodes open loop (`evaluation.gate`) and judges them at the environment's own done
threshold and number of frames, before the first update and again while the policy changes.
"""

import logging
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from termcolor import colored

from lerobot_wmrl.common.errors import TrainingStopped, within
from lerobot_wmrl.common.seeds import gate_seed
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.envs.world_model_env import WorldModelVectorEnv
from lerobot_wmrl.evaluation.evidence import LabelledRollouts, learnt_from
from lerobot_wmrl.evaluation.gate import Gate, gate_at
from lerobot_wmrl.evaluation.outcomes import Outcomes, labelled_recording, predict_outcomes
from lerobot_wmrl.evaluation.pictures import save_strip, side_by_side
from lerobot_wmrl.evaluation.replay import Recording, replay_episodes
from lerobot_wmrl.rl.callbacks import REAL_STEPS, Record
from lerobot_wmrl.rl.configuration_callbacks import GateConfig
from lerobot_wmrl.rl.recorders import Recorder

LABELLED, FRESH = "labelled", "fresh"
"""Sources of rollouts: `gate.dataset`, or new ones of the current policy."""

REMEDIES = (
    "A policy trained here learns what only looks like success. Record more near misses and train the world "
    "model again, let Dyna rounds do so (`dyna.rounds`), take another checkpoint of it, or judge success "
    "more strictly (`env.done_threshold`, `env.done_frames`)"
)


@dataclass
class SuccessGate:
    """Counts the world model's false positives at intervals.

    Args:
        config: when to check, the limit, and what to do above it.
        env: the world model as the environment of the training.
        recorder: records fresh rollouts; None without `real_env`.
        refreshed: iterations after which a Dyna round replaces the world model.
        total: iterations of the training.
    """

    config: GateConfig
    env: WorldModelVectorEnv
    recorder: Recorder | None
    refreshed: frozenset[int]
    total: int
    name: str = "gate"

    def due(self, iteration: int) -> bool:
        """Return whether to check: in a new world model, and every `freq` iterations with fresh rollouts."""
        if iteration >= self.total:
            return False
        again = self.recorder is not None and self.config.freq and iteration % self.config.freq == 0
        return self._new_model(iteration) or bool(again)

    def run(self, iteration: int, checkpoint: Path, folder: Path) -> Record:
        """Return a verdict for each source of rollouts, and a warning if one is bad or there is none."""
        recordings: dict[str, Recording] = {}
        if self.config.dataset.given and self._new_model(iteration):
            recordings[LABELLED] = self._labelled()
        if self.recorder is not None:
            recordings[FRESH] = self._fresh(self.recorder, iteration, checkpoint, folder / "rollouts")
        verdicts = {}
        for source, recording in recordings.items():
            outcomes = predict_outcomes(self.env.model, recording).within(self.env.config.judged_frames)
            verdicts[source] = gate_at(outcomes, self.env.config.criterion)
            save_strips(self.env, recording, outcomes, folder, source)
        shutil.rmtree(folder / "rollouts.cache", ignore_errors=True)
        steps = int(recordings[FRESH].table.length.sum()) if FRESH in recordings else 0
        return {
            **{source: verdict.as_json() for source, verdict in verdicts.items()},
            "failed": any(self._above(verdict) for verdict in verdicts.values()),
            "warning": self._warning(iteration, verdicts),
            REAL_STEPS: steps,
        }

    def apply(self, records: Mapping[int, Record]) -> None:
        """Warn in red, or raise TrainingStopped, if the latest verdict is bad."""
        latest = records[max(records)]
        warning = f"{latest['warning']}. {REMEDIES}" if latest["failed"] else latest["warning"]
        if latest["failed"] and self.config.action == "stop":
            raise TrainingStopped(f"{warning}; or train nonetheless with `gate.action=warn`")
        if warning:
            logging.warning(colored(warning, "red", attrs=["bold"]))

    def _new_model(self, iteration: int) -> bool:
        return iteration == 0 or iteration in self.refreshed

    def _labelled(self) -> Recording:
        """Read the labelled rollouts, and warn if the world model has learnt from them."""
        with within("gate"):
            rollouts = LabelledRollouts.read(self.config.dataset)
        path = str(self.env.model.config.pretrained_path)  # of the newest one after Dyna rounds
        if learnt := learnt_from(path, rollouts):
            warning = (
                f"The world model has learnt from {learnt} of these episodes ({rollouts.name}), so it takes "
                "fewer of their failures for successes than of others. Give rollouts that it has not seen "
                "(`gate.dataset`)."
            )
            logging.warning(colored(warning, "red", attrs=["bold"]))
        return labelled_recording(self.env.model, rollouts.table)

    def _fresh(self, recorder: Recorder, iteration: int, checkpoint: Path, folder: Path) -> Recording:
        """Record the current policy, from seeds that no earlier rollouts had."""
        episodes = self.config.n_episodes
        recorder.record(checkpoint, episodes, gate_seed(iteration * episodes, episodes), folder)
        return labelled_recording(self.env.model, read_episodes(open_dataset(folder)))

    def _above(self, verdict: Gate) -> bool:
        return verdict.false_positives.share > self.config.limit

    def _warning(self, iteration: int, verdicts: Mapping[str, Gate]) -> str | None:
        """Return what is wrong with the verdicts, if anything is."""
        failed = {source: verdict for source, verdict in verdicts.items() if self._above(verdict)}
        if failed:
            counts = " and ".join(f"{v.false_positives} of {source} rollouts" for source, v in failed.items())
            return (
                f"Gate, iteration {iteration}: the world model calls failures successes, {counts}, above "
                f"`gate.limit` ({self.config.limit})"
            )
        if not verdicts:
            return (
                "Gate: nobody has checked how many failures this world model calls successes, so success in "
                "imagination may be wrong; give labelled rollouts (`gate.dataset.root`) or an environment to "
                "record some in (`real_env.type`)"
            )
        if not any(verdict.false_positives.n for verdict in verdicts.values()):
            return f"Gate, iteration {iteration}: no rollout failed, so false positives were not counted"
        return None


def save_strips(
    env: WorldModelVectorEnv, recording: Recording, outcomes: Outcomes, folder: Path, source: str
) -> None:
    """Draw the shortest success and the shortest failure, a false positive if there is one, as frames: the
    recorded episode above, the imagined one below."""
    folder.mkdir(parents=True, exist_ok=True)
    predicted = outcomes.predicted_success(env.config.criterion)
    false_positives = predicted & ~outcomes.success
    failures = false_positives if false_positives.any() else ~outcomes.success
    for name, rows in {"success": outcomes.success, "failure": failures}.items():
        if rows.any():
            episodes = outcomes.episodes[rows]
            shortest = episodes[np.argmin(recording.table.length[episodes])]
            replay: Any = next(replay_episodes(env.model, recording, np.array([shortest])))
            save_strip(side_by_side(env.model, recording, replay), folder / f"{source}_{name}.png")

"""May a policy be trained in this world model? Of real failures, how many does it call successes?

The gate of `world_models.evaluation.gate`, at the done threshold and the number of frames of the environment
itself, asked before the first update and again while the policy changes.
"""

import logging
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from termcolor import colored

from lerobot_wmrl.common.constants import GATE_SEED
from lerobot_wmrl.envs.world_model_env import WorldModelVectorEnv
from lerobot_wmrl.evaluation.gate import Gate, Outcomes, gate_at, labelled_recording, predict_outcomes
from lerobot_wmrl.evaluation.pictures import save_strip, side_by_side
from lerobot_wmrl.evaluation.replay import Recording, replay_episodes
from lerobot_wmrl.rl.callbacks import REAL_STEPS, Record
from lerobot_wmrl.rl.configuration_callbacks import GateConfig
from lerobot_wmrl.rl.policy_gradient import TrainingStopped
from lerobot_wmrl.rl.recording import RolloutRecorder

SEEDS = 1_000_000
"""From GATE_SEED on."""

LABELLED, FRESH = "labelled", "fresh"
"""Where the rollouts come from: a dataset that was there before, or this policy just now."""

REMEDIES = (
    "A policy trained here learns what only looks like success. Record more near misses and train the world "
    "model again, let Dyna rounds do so (--dyna.rounds), take another checkpoint of it, or judge success "
    "more strictly (--env.done_threshold, --env.done_frames)"
)


@dataclass
class SuccessGate:
    """Asks at intervals.

    Args:
        config: what to ask, when, and what follows.
        env: the imagination in question.
        recorder: of fresh rollouts; None without a simulator.
        refreshed: iterations after which the world model is another one.
        total: of the training.
    """

    config: GateConfig
    env: WorldModelVectorEnv
    recorder: RolloutRecorder | None
    refreshed: frozenset[int]
    total: int
    name: str = "gate"

    def due(self, iteration: int) -> bool:
        """Before an update in a new world model, and every `freq` iterations if there are fresh rollouts."""
        if iteration >= self.total:
            return False
        again = self.recorder is not None and self.config.freq and iteration % self.config.freq == 0
        return self._new_model(iteration) or bool(again)

    def run(self, iteration: int, checkpoint: Path, folder: Path) -> Record:
        """Each verdict as of lerobot-wmrl-eval-world-model, and a warning if one is not as it should be."""
        asked: dict[str, Recording] = {}
        if self.config.dataset.root and self._new_model(iteration):
            asked[LABELLED] = labelled_recording(self.env.model, self.config.dataset.root)
        if self.recorder is not None:
            asked[FRESH] = self._fresh(self.recorder, iteration, checkpoint, folder / "rollouts")
        verdicts = {}
        for place, source in asked.items():
            outcomes = predict_outcomes(self.env.model, source)
            verdicts[place] = gate_at(outcomes, self.env.config.done_threshold, self.env.config.done_frames)
            save_strips(self.env, source, outcomes, folder, place)
        shutil.rmtree(folder / "rollouts.cache", ignore_errors=True)
        steps = int(asked[FRESH].table.length.sum()) if FRESH in asked else 0
        return {
            **{place: verdict.as_json() for place, verdict in verdicts.items()},
            "failed": any(self._above(verdict) for verdict in verdicts.values()),
            "warning": self._warning(iteration, verdicts),
            REAL_STEPS: steps,
        }

    def apply(self, records: Mapping[int, Record]) -> None:
        """TrainingStopped, or a warning in red, if the last answer was a bad one."""
        latest = records[max(records)]
        if latest["failed"] and self.config.action == "stop":
            raise TrainingStopped(f"{latest['warning']}; or train nonetheless with --gate.action=warn")
        if latest["warning"]:
            logging.warning(colored(latest["warning"], "red", attrs=["bold"]))

    def _new_model(self, iteration: int) -> bool:
        return iteration == 0 or iteration in self.refreshed

    def _fresh(self, recorder: RolloutRecorder, iteration: int, checkpoint: Path, folder: Path) -> Recording:
        """Rollouts of the policy as it is, from seeds that no earlier ones had."""
        episodes = self.config.n_episodes
        first = GATE_SEED + iteration * episodes % (SEEDS - episodes)
        recorder.record(checkpoint, episodes, first, folder)
        return labelled_recording(self.env.model, folder)

    def _above(self, verdict: Gate) -> bool:
        return verdict.false_positives.share > self.config.limit

    def _warning(self, iteration: int, verdicts: Mapping[str, Gate]) -> str | None:
        """What is wrong, in plain words, if anything is."""
        failed = {place: verdict for place, verdict in verdicts.items() if self._above(verdict)}
        if failed:
            told = " and ".join(f"{v.false_positives} of {place} rollouts" for place, v in failed.items())
            return (
                f"Gate, iteration {iteration}: the world model calls real failures successes, {told}, above "
                f"--gate.limit={self.config.limit}. {REMEDIES}"
            )
        if not verdicts:
            return (
                "Gate: nobody has asked how many real failures this world model calls successes. What it "
                "imagines may be wrong; give labelled rollouts (--gate.dataset.root) or a simulator "
                "(--real_env.type=wmrl_maniskill)"
            )
        if not any(verdict.false_positives.n for verdict in verdicts.values()):
            return f"Gate, iteration {iteration}: no rollout failed, so they say nothing of the world model"
        return None


def save_strips(
    env: WorldModelVectorEnv, source: Recording, outcomes: Outcomes, folder: Path, place: str
) -> None:
    """Two short episodes as they happened, above, and as they are imagined, below: a success and a failure,
    one that the model believes in if there is one."""
    folder.mkdir(parents=True, exist_ok=True)
    called = outcomes.first_predicted_success(env.config.done_threshold, env.config.done_frames) >= 0
    believed = called & ~outcomes.success
    failures = believed if believed.any() else ~outcomes.success
    for name, rows in {"success": outcomes.success, "failure": failures}.items():
        if rows.any():
            episodes = outcomes.episodes[rows]
            shortest = episodes[np.argmin(source.table.length[episodes])]
            run: Any = next(replay_episodes(env.model, source, np.array([shortest])))
            save_strip(side_by_side(env.model, source, run), folder / f"{place}_{name}.png")

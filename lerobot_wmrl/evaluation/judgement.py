"""Policies judged in a world model: which of them can be, and what their success there says about reality."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from lerobot_wmrl.common.checkpoints import resolve_checkpoint
from lerobot_wmrl.common.command_line import CONFIG_FILE
from lerobot_wmrl.common.errors import FieldError, first_line
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.data.episodes import ChosenEpisodes, choose_episodes
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.evaluation.calibration import (
    RateEstimate,
    Recognition,
    conformal_margin,
    corrected_rate,
)
from lerobot_wmrl.evaluation.gate import gate_at, labelled_recording, predict_outcomes
from lerobot_wmrl.world_models.checkpoint import load_model

RESULTS: Final = "judgement.json"
"""The file of a judgement, in its folder."""

LEAST_DIFFERENCE: Final = 0.5
"""Youden's index of the labelled rollouts below which nothing is judged: the correction would more than
double every error."""


@dataclass
class Judgement:
    """What a world model says about policies.

    Args:
        recognition: of labelled rollouts.
        references: real success of the policies for which it is known, by name.
        refused: why a policy cannot be judged, by name.
        coverage: share of the intervals that shall contain the real rate.
        warning: what is wrong with the rollouts, if anything is.
        outcomes: success of each policy's imagined episodes, those of the references included.
    """

    recognition: Recognition
    references: Mapping[str, Proportion]
    refused: Mapping[str, str]
    coverage: float
    warning: str | None = None
    outcomes: dict[str, list[bool]] = field(default_factory=dict)

    @property
    def blind(self) -> bool:
        """Whether the world model tells too little of success for anything to be judged."""
        return not self.recognition.difference >= LEAST_DIFFERENCE

    def imagined(self, name: str) -> Proportion:
        """Return how often a policy succeeds in the world model."""
        return Proportion(sum(self.outcomes[name]), len(self.outcomes[name]))

    def corrected(self, name: str) -> RateEstimate:
        """Return that rate, corrected for what the world model takes for a success."""
        return corrected_rate(self.imagined(name), self.recognition, self.coverage)

    @property
    def margin(self) -> float | None:
        """Margin that the references' errors give, infinite if they are too few; None without references."""
        usable = [name for name in self.references if name in self.outcomes and name not in self.refused]
        if not usable:
            return None
        errors = [self.corrected(name).value - self.references[name].share for name in usable]
        return conformal_margin(errors, self.coverage)

    def estimate(self, name: str) -> RateEstimate | None:
        """Return a policy's real success rate, None if it cannot be judged."""
        if self.blind or name in self.refused:
            return None
        margin = self.margin
        return self.corrected(name) if margin is None else self.corrected(name).within(margin)

    @property
    def judged(self) -> list[str]:
        """The policies whose real success is asked for, and that are not refused."""
        return [name for name in self.outcomes if name not in self.references]

    def as_json(self) -> dict[str, Any]:
        """Return the judgement as JSON, from which `read_outcomes` continues."""
        margin = self.margin if self.outcomes and not self.blind else None
        return {
            "coverage": self.coverage,
            "rollouts": {
                "recall": self.recognition.recall.as_json(),
                "false_positive_rate": self.recognition.false_positives.as_json(),
            },
            "warning": self.warning,
            "margin": None if margin is None or math.isinf(margin) else margin,
            "policies": {name: self._policy_json(name) for name in {**self.outcomes, **self.refused}},
            "outcomes": self.outcomes,
        }

    def _policy_json(self, name: str) -> dict[str, Any]:
        estimate = None if name not in self.outcomes else self.estimate(name)
        return {
            "imagined": self.imagined(name).as_json() if name in self.outcomes else None,
            "estimate": estimate and estimate._asdict(),
            "real": self.references[name].as_json() if name in self.references else None,
            "refused": self.refused.get(name),
        }

    def __str__(self) -> str:
        recall, false_positives = self.recognition
        rollouts = (
            f"Labelled rollouts: the world model recognises {recall} of the successes and takes "
            f"{false_positives} of the failures for successes."
        )
        if self.blind:
            return (
                f"{rollouts}\nNothing is judged: that tells too little of success. Choose another threshold "
                "or number of frames (lerobot-wmrl-eval-world-model shows what they do), or train the world "
                "model on more failures."
            )
        width = max(map(len, self.outcomes))
        rows = [f"{name:<{width}}  {self._row(name)}" for name in self.outcomes]
        refusals = [f"{name}: not judged, {why}" for name, why in self.refused.items()]
        warnings = [self.warning] if self.warning else []
        return "\n".join([rollouts, self._basis(), *warnings, "", *rows, *refusals])

    def _row(self, name: str) -> str:
        said = f"{self.imagined(name)} in imagination"
        if name in self.references:
            return f"{said}; in reality {self.references[name]}"
        return f"{said}; estimated {self.estimate(name)}"

    def _basis(self) -> str:
        """Say what the intervals rest on."""
        share = f"{100 * self.coverage:.0f} %"
        if self.margin is None:
            return f"The intervals contain {share} of the real rates, if it errs alike about these policies."
        if math.isinf(self.margin):
            return (
                f"{len(self.references)} references are too few for intervals with {share} of the real rates."
            )
        return (
            f"By {len(self.references)} references, {share} of the estimates are at most "
            f"{100 * self.margin:.0f} points from the real rate."
        )


def recognise(env: WorldModelEnv, rollouts: ChosenEpisodes, split: str) -> Recognition:
    """Replay labelled rollouts in a world model, at the environment's threshold and length of an episode.

    Raises:
        FieldError: they do not fit the world model, have no labels, or do not both succeed and fail.
    """
    model = load_model(env.world_model_path, "action_world_model", env.device)
    recording = labelled_recording(model, rollouts.open())
    table = recording.table
    chosen = choose_episodes(table, split, len(table.length), wanted=table.among(rollouts.episodes))
    outcomes = predict_outcomes(model, recording)
    outcomes = outcomes.where(np.isin(outcomes.episodes, chosen)).within(env.horizon)
    gate = gate_at(outcomes, env.done_threshold, env.done_frames)
    for found, kind in ((gate.recall, "succeeds"), (gate.false_positives, "fails")):
        if not found.n:
            raise FieldError(
                "dataset.root", rollouts.name,
                f"none of the {len(outcomes.episodes)} rollouts {kind} within {env.horizon} frames, so "
                "nobody knows how often the world model errs",
                "give rollouts that both succeed and fail",
            )  # fmt: skip
    return Recognition(gate.recall, gate.false_positives)


def read_references(path: Path | None) -> dict[str, Proportion]:
    """Read real success of policies from a comparison, or from a file that is written like it.

    Raises:
        FieldError: there is none, it is something else, or it is of imagined episodes.
    """
    if path is None:
        return {}
    try:
        found = json.loads(path.read_text())
        rates = {name: Proportion(int(rate["k"]), int(rate["n"])) for name, rate in found["policies"].items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise FieldError(
            "references", path, f"no success of policies can be read from it ({first_line(error)})",
            "give comparison.json of lerobot-wmrl-compare, or a file like it: "
            '{"policies": {"outputs/a": {"k": 12, "n": 20}}}',
        ) from error  # fmt: skip
    if found.get("env", {}).get("type") == WorldModelEnv.get_choice_name(WorldModelEnv):
        raise FieldError(
            "references", path, "its episodes are imagined ones", "compare the policies in a real environment"
        )
    if bad := [name for name, rate in rates.items() if not 0 <= rate.k <= rate.n or not rate.n]:
        raise FieldError(
            "references", path, f"{bad[0]} succeeds in {rates[bad[0]].k} of {rates[bad[0]].n} episodes",
            "give `k` successes of `n` episodes",
        )  # fmt: skip
    return rates


def trained_inside(policy: str, world_model: str) -> str | None:
    """Return why a policy is not judged in a world model, if it was trained there."""
    path = training_settings(policy, "env").get("world_model_path")
    if not path or not _same(path, world_model, resolve_checkpoint(path), resolve_checkpoint(world_model)):
        return None
    return "it was trained in this world model, and may have learnt what only looks like success there"


def learnt_from(world_model: str, rollouts: ChosenEpisodes, split: str) -> str | None:
    """Return a warning if the world model has learnt from the rollouts that say how often it errs."""
    source = training_settings(world_model, "dataset")
    own = source.get("root") or source.get("repo_id")
    held_out = "validation" in split.split(",")
    if not own or held_out or not _same(own, rollouts.name, Path(own), Path(rollouts.name)):
        return None
    return (
        f"The world model has learnt from {rollouts.name} and recognises these better than other episodes: "
        "the intervals are too narrow. Take the episodes that were held out (--split=validation), or others."
    )


def training_settings(checkpoint: str, group: str) -> Mapping[str, Any]:
    """Return settings of the training that made a checkpoint, none if they are not stored."""
    path = resolve_checkpoint(checkpoint) / CONFIG_FILE
    return (json.loads(path.read_text()).get(group) if path.is_file() else None) or {}


def _same(one: str, other: str, first: Path, second: Path) -> bool:
    return one == other or (first.exists() and second.exists() and first.samefile(second))


def save_picture(judgement: Judgement, path: Path) -> None:
    """Draw the estimates with their intervals, and imagined and known real success as points."""
    names = list(judgement.outcomes)
    figure = Figure(figsize=(7, 1.4 + 0.5 * len(names)), layout="constrained")
    axes = figure.subplots()
    for place, name in enumerate(names):
        estimate = judgement.estimate(name)
        if estimate is not None:
            whiskers = [[estimate.value - estimate.low], [estimate.high - estimate.value]]
            axes.errorbar(estimate.value, place, xerr=whiskers, color="#2b6cb0", marker="o", capsize=4)
        axes.plot(judgement.imagined(name).share, place, color="#999", marker="|", markersize=12)
        if name in judgement.references:
            axes.plot(judgement.references[name].share, place, color="#c05621", marker="x")
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlim(0, 1)
    axes.set_xlabel("success rate: estimated (blue), imagined (grey), known (orange)")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)

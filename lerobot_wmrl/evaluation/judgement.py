"""The success of policies as a world model sees it, and what that says about reality."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.evaluation.calibration import (
    Confusion,
    RateEstimate,
    calibrated_rate,
    corrected_rate,
)

JUDGEMENT_FILE: Final = "judgement.json"
"""The file of a judgement, in its folder."""

LEAST_YOUDEN: Final = 0.5
"""Recall less false positive rate below which nothing is judged: the correction would more than double every
error."""

OTHERWISE: Final = "so the world model errs about it otherwise than about the rollouts"


@dataclass
class Judgement:
    """What a world model says about policies.

    Args:
        confusion: the world model's, on labelled rollouts.
        references: real success of the policies for which it is known, by name.
        refused: why a policy is not judged, by name.
        coverage: share of the intervals that shall contain the real rate.
        warnings: what is wrong with the rollouts.
        outcomes: success of each policy's imagined episodes, those of the references included.
        earlier: the same of policies that an earlier call has judged and this one does not.
        checkpoints: digests of the policies' checkpoints, by name, of these too.
    """

    confusion: Confusion
    references: Mapping[str, Proportion]
    refused: Mapping[str, str]
    coverage: float
    warnings: Sequence[str] = ()
    outcomes: dict[str, list[bool]] = field(default_factory=dict)
    earlier: dict[str, list[bool]] = field(default_factory=dict)
    checkpoints: dict[str, str] = field(default_factory=dict)

    def imagined(self, name: str) -> Proportion:
        """Return how often a policy succeeds in the world model."""
        return Proportion.of(self.outcomes[name])

    def corrected(self, name: str) -> RateEstimate:
        """Return that rate, corrected for false positives and recall; it may lie beyond 0 and 1."""
        return corrected_rate(self.imagined(name), self.confusion, self.coverage)

    def calibrated(self, name: str) -> RateEstimate | None:
        """Return the rate that the references give, None if they are too few; it may lie beyond 0 and 1."""
        known = [(self.imagined(each).share, self.references[each].share) for each in self.usable_references]
        return calibrated_rate(self.imagined(name).share, known, self.coverage)

    def refusal(self, name: str) -> str | None:
        """Return why a policy is not judged, None if it is.

        With enough references it is judged by them, also where the rollouts do not explain its success.
        """
        if name in self.refused or self.calibrated(name):
            return self.refused.get(name)
        corrected = self.corrected(name)
        if corrected.high < 0:
            return f"it succeeds in imagination less often than the rollouts' failures do, {OTHERWISE}"
        if corrected.low > 1:
            return f"it succeeds in imagination more often than the rollouts' successes do, {OTHERWISE}"
        return None

    @property
    def usable_references(self) -> list[str]:
        """The references that have been imagined and are not refused."""
        return [name for name in self.references if name in self.outcomes and name not in self.refused]

    def estimate(self, name: str) -> RateEstimate | None:
        """Return a policy's real success rate, None if it is known or the policy is not judged."""
        if name in self.references or self.refusal(name):
            return None
        return (self.calibrated(name) or self.corrected(name)).clipped()

    def as_json(self, finished: bool) -> dict[str, Any]:
        """Return the judgement as JSON. finished: whether all policies have been imagined."""
        return {
            "finished": finished,
            "coverage": self.coverage,
            **confusion_json(self.confusion),
            "warnings": list(self.warnings),
            "references": len(self.usable_references),
            "checkpoints": self.checkpoints,
            "policies": {name: self._policy_json(name) for name in self.outcomes},
            "outcomes": {**self.earlier, **self.outcomes},
        }

    def _policy_json(self, name: str) -> dict[str, Any]:
        estimate = self.estimate(name)
        return {
            "imagined": self.imagined(name).as_json(),
            "estimate": estimate and estimate._asdict(),
            "real": self.references[name].as_json() if name in self.references else None,
            "refused": self.refusal(name),
        }

    def __str__(self) -> str:
        width = max(map(len, self.outcomes))
        rows = [f"{name:<{width}}  {self._row(name)}" for name in self.outcomes]
        return "\n".join([confusion_sentence(self.confusion), *self.warnings, self._basis(), "", *rows])

    def _row(self, name: str) -> str:
        imagined = self.imagined(name)
        row = f"{100 * imagined.share:.0f} % ({imagined.k} of {imagined.n}) in imagination"
        if name in self.references:
            row = f"{row}, {100 * self.references[name].share:.0f} % in reality"
        if reason := self.refusal(name):
            return f"{row}; not judged: {reason}"
        estimate = self.estimate(name)
        return f"{row}; estimate: {estimate}" if estimate else row

    def _basis(self) -> str:
        """Say what the intervals rest on."""
        share, usable = f"{100 * self.coverage:.3g} %", len(self.usable_references)
        if any(self.calibrated(name) for name in self.outcomes):
            return (
                f"Estimates and their intervals of {share} are by a line through {usable} references; they "
                "hold for policies that could have been among these."
            )
        few = f" {usable} references are too few to do without that." if self.references else ""
        return (
            f"The intervals of {share} hold if the world model errs about these policies as it does about "
            f"the rollouts.{few}"
        )


def confusion_sentence(confusion: Confusion) -> str:
    """Say what the world model makes of the rollouts."""
    return (
        f"Of the rollouts' successes the world model predicts {confusion.recall} as successes, of their "
        f"failures {confusion.false_positives}."
    )


def confusion_json(confusion: Confusion) -> dict[str, Any]:
    """Return the world model's confusion, in the names of metrics.json."""
    return {
        "recall": confusion.recall.as_json(),
        "false_positive_rate": confusion.false_positives.as_json(),
    }

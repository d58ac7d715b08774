"""The world model as an evaluator of policies: success in imagination beside success in an environment."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.stats import pearsonr

from lerobot_wmrl.common.checkpoints import step_folders
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.statistics import Proportion

MIN_POLICIES = 3
"""Policies that a correlation needs."""


def policy_checkpoints(paths: Sequence[str]) -> list[Path]:
    """List the checkpoints among `paths`, and every checkpoint of the trainings among them in order of steps.

    Raises:
        FieldError: there is none.
    """
    checkpoints = [each for path in map(Path, paths) for each in step_folders(path) or [path]]
    if not checkpoints:
        raise FieldError("policies", list(paths), "none", "give checkpoints, or output folders of trainings")
    return checkpoints


@dataclass(frozen=True)
class Agreement:
    """Success of each policy by name: in the world model, and in the environment `real_env`."""

    policies: Mapping[str, tuple[Proportion, Proportion]]

    @classmethod
    def of_outcomes(cls, outcomes: Mapping[str, tuple[Sequence[bool], Sequence[bool]]]) -> "Agreement":
        """Count successes from the outcomes of each policy's episodes in both environments."""

        def share(successes: Sequence[bool]) -> Proportion:
            return Proportion.of(successes)

        return cls({name: (share(imagined), share(real)) for name, (imagined, real) in outcomes.items()})

    def correlation(self) -> tuple[float, float, float]:
        """Return Pearson's r over policies with its 95 % interval (Fisher's); NaN where it is not defined."""
        imagined, real = ([pair[side].share for pair in self.policies.values()] for side in (0, 1))
        if len(self.policies) < MIN_POLICIES or len(set(imagined)) == 1 or len(set(real)) == 1:
            return (math.nan,) * 3
        correlation = pearsonr(imagined, real)
        interval = correlation.confidence_interval(0.95)
        return float(correlation.statistic), float(interval.low), float(interval.high)

    def as_json(self) -> dict[str, Any]:
        """R² is the square of Pearson's r: the share of the variance that a straight line explains."""
        r, low, high = (None if math.isnan(value) else value for value in self.correlation())
        return {
            "policies": {
                name: {"imagined": imagined.as_json(), "real": real.as_json()}
                for name, (imagined, real) in self.policies.items()
            },
            "pearson": {"value": r, "fisher_95": [low, high]},
            "r_squared": None if r is None else r * r,
        }

"""The world model as an evaluator of policies: does what succeeds in it succeed in reality?"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from scipy.stats import pearsonr

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.evaluation.tables import markdown_table

FEWEST = 3
"""Policies, of which a correlation says something."""


@dataclass(frozen=True)
class Agreement:
    """Success of each policy in imagination and in reality, (imagined, real) by name."""

    policies: Mapping[str, tuple[Proportion, Proportion]]

    @classmethod
    def of(cls, outcomes: Mapping[str, tuple[Sequence[bool], Sequence[bool]]]) -> "Agreement":
        """From every policy's episodes, imagined ones and real ones."""

        def share(successes: Sequence[bool]) -> Proportion:
            return Proportion(sum(successes), len(successes))

        return cls({name: (share(imagined), share(real)) for name, (imagined, real) in outcomes.items()})

    def correlation(self) -> tuple[float, float, float]:
        """Pearson's r over policies with its 95 % interval (Fisher's); NaN where it is not defined."""
        imagined, real = ([pair[side].share for pair in self.policies.values()] for side in (0, 1))
        if len(self.policies) < FEWEST or len(set(imagined)) == 1 or len(set(real)) == 1:
            return (math.nan,) * 3
        found = pearsonr(imagined, real)
        interval = found.confidence_interval(0.95)
        return float(found.statistic), float(interval.low), float(interval.high)

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

    def table(self) -> str:
        """In Markdown."""
        rows = [[name, str(imagined), str(real)] for name, (imagined, real) in self.policies.items()]
        r, low, high = self.correlation()
        verdict = f"Pearson {r:.2f} ({low:.2f} to {high:.2f}), R² {r * r:.2f}"
        if math.isnan(r):
            verdict = f"No correlation: it takes {FEWEST} policies, of which some succeed more often."
        return f"{markdown_table(['policy', 'imagined success', 'real success'], rows)}\n\n{verdict}"

    def draw(self, path: Path) -> None:
        """A point a policy, with Wilson intervals, beside the diagonal."""
        figure = Figure(figsize=(4.2, 4), layout="constrained")
        axes = figure.subplots()
        axes.plot((0, 1), (0, 1), color="#999", linewidth=1, linestyle="--")
        for imagined, real in self.policies.values():
            x, y = ([[abs(each.share - bound)] for bound in each.interval] for each in (imagined, real))
            axes.errorbar(imagined.share, real.share, y, x, color="#2b6cb0", marker="o", capsize=2)
        axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="success in the world model", ylabel="success in reality")
        figure.savefig(path, dpi=130)

"""What a world model says about policies, beside what they do: the section of docs/results.md."""

from collections.abc import Collection, Mapping
from typing import Any, Final

from scipy.stats import kendalltau, pearsonr

from experiments.page.cells import DOMAINS, Load, counted
from experiments.study import ROOT, read_cells
from lerobot_wmrl.common.files import markdown_table as table

FEW: Final = 10
"""Fewer policies than this have no correlation that says anything."""

TOLERATED: Final = 0.15
"""Difference of imagined and real success beyond which a world model is wrong about a scene."""


def section(load: Load) -> str:
    """Return the section of docs/results.md."""
    (study,) = read_cells(ROOT / "experiments" / "judge.yaml")
    cell = study.variables["cell"]
    found = load(f"judge/{cell}")["domains"]
    known = found["ind"]
    starts = [next(iter(each["policies"].values()))["real"]["n"] for each in found.values()]
    rows = [
        [
            DOMAINS[domain],
            title,
            f"{row['n']} ({row['trainings']})",
            *(f"{100 * row[kind]['absolute']:.0f} ({100 * row[kind]['mean']:+.0f})" for kind in ESTIMATES),
            *("–" if row["n"] < FEW else f"{row[name]:.2f}" for name in ("pearson", "kendall")),
            *(f"{row[name]['k']} of {row[name]['n']}" for name in ("by_rollouts", "by_references")),
            f"{100 * row['width']:.0f}",
        ]
        for domain, each in found.items()
        for title, row in (("no", each["outside"]), ("yes", each["inside"]))
    ]
    unexplained = [each["unexplained"] for each in found.values()]
    known_scenes, unseen_scenes = (each["scenes"].values() for each in found.values())
    outside, counts = known["outside"], [known["recall"], known["false_positive_rate"]]
    again = outside["repeated"]
    return f"""It tells good from bad policies, not similar ones apart, and thinks too well of most. In the
scenes that it has learnt from, imagined success of {outside["n"]} checkpoints that were not trained in it is
{100 * outside["imagined"]["absolute"]:.0f} points off on average; by a line through policies of other
trainings {100 * outside["calibrated"]["absolute"]:.0f}. Real success is measured on {starts[0]} known and
{starts[1]} unseen starts: measuring it again would be {100 * again["absolute"]:.0f} points off, and have a τ
of {again["kendall"]:.2f} (known scenes). {among_good(known["policies"])}

{table(HEAD, rows)}

Differences are absolute, in parentheses with their sign. *Corrected* is by 200 rollouts of one policy in
known scenes, replayed with their actions: of the successes the world model predicts {counted(counts[0])} as
successes, of the failures {counted(counts[1])}. That does not show what it does with a policy that acts on
imagined frames. *Calibrated* is by the line through the policies of all other trainings that were not trained
in the world model (two of these nine, `cloned` and `cloning`, are the same one to its 800th step, so that the
line is a little better than it should be), whose intervals of 90 % are {100 * outside["width"]:.0f} points
wide in known scenes. An interval by rollouts counts if the estimate and the measured rate may be equal.
Without references the command refuses {unexplained[0]} of these policies in known and {unexplained[1]} in
unseen scenes, which succeed in
imagination more often than the rollouts' successes, or less often than their failures. For all of them
together, imagined and real success differ by more than {100 * TOLERATED:.0f} points in
{differing(known_scenes)} known scenes and in {differing(unseen_scenes)} unseen ones.

![Imagined and real success of every policy](results/judge/{cell}.png)"""


def among_good(policies: Mapping[str, Mapping[str, Any]]) -> str:
    """Return how imagined and real success agree among policies that mostly succeed: between these and those
    that hardly do it is easy to tell."""
    rates = [
        (each["imagined"]["share"], each["real"]["share"])
        for each in policies.values()
        if not each["inside"] and each["real"]["share"] > GOOD
    ]
    imagined, real = zip(*rates, strict=True)
    return f"""Among the {len(rates)} of them that succeed in more than half of the starts, Pearson's r is
{pearsonr(imagined, real).statistic:.2f} and Kendall's τ {kendalltau(imagined, real).statistic:.2f}."""


GOOD: Final = 0.5
"""Share of real successes above which a policy counts as good."""

ESTIMATES: Final = ("imagined", "corrected", "calibrated")

HEAD: Final = (
    "scenes",
    "trained in the world model",
    "checkpoints (trainings)",
    *(f"{kind}: points off" for kind in ESTIMATES),
    "Pearson's r",
    "Kendall's τ",
    "intervals by rollouts hold",
    "intervals by references hold",
    "their width (points)",
)


def differing(scenes: Collection[Mapping[str, Any]]) -> str:
    """`2 of 16`: scenes in which imagined and real success differ too much."""
    wrong = [abs(each["imagined"]["share"] - each["real"]["share"]) > TOLERATED for each in scenes]
    return f"{sum(wrong)} of {len(wrong)}"

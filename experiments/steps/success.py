"""Collect success rates: what lerobot-eval left in a study's folder becomes the results in docs/.

Every function takes a finished study and returns JSON content by the stem of its file. Outcomes are kept, one
a start and in the order of the seeds, so that policies can be compared on the same starts later.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import bootstrap

from experiments import figures
from experiments.study import Study
from lerobot_wmrl.common.statistics import PairedChange, Proportion
from lerobot_wmrl.common.tracking import read_metrics

Outcomes = list[bool]
Results = dict[str, dict[str, Any]]

STEPS_AN_ITERATION: Final = 64 * 40
"""Environments times frames of each, in rl_comparison.yaml."""


def outcomes(folder: Path) -> Outcomes:
    """Return the success of every episode in lerobot-eval's `eval_info.json`, in the order of their seeds."""
    info = json.loads((folder / "eval_info.json").read_text())
    return [bool(success) for task in info["per_task"] for success in task["metrics"]["successes"]]


def rate(found: Sequence[bool]) -> dict[str, Any]:
    """Return successes, episodes, share, Wilson's interval, and the outcomes themselves."""
    return {**Proportion.of(found).as_json(), "outcomes": [int(success) for success in found]}


@dataclass(frozen=True)
class MeanChange:
    """The mean change of a success rate over several runs on the same starts, with a 95 % interval."""

    mean: float
    low: float
    high: float
    runs: int
    starts: int

    @classmethod
    def over_runs(cls, before: Sequence[Sequence[bool]], after: Sequence[Sequence[bool]]) -> "MeanChange":
        """Compare the outcomes of R runs on the same E starts, in the same order.

        The runs share their starts, so R·E outcomes are not independent: the bootstrap draws starts (Efron
        1979). The interval does not say how much another seed of the training would differ.
        """
        if len({len(run) for run in (*before, *after)}) != 1:
            raise ValueError("the runs were evaluated on different numbers of starts: they cannot be pooled")
        change = (np.asarray(after, float) - np.asarray(before, float)).mean(0)
        low, high = (float(change.mean()),) * 2
        if change.std() > 0:
            interval = bootstrap((change,), np.mean, method="percentile", rng=0).confidence_interval
            low, high = float(interval.low), float(interval.high)
        return cls(float(change.mean()), low, high, len(before), len(change))

    def __str__(self) -> str:
        points = f"{100 * self.mean:+.1f} points (95 %: {100 * self.low:+.1f} to {100 * self.high:+.1f}"
        return f"{points}; {self.runs} runs on the same {self.starts} starts)"


def mean_change(before: Sequence[Outcomes], after: Sequence[Outcomes]) -> dict[str, Any]:
    """Return the mean change over runs on the same starts; its interval draws starts, not seeds."""
    return asdict(MeanChange.over_runs(before, after))


def rl_comparison(study: Study) -> Results:
    """PPO in the world model beside PPO in ManiSkill, from one cloned policy."""
    iterations: Mapping[str, tuple[int, ...]] = {"imagined": (20, 40, 60), "simulated": (10, 20)}
    cloned = {domain: outcomes(study.folder / f"eval_cloned_{domain}") for domain in ("ind", "ood")}
    runs, changes = {}, {}
    for place, measured in iterations.items():
        runs[place] = [_run(study.folder, place, seed, measured) for seed in study.variables["seeds"]]
        for index, iteration in enumerate(measured):
            found = {"ind": [run["ind"][index]["outcomes"] for run in runs[place]]}
            if iteration == measured[-1]:
                found["ood"] = [run["ood"]["outcomes"] for run in runs[place]]
            changes[f"{place} {iteration}"] = {
                domain: mean_change([cloned[domain]] * len(after), after) for domain, after in found.items()
            }
    results = {
        "episodes": len(cloned["ind"]),
        "cloned": {domain: rate(found) for domain, found in cloned.items()},
        "runs": runs,
        "mean_change": changes,
    }
    figures.draw_comparison(results, study.folder / "rl_comparison.png")
    return {"rl_comparison": results}


def _run(folder: Path, place: str, seed: int, measured: Sequence[int]) -> dict[str, Any]:
    """Return one training's success by step and time, and in unseen scenes."""
    name = f"{place}_{seed}"
    rows = [row for row in read_metrics(folder / name) if "rollout_s" in row]
    seconds = list(accumulate(row["rollout_s"] + row["update_s"] for row in rows))
    return {
        "seed": seed,
        "ind": [
            {
                "env_steps": iteration * STEPS_AN_ITERATION,
                "seconds": seconds[iteration - 1],
                **rate(outcomes(folder / f"eval_{name}_{iteration}_ind")),
            }
            for iteration in measured
        ],
        "ood": rate(outcomes(folder / f"eval_{name}_{measured[-1]}_ood")),
        "success_rate_in_training": [row["success_rate"] for row in rows],
    }


def improvement(folder: Path, policies: Mapping[str, str], domains: Sequence[str]) -> dict[str, Any]:
    """Return every policy's success before and after PPO in imagination, by domain.

    Args:
        folder: holds `eval_cloned_<name>_<domain>`, `eval_imagined_<name>_<domain>`, `imagined_<name>`.
        policies: name of a policy → what its folders are called behind `cloned_`, with `_`.
        domains: `ind`, `ood`, …
    """
    found = {}
    for domain in domains:
        before, after = (
            [outcomes(folder / f"eval_{kind}{suffix}_{domain}") for suffix in policies.values()]
            for kind in ("cloned", "imagined")
        )
        rows = {
            name: {
                "cloned": rate(one),
                "trained": rate(other),
                **PairedChange.between(one, other).as_json(),
                "success_rate_in_training": [
                    row["success_rate"]
                    for row in read_metrics(folder / f"imagined{suffix}")
                    if "success_rate" in row
                ],
            }
            for (name, suffix), one, other in zip(policies.items(), before, after, strict=True)
        }
        found[domain] = {"policies": rows, "mean_change": mean_change(before, after)}
    return found


def imagined_ppo(study: Study) -> Results:
    """Policies that are good already."""
    policies = {name: f"_{name}" for name in study.variables["policies"]}
    found = improvement(study.folder, policies, ("ind", "ood"))
    results = {"episodes": study.variables["episodes"], "iterations": 40, "imagined": found}
    figures.draw_improvement(found, study.folder / "imagined_ppo.png")
    return {"imagined_ppo": results}


def openvla_small(study: Study) -> Results:
    """A small OpenVLA, acting by the likeliest tokens (`ind`, `ood`) and by drawn ones."""
    found = improvement(study.folder, {"openvla": ""}, ("ind", "ood", "drawn"))
    results = {"episodes": study.variables["episodes"], "iterations": 60, "imagined": found}
    figures.draw_improvement(found, study.folder / "openvla_small.png")
    return {"openvla_small": results}


def synthetic_data(study: Study) -> Results:
    """Policies cloned from imagined and from simulated successes, beside the policy that had them."""
    found = {
        kind: {domain: outcomes(study.folder / f"eval_{kind}_{domain}") for domain in ("ind", "ood")}
        for kind in ("cloned", "imagined", "simulated")
    }
    rates = {
        kind: {
            domain: {
                **rate(one),
                "from_cloned": PairedChange.between(found["cloned"][domain], one).as_json(),
            }
            for domain, one in domains.items()
        }
        for kind, domains in found.items()
    }
    settings = {name: study.variables[name] for name in ("attempts", "successes", "exploration", "episodes")}
    return {"synthetic_data": {**settings, **rates}}


def planning(study: Study) -> Results:
    """Success of `wm_mpc`."""
    return {
        "planning": {domain: rate(outcomes(study.folder / f"eval_{domain}")) for domain in ("ind", "ood")}
    }


def policies(study: Study) -> Results:
    """Success of policies in the world model and in ManiSkill."""
    found = json.loads((study.folder / "agreement" / "metrics.json").read_text())["policies"]
    place = next(name for row in found["policies"].values() for name in row if name != "imagined")
    found["policies"] = {
        name: {"imagined": row["imagined"], "maniskill": row[place]}
        for name, row in found["policies"].items()
    }
    return {"policies": found}


def demo(study: Study) -> Results:
    """Return the summary that each run of the demo wrote."""
    folders = [study.folder / f"demo_{seed}" for seed in study.variables["seeds"]]
    return {"demo": {"runs": [json.loads((folder / "summary.json").read_text()) for folder in folders]}}


def cloning_control(study: Study) -> Results:
    """The demo's policy cloned from more and better demonstrations."""
    return {
        "cloning_control": {
            "cloned_from": {
                str(count): {
                    domain: rate(outcomes(study.folder / f"eval_{count}_{domain}"))
                    for domain in ("ind", "ood")
                }
                for count in study.variables["counts"]
            }
        }
    }

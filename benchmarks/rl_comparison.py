"""A policy cloned from eight demonstrations, improved by PPO in the world model and by PPO in ManiSkill.

    python benchmarks/gate.py --output_dir=outputs/gate
    python benchmarks/rl_comparison.py --gate=outputs/gate --output_dir=outputs/rl_comparison

Three seeds each, on one thread: in ManiSkill for 20 iterations, in imagination for as many and then on, to
60. Checkpoints are measured on the same starts in ManiSkill, against steps and against the time that the
training took; the last one also in scenes that are held out from all training. The same call again
continues, and `--places` takes one kind of training alone, so that two calls can share a machine. Writes
docs/results/rl_comparison.json and a picture beside it. Flags of lerobot-wmrl-train may follow.
"""

import argparse
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any, Final

import numpy as np
from lerobot.common.train_utils import get_step_checkpoint_dir
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from lerobot.utils.import_utils import register_third_party_plugins
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import gate
import imagined_ppo
from imagined_ppo import DOMAINS, ENVS, HORIZON, TITLES
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.presets import Flags, format_flags
from lerobot_wmrl.common.statistics import MeanChange, Proportion
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.demo.pipeline import run_stages
from lerobot_wmrl.demo.report.figures import COLOURS, tidy
from lerobot_wmrl.demo.report.sources import outcomes
from lerobot_wmrl.demo.stages import Stage, checkpoint
from lerobot_wmrl.evaluation.report import markdown_table

RESULTS: Final = Path(__file__).parents[1] / "docs" / "results" / "rl_comparison.json"
PLACES: Final = ("imagined", "simulated")

POLICY: Final = "few"
DEMONSTRATIONS, CLONING_STEPS = range(60, 68), 250
"""So few that the policy fails often: there is something to learn. The world model has not seen it act."""

COMPARED: Final = {
    "imagined, as many steps": ("imagined", 20),
    "imagined, twice as many": ("imagined", 40),
    "imagined, to the end": ("imagined", 60),
    "simulated": ("simulated", 20),
}
"""Training and iteration."""

PENALTY: Final = 0.02
"""Weight of the distance from the cloned policy, in both places; the default of 0.1 holds it too near."""

STARTS: Final = 1024
"""Episodes whose first frames are imagined on."""

SEEDS_APART: Final = 100_000
"""Trainings of neighbouring seeds would have starts and noise in common."""

MEASURED: Final = {"imagined": (20, 40, 60), "simulated": (10, 20)}
"""Iterations after which a training is measured, ENVS · HORIZON steps each; the last is its end."""

SIMULATORS: Final = 1
"""A process more would be a core more than imagination has."""


class Comparison:
    """The commands of the experiment.

    Args:
        gate: of the world model and the demonstrations.
        ppo: how policies are trained and measured.
    """

    def __init__(self, gate: gate.Experiment, ppo: imagined_ppo.Experiment, seeds: Sequence[int]) -> None:
        self.gate, self.ppo, self.seeds = gate, ppo, seeds

    def stages(self, places: Sequence[str]) -> list[Stage]:
        """In order: the cloned policy, then one training after the other, each with its measurements."""
        clone = partial(self.gate.clone, POLICY, DEMONSTRATIONS, CLONING_STEPS)
        stages = [Stage("clone", "clone a policy from few demonstrations", clone)]
        cloned = checkpoint(self.ppo.cloned(POLICY))
        stages += [self._measurement(f"cloned_{domain}", cloned, domain) for domain in DOMAINS]
        if "imagined" in places:
            stages.append(Stage("text_world_model", "text world model", self.ppo.train_text_model))
        for seed in self.seeds:
            for place in places:
                stages += self._training(place, seed)
        return stages

    def _training(self, place: str, seed: int) -> list[Stage]:
        name, end = run_name(place, seed), MEASURED[place][-1]
        stages = [Stage(name, f"PPO, {place}, seed {seed}", partial(self.reinforce, place, seed))]
        for iteration in MEASURED[place]:
            policy = get_step_checkpoint_dir(self.ppo.out / name, end, iteration) / PRETRAINED_MODEL_DIR
            stages.append(self._measurement(f"{name}_{iteration}_ind", policy, "ind"))
        return [*stages, self._measurement(f"{name}_{end}_ood", policy, "ood")]

    def _measurement(self, name: str, policy: Path, domain: str) -> Stage:
        make = partial(self.ppo.evaluate, f"eval_{name}", policy, domain)
        return Stage(f"eval_{name}", f"success of {name.replace('_', ' ')}", make)

    def reinforce(self, place: str, seed: int) -> list[str]:
        environment = self._imagination if place == "imagined" else partial(self.ppo.simulator, SIMULATORS)
        flags: Flags = {
            "iterations": MEASURED[place][-1], "save_freq": MEASURED[place][0], "seed": seed * SEEDS_APART,
            "algorithm.reference_coefficient": PENALTY,
        }  # fmt: skip
        command = self.ppo.reinforce(POLICY, run_name(place, seed), environment)
        return [*command, *format_flags(flags)]

    def _imagination(self) -> Flags:
        return {**self.ppo.imagination(), "env.dataset.max_starts": STARTS}

    def found(self, name: str) -> list[bool]:
        """Outcomes of a measurement, one a start."""
        return outcomes(self.ppo.out / f"eval_{name}")

    def finished(self, place: str) -> list[int]:
        """Seeds whose trainings are measured to the end."""
        last = [(seed, f"eval_{run_name(place, seed)}_{MEASURED[place][-1]}_ood") for seed in self.seeds]
        return [seed for seed, name in last if (self.ppo.out / name / "eval_info.json").exists()]

    def results(self) -> dict[str, Any]:
        """Of what is finished: success of the cloned policy and of checkpoints, and the mean changes."""
        return {
            "cloned": {domain: proportion(self.found(f"cloned_{domain}")) for domain in DOMAINS},
            "runs": {place: [self._run(place, seed) for seed in self.finished(place)] for place in PLACES},
            "mean_change": {
                name: {
                    domain: self._change(place, iteration, domain)
                    for domain in DOMAINS
                    if domain == "ind" or iteration == MEASURED[place][-1]
                }
                for name, (place, iteration) in COMPARED.items()
            },
        }

    def _change(self, place: str, iteration: int, domain: str) -> dict[str, Any]:
        """From the cloned policy, on the same starts."""
        cloned = self.found(f"cloned_{domain}")
        after = [self.found(f"{run_name(place, seed)}_{iteration}_{domain}") for seed in self.finished(place)]
        return asdict(MeanChange.over_runs([cloned] * len(after), after))

    def _run(self, place: str, seed: int) -> dict[str, Any]:
        """A training's curve, and its result in unseen scenes."""
        name = run_name(place, seed)
        rows = [row for row in read_metrics(self.ppo.out / name) if "rollout_s" in row]
        seconds = list(accumulate(row["rollout_s"] + row["update_s"] for row in rows))
        curve = [
            {
                "env_steps": iteration * ENVS * HORIZON,
                "seconds": seconds[iteration - 1],
                **proportion(self.found(f"{name}_{iteration}_ind")),
            }
            for iteration in MEASURED[place]
        ]
        return {
            "seed": seed,
            "ind": curve,
            "ood": proportion(self.found(f"{name}_{MEASURED[place][-1]}_ood")),
            "success_rate_in_training": [row["success_rate"] for row in rows],
        }


def run_name(place: str, seed: int) -> str:
    """Of a training."""
    return f"{place}_{seed}"


def proportion(found: Sequence[bool]) -> dict[str, Any]:
    """With its Wilson interval."""
    return Proportion(sum(found), len(found)).as_json()


def results_table(results: Mapping[str, Any]) -> str:
    """A line a training and domain."""
    lines = [_line(results, name, domain) for name in COMPARED for domain in results["mean_change"][name]]
    head = ["training", "scenes", "steps", "time", "cloned", "each seed", "all", "change on the same starts"]
    return markdown_table(head, lines)


def _line(results: Mapping[str, Any], name: str, domain: str) -> list[str]:
    place, iteration = COMPARED[name]
    index, runs = MEASURED[place].index(iteration), results["runs"][place]
    found = [run["ind"][index] if domain == "ind" else run["ood"] for run in runs]
    minutes = np.mean([run["ind"][index]["seconds"] for run in runs]) / 60
    together = Proportion(sum(one["k"] for one in found), sum(one["n"] for one in found))
    before = results["cloned"][domain]
    return [
        name, domain, f"{iteration * ENVS * HORIZON:,}", f"{minutes:.0f} min",
        str(Proportion(before["k"], before["n"])), ", ".join(f"{100 * one['share']:.0f} %" for one in found),
        str(together), str(MeanChange(**results["mean_change"][name][domain])),
    ]  # fmt: skip


def draw(results: Mapping[str, Any], path: Path) -> None:
    """Success in the scenes that the world model knows, against steps and against time."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    draw_curves(panels[0], results, "env_steps", 1e-3)
    panels[0].set_xlabel("thousand steps of the environment")
    draw_curves(panels[1], results, "seconds", 1 / 60)
    panels[1].set_xlabel("minutes on one core")
    panels[0].set_ylabel("success in ManiSkill")
    panels[1].legend(frameon=False, loc="lower right")
    tidy(figure).savefig(path, dpi=130)


def draw_curves(axes: Axes, results: Mapping[str, Any], abscissa: str, unit: float) -> None:
    """A thin line a seed, a thick one for their mean, and the cloned policy with its interval."""
    cloned = results["cloned"]["ind"]
    axes.axhspan(*cloned["wilson_95"], color="#999", alpha=0.2)
    axes.axhline(cloned["share"], color="#666", linestyle="--", label=TITLES["cloned"])
    for colour, place in zip(COLOURS, PLACES, strict=False):
        curves = np.array(
            [
                [(0.0, cloned["share"]), *((point[abscissa] * unit, point["share"]) for point in run["ind"])]
                for run in results["runs"][place]
            ]
        )
        for curve in curves:
            axes.plot(*curve.T, color=colour, alpha=0.35, linewidth=1)
        axes.plot(*curves.mean(0).T, color=colour, marker="o", label=TITLES[place])


def main() -> None:
    """Entry point."""
    os.environ["OMP_NUM_THREADS"] = "1"
    register_third_party_plugins()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gate", type=Path, default=Path("outputs/gate"), help="output folder of gate.py")
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/rl_comparison"))
    parser.add_argument("--places", nargs="+", default=PLACES, choices=PLACES)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--episodes", type=int, default=300, help="of each success rate")
    parser.add_argument("--output", type=Path, default=RESULTS, help="JSON file")
    given, flags = parser.parse_known_args()
    iterations = max(measured[-1] for measured in MEASURED.values())
    ppo = imagined_ppo.Experiment(
        given.gate, given.output_dir, [POLICY], given.episodes, iterations, True, flags
    )
    comparison = Comparison(gate.Experiment(given.gate), ppo, given.seeds)
    run_stages(comparison.stages(given.places), given.output_dir)
    if not all(comparison.finished(place) for place in PLACES):
        return
    results = {"episodes": given.episodes, **comparison.results()}
    write_json(given.output, results)
    draw(results, given.output.with_suffix(".png"))
    print(results_table(results))


if __name__ == "__main__":
    main()

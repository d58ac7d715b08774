"""Does PPO inside the world model of gate.py raise success in the simulator, in and out of domain?

    python benchmarks/gate.py --output_dir=outputs/gate
    python benchmarks/imagined_ppo.py --gate=outputs/gate --output_dir=outputs/imagined_ppo

Cloned policies are improved by PPO in the imagination of the action world model that the gate was asked of,
and measured before and after on the same starts in ManiSkill: in the three scenes that the world model knows,
and in those held out from all training. With --rival=true the same policies also get PPO in ManiSkill, of as
many steps. The same call again continues. Writes docs/results/imagined_ppo.json and a picture beside it.
Flags of lerobot-wmrl-train may follow.
"""

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

from lerobot.utils.import_utils import register_third_party_plugins
from matplotlib.figure import Figure

from gate import IMAGE_SIZE, SCENES, UNSEEN_SCENES
from lerobot_wmrl.common.constants import EVALUATION_SEED
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.presets import Flags, format_flags, preset_flags
from lerobot_wmrl.common.statistics import MeanChange, PairedChange, Proportion
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.demo.pipeline import run_stages
from lerobot_wmrl.demo.report.figures import COLOURS, tidy
from lerobot_wmrl.demo.report.sources import outcomes
from lerobot_wmrl.demo.stages import Stage, checkpoint
from lerobot_wmrl.evaluation.report import markdown_table

RESULTS: Final = Path(__file__).parents[1] / "docs" / "results" / "imagined_ppo.json"

POLICY_CAMERA: Final = "[side_view]"
"""What gate.py's policies were cloned with; the world model imagines the other view too."""

ENVS, HORIZON = 64, 40
"""Imaginations at once, and frames of each an iteration."""

PROCESSES: Final = 2
"""Simulators at once, for PPO in ManiSkill."""

NEARNESS: Final[Flags] = {"algorithm.reference_coefficient": 0.1, "env.dataset.max_starts": 256}
"""As docs/ has this experiment; rl_comparison.py gains more with a weaker penalty and more starts."""

DOMAINS: Final[dict[str, Flags]] = {"ind": SCENES, "ood": UNSEEN_SCENES}
SHOWN: Final = {"unseen": "new policy"}
PANELS: Final = {
    "ind": "scenes the world model knows", "ood": "unseen scenes", "drawn": "known scenes, tokens drawn",
}  # fmt: skip
TITLES: Final = {"cloned": "cloned", "imagined": "PPO in imagination", "simulated": "PPO in ManiSkill"}


class Experiment:
    """The commands of the experiment.

    Args:
        gate: output folder of a finished gate.py. out: of this experiment.
        policies: names of gate.py's cloned ones.
        episodes: of each success rate.
        rival: whether there is PPO in ManiSkill too.
        flags: further ones of lerobot-wmrl-train.
    """

    domains: Mapping[str, Flags] = DOMAINS

    def __init__(
        self, gate: Path, out: Path, policies: Sequence[str], episodes: int, iterations: int, rival: bool,
        flags: Sequence[str],
    ) -> None:  # fmt: skip
        self.gate, self.out, self.policies, self.episodes = gate, out, policies, episodes
        self.iterations, self.flags = iterations, flags
        self.text_model = out / "text_world_model"
        self.trainings = {"imagined": self.imagination, **({"simulated": self.simulator} if rival else {})}

    def stages(self) -> list[Stage]:
        """In order: whole policies one after the other, so that the first results come early."""
        stages = [self._stage("text_world_model", self.train_text_model)]
        return stages + [stage for policy in self.policies for stage in self.improvement(policy)]

    def improvement(self, policy: str) -> list[Stage]:
        """A cloned policy is measured, then trained and measured again."""
        stages = self._measured(policy, "cloned", self.cloned(policy))
        for place, environment in self.trainings.items():
            name = f"{place}_{policy}"
            stages.append(self._stage(name, self.reinforce, policy, name, environment))
            stages += self._measured(policy, place, self.out / name)
        return stages

    def cloned(self, policy: str) -> Path:
        """The output folder of its training."""
        return self.gate / f"policy_{policy}"

    def _measured(self, policy: str, kind: str, folder: Path) -> list[Stage]:
        names = {domain: f"eval_{kind}_{policy}_{domain}" for domain in self.domains}
        trained = checkpoint(folder)
        return [self._stage(name, self.evaluate, name, trained, domain) for domain, name in names.items()]

    def _stage(self, name: str, make: Callable[..., list[str]], *arguments: Any) -> Stage:
        return Stage(name, name.replace("_", " "), partial(make, *arguments))

    def train_text_model(self) -> list[str]:
        """It is needed for the goal frames of the dense reward."""
        flags: Flags = {
            "model.type": "text_world_model", "model.tokenizer_path": str(self.gate / "frame_tokenizer"),
            "dataset.root": str(self.gate / "dataset"), "output_dir": str(self.text_model),
        }  # fmt: skip
        return ["lerobot-wmrl-train-world-model", "--preset=demo", *format_flags(flags)]

    def judgement(self) -> Flags:
        """Success is judged where the gate found the greatest distance between the share of successes that
        are recognised and that of failures that are believed."""

        def distance(gate: Mapping[str, Any]) -> float:
            return gate["recall"]["share"] - gate["false_positive_rate"]["share"]

        sweep = json.loads((self.gate / "check" / "metrics.json").read_text())["gate_sweep"]
        best = max(sweep, key=distance)
        return {f"env.{name}": best[name] for name in ("done_threshold", "done_frames")}

    def imagination(self) -> Flags:
        return {
            "num_envs": ENVS, "rollout_steps": HORIZON, "env.type": "world_model",
            "env.world_model_path": str(self.gate / "action_world_model"),
            "env.text_world_model_path": str(self.text_model),
            "env.dataset.root": str(self.gate / "dataset"), "env.episode_length": HORIZON,
            "gate.dataset.root": str(self.gate / "rollouts"), **self.judgement(), **NEARNESS,
        }  # fmt: skip

    def simulator(self, processes: int = PROCESSES) -> Flags:
        return {
            "num_envs": processes, "rollout_steps": ENVS * HORIZON // processes,
            **self.maniskill(SCENES), "env.episode_length": HORIZON,
            "algorithm.reference_coefficient": NEARNESS["algorithm.reference_coefficient"],
        }  # fmt: skip

    def reinforce(self, policy: str, name: str, environment: Callable[[], Flags]) -> list[str]:
        flags: Flags = {
            "policy.path": str(checkpoint(self.cloned(policy))), **environment(),
            "algorithm.type": "ppo", "iterations": self.iterations, "output_dir": str(self.out / name),
        }  # fmt: skip
        return ["lerobot-wmrl-train", "--preset=demo", *format_flags(flags), *self.flags]

    def evaluate(self, name: str, policy: Path, domain: str) -> list[str]:
        flags: Flags = {
            "policy.path": str(policy), **self.maniskill(self.domains[domain]),
            "eval.n_episodes": self.episodes, "seed": EVALUATION_SEED, "output_dir": str(self.out / name),
        }  # fmt: skip
        return ["lerobot-eval", *preset_flags("demo", "eval"), *format_flags(flags)]

    def maniskill(self, scenes: Flags) -> Flags:
        """The simulator, as gate.py's policies see it."""
        return {
            "env.type": "wmrl_maniskill", "env.task": "push", **scenes, "env.image_size": IMAGE_SIZE,
            "env.cameras": POLICY_CAMERA,
        }  # fmt: skip

    def results(self) -> dict[str, Any]:
        """Of each training and domain every policy's rates and paired change, and the mean change."""
        return {
            place: {domain: self._change(place, domain) for domain in self.domains}
            for place in self.trainings
        }

    def _change(self, place: str, domain: str) -> dict[str, Any]:
        before, after = (
            [outcomes(self.out / f"eval_{kind}_{policy}_{domain}") for policy in self.policies]
            for kind in ("cloned", place)
        )
        rows = {
            policy: {
                "cloned": Proportion(sum(one), len(one)).as_json(),
                "trained": Proportion(sum(other), len(other)).as_json(),
                **PairedChange.between(one, other).as_json(),
                "success_rate_in_training": [
                    row["success_rate"]
                    for row in read_metrics(self.out / f"{place}_{policy}")
                    if "success_rate" in row
                ],
            }
            for policy, one, other in zip(self.policies, before, after, strict=True)
        }
        return {"policies": rows, "mean_change": asdict(MeanChange.over_runs(before, after))}


def results_table(results: Mapping[str, Any]) -> str:
    """A line a training, domain and policy."""
    lines = []
    for (place, domain), policy in ((key, p) for key, found in _changes(results) for p in found["policies"]):
        row = results[place][domain]["policies"][policy]
        shares = [f"{100 * row[kind]['share']:.0f} %" for kind in ("cloned", "trained")]
        change = PairedChange(row["gained"], row["lost"])
        lines.append([TITLES[place], domain, policy, *shares, str(change)])
    means = [
        f"{TITLES[place]}, {domain}: {MeanChange(**found['mean_change'])}"
        for (place, domain), found in _changes(results)
    ]
    table = markdown_table(["training", "domain", "policy", "cloned", "trained", "on the same starts"], lines)
    return "\n".join([table, "", *means])


def _changes(results: Mapping[str, Any]) -> list[tuple[tuple[str, str], Any]]:
    return [((place, domain), results[place][domain]) for place in results for domain in results[place]]


def draw(results: Mapping[str, Any], path: Path) -> None:
    """A panel a domain: every policy's success before and after, with Wilson intervals."""
    domains = list(results["imagined"])
    figure = Figure(figsize=(4 * len(domains), 3.2), layout="constrained")
    panels = figure.subplots(1, len(domains), sharey=True)
    for axes, domain in zip(panels, domains, strict=True):
        shown = {"cloned": results["imagined"][domain], **{p: results[p][domain] for p in results}}
        for offset, (kind, found) in enumerate(shown.items()):
            column = "cloned" if kind == "cloned" else "trained"
            rates = [Proportion(row[column]["k"], row[column]["n"]) for row in found["policies"].values()]
            places = [place + 0.25 * offset for place in range(len(rates))]
            spread = [[abs(rate.share - rate.interval[side]) for rate in rates] for side in (0, 1)]
            axes.bar(
                places, [rate.share for rate in rates], 0.22, yerr=spread, color=COLOURS[offset],
                label=TITLES[kind] if axes is panels[-1] else None, capsize=3,
            )  # fmt: skip
        names = [SHOWN.get(name, f"policy {name}") for name in shown["cloned"]["policies"]]
        axes.set_xticks([place + 0.125 * (len(shown) - 1) for place in range(len(names))], names)
        axes.set_title(PANELS[domain])
        axes.set_ylim(0, 1.2)
    panels[0].set_ylabel("success in ManiSkill")
    tidy(figure).savefig(path, dpi=130)


def main() -> None:
    """Entry point."""
    register_third_party_plugins()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gate", type=Path, default=Path("outputs/gate"), help="output folder of gate.py")
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/imagined_ppo"))
    parser.add_argument("--policies", nargs="+", default=["A", "B", "C", "unseen"])
    parser.add_argument("--episodes", type=int, default=200, help="of each success rate")
    parser.add_argument("--iterations", type=int, default=40)
    parser.add_argument("--rival", default="false", choices=("true", "false"), help="PPO in ManiSkill too")
    parser.add_argument("--output", type=Path, default=RESULTS, help="JSON file")
    given, flags = parser.parse_known_args()
    experiment = Experiment(
        given.gate, given.output_dir, given.policies, given.episodes, given.iterations,
        given.rival == "true", flags,
    )  # fmt: skip
    run_stages(experiment.stages(), given.output_dir)
    results = experiment.results()
    write_json(given.output, {"episodes": given.episodes, "iterations": given.iterations, **results})
    draw(results, given.output.with_suffix(".png"))
    print(results_table(results))


if __name__ == "__main__":
    main()

"""Does cloning help, from what a policy did in the world model? The same from what it did in ManiSkill.

    python benchmarks/gate.py --output_dir=outputs/gate
    python benchmarks/rl_comparison.py --gate=outputs/gate --output_dir=outputs/rl_comparison
    python benchmarks/synthetic_data.py --gate=outputs/gate --output_dir=outputs/synthetic_data

The policy that rl_comparison.py clones from eight demonstrations acts, noisy, in imagination, which is
written as a dataset, and in the simulator. A new policy is cloned from as many successes of either. All three
are measured on the same starts in ManiSkill. The same call again continues. Writes
docs/results/synthetic_data.json.
"""

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from lerobot.utils.import_utils import register_third_party_plugins

import gate
import imagined_ppo
from imagined_ppo import DOMAINS, HORIZON
from lerobot_wmrl.common.checkpoints import LAST_CHECKPOINT
from lerobot_wmrl.common.constants import STATE_NAMES
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.presets import Flags, format_flags, preset_flags
from lerobot_wmrl.common.statistics import PairedChange, Proportion
from lerobot_wmrl.data.recorded_episodes import recorded_episodes
from lerobot_wmrl.demo.pipeline import run_stages
from lerobot_wmrl.demo.report.sources import outcomes
from lerobot_wmrl.demo.stages import Stage, checkpoint, lerobot_train
from lerobot_wmrl.evaluation.report import markdown_table
from rl_comparison import POLICY

RESULTS: Final = Path(__file__).parents[1] / "docs" / "results" / "synthetic_data.json"
SEED: Final = 600_000
"""Of both recordings: neither the world model's training nor any success rate has these."""

SEEN: Final = (
    f"{{observation.state: {{type: STATE, shape: [{len(STATE_NAMES)}]}}, "
    f"observation.images.side_view: {{type: VISUAL, shape: [3, {gate.IMAGE_SIZE}, {gate.IMAGE_SIZE}]}}}}"
)
"""Inputs of gate.py's policies. What is imagined shows another view too."""

KINDS: Final = {"cloned": "demonstrations", "imagined": "imagined successes", "simulated": "real successes"}


class Experiment:
    """The commands of the experiment.

    Args:
        ppo: where the cloned policy is, what is imagined, and how success is measured.
        attempts: episodes that are recorded in either place.
        successes: of them, that a policy is cloned from. steps: of that.
        exploration: noise on the policy's actions, as a share of the action box.
    """

    def __init__(
        self, ppo: imagined_ppo.Experiment, attempts: int, successes: int, steps: int, exploration: float
    ) -> None:
        self.ppo, self.out = ppo, ppo.out
        self.attempts, self.successes, self.steps, self.exploration = attempts, successes, steps, exploration

    def stages(self) -> list[Stage]:
        """In order."""
        stages = self._measured("cloned", self.ppo.cloned(POLICY))
        for place, environment in {"imagined": self.imagination, "simulated": self.simulator}.items():
            stages += [
                self._stage(f"attempts_{place}", self.record, place, environment),
                self._stage(f"policy_{place}", self.clone, place),
                *self._measured(place, self.out / f"policy_{place}"),
            ]
        return stages

    def _stage(self, name: str, make: Callable[..., list[str]], *arguments: Any) -> Stage:
        return Stage(name, name.replace("_", " "), partial(make, *arguments))

    def _measured(self, kind: str, folder: Path) -> list[Stage]:
        names = {domain: f"eval_{kind}_{domain}" for domain in DOMAINS}
        return [
            self._stage(name, self.ppo.evaluate, name, checkpoint(folder), domain)
            for domain, name in names.items()
        ]

    def imagination(self) -> Flags:
        """Rewards matter to nobody here, so that no goal is imagined."""
        return {
            "env.type": "world_model", "env.world_model_path": str(self.ppo.gate / "action_world_model"),
            "env.dataset.root": str(self.ppo.gate / "dataset"), "env.reward.type": "general",
            "env.reward.alpha": 1, **self.ppo.judgement(),
        }  # fmt: skip

    def simulator(self) -> Flags:
        return self.ppo.maniskill(gate.SCENES)

    def record(self, place: str, environment: Callable[[], Flags]) -> list[str]:
        flags: Flags = {
            "policy.path": str(checkpoint(self.ppo.cloned(POLICY))), **environment(),
            "env.episode_length": HORIZON, "exploration": self.exploration, "num_episodes": self.attempts,
            "seed": SEED, "depth": False, "output_dir": str(self.out / f"attempts_{place}"),
        }  # fmt: skip
        return ["lerobot-wmrl-record", *format_flags(flags)]

    def clone(self, place: str) -> list[str]:
        """A new policy, that sees what the old one sees."""
        attempts = self.out / f"attempts_{place}"
        table = recorded_episodes(attempts)
        chosen = table["episode"][table["success"]][: self.successes]
        if len(chosen) < self.successes:
            raise ValueError(
                f"{attempts}: {len(chosen)} successes, --successes={self.successes}; raise --attempts"
            )
        flags: Flags = {
            "policy.type": "cnn", "policy.input_features": SEEN, "dataset.repo_id": f"local/{place}",
            "steps": self.steps, "save_freq": self.steps,
        }  # fmt: skip
        given = [*preset_flags("demo", "sft"), *format_flags(flags)]
        return lerobot_train(self.out / f"policy_{place}", attempts, chosen.tolist(), given)

    def results(self) -> dict[str, Any]:
        """Success of each policy in each domain, and what changed on the same starts."""
        found = {
            kind: {domain: outcomes(self.out / f"eval_{kind}_{domain}") for domain in DOMAINS}
            for kind in KINDS
        }
        return {
            kind: {
                domain: {
                    **Proportion(sum(successes), len(successes)).as_json(),
                    "from_cloned": PairedChange.between(found["cloned"][domain], successes).as_json(),
                }
                for domain, successes in measured.items()
            }
            for kind, measured in found.items()
        }


def results_table(results: Mapping[str, Any]) -> str:
    """A line a policy and domain."""
    lines = []
    for kind, title in KINDS.items():
        for domain, row in results[kind].items():
            change = PairedChange(row["from_cloned"]["gained"], row["from_cloned"]["lost"])
            rate = Proportion(row["k"], row["n"])
            lines.append([title, domain, str(rate), "" if kind == "cloned" else str(change)])
    return markdown_table(["cloned from", "domain", "success", "on the same starts"], lines)


def main() -> None:
    """Entry point."""
    register_third_party_plugins()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gate", type=Path, default=Path("outputs/gate"), help="output folder of gate.py")
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/synthetic_data"))
    parser.add_argument("--attempts", type=int, default=400, help="episodes recorded in either place")
    parser.add_argument("--successes", type=int, default=160, help="of them, that a policy is cloned from")
    parser.add_argument("--steps", type=int, default=800, help="of cloning")
    parser.add_argument("--exploration", type=float, default=0.2, help="noise, as a share of the action box")
    parser.add_argument("--episodes", type=int, default=300, help="of each success rate")
    parser.add_argument("--output", type=Path, default=RESULTS, help="JSON file")
    given = parser.parse_args()
    ppo = imagined_ppo.Experiment(given.gate, given.output_dir, [POLICY], given.episodes, 0, False, [])
    if not (ppo.cloned(POLICY) / LAST_CHECKPOINT).exists():
        parser.error(f"--gate={given.gate}: holds no policy_{POLICY}; run rl_comparison.py, which clones it")
    recipe = (given.attempts, given.successes, given.steps, given.exploration)
    experiment = Experiment(ppo, *recipe)
    run_stages(experiment.stages(), given.output_dir)
    results = experiment.results()
    names = ("attempts", "successes", "steps", "exploration", "episodes")
    write_json(given.output, {**{name: getattr(given, name) for name in names}, **results})
    print(results_table(results))


if __name__ == "__main__":
    main()

"""A small OpenVLA from random weights: cloned, adapted by LoRA, improved by PPO with LoRA in a world model.

    python benchmarks/gate.py --output_dir=outputs/gate
    python benchmarks/openvla_small.py --gate=outputs/gate --imagined=outputs/imagined_ppo \\
        --output_dir=outputs/openvla_small

lerobot-train fits all weights to the optimal episodes among gate.py's planned ones, then adapters to other
demonstrations. PPO trains these adapters further in the imagination of gate.py's action world model.
Success is measured before and after, on the same starts in ManiSkill: in the three scenes that the world
model knows, by the likeliest tokens and by drawn ones, and in those held out from all training. The same
call again continues. Without --imagined, the text world model, which imagined_ppo.py leaves behind, is
trained here. Writes docs/results/openvla_small.json and a picture beside it. Flags of lerobot-wmrl-train
may follow.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from lerobot.utils.import_utils import register_third_party_plugins

import imagined_ppo
from gate import SCENES
from imagined_ppo import DOMAINS, HORIZON, draw, results_table
from lerobot_wmrl.common.checkpoints import LAST_CHECKPOINT
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.presets import Flags, format_flags, preset_flags
from lerobot_wmrl.demo.episodes import optimal_episodes
from lerobot_wmrl.demo.pipeline import run_stages
from lerobot_wmrl.demo.stages import Stage, checkpoint, lerobot_train

RESULTS: Final = Path(__file__).parents[1] / "docs" / "results" / "openvla_small.json"
POLICY: Final = "openvla"
CAMERA: Final = "observation.images.side_view"
"""What it sees of planned episodes, which show another view too."""

LORA: Final[Flags] = {"peft.method_type": "LORA", "peft.r": 32, "peft.lora_alpha": 16}
"""Rank and scale of RL4VLA (Liu et al. 2025), which PPO keeps: it trains the same adapters."""

REINFORCEMENT: Final[Flags] = {
    "num_envs": 64, "rollout_steps": HORIZON, "algorithm.initial_std": "null",
    "algorithm.minibatch_size": 512, "algorithm.micro_batch_size": 64, "algorithm.policy_lr": 2e-4,
    "algorithm.value_lr": 3e-3, "algorithm.value_iterations": 3, "algorithm.reference_coefficient": 0.02,
    "env.dataset.max_starts": 1024,
}  # fmt: skip
"""A categorical explores by itself; at this rate small minibatches reach `target_kl` too soon."""


class Experiment(imagined_ppo.Experiment):
    """The commands of the experiment: imagined_ppo.py's, on a policy of its own.

    Args:
        gate: output folder of a finished gate.py. out: of this experiment.
        imagined: that of imagined_ppo.py, whose text world model is used, if there is one.
        demonstrations: optimal episodes that all weights learn from, and others for the adapters.
        steps: of both trainings.
        episodes: of each success rate.
        flags: further ones of lerobot-wmrl-train.
    """

    domains = {**DOMAINS, "drawn": {**SCENES, "policy.sampling": True}}  # noqa: RUF012

    def __init__(
        self, gate: Path, out: Path, imagined: Path | None, demonstrations: tuple[int, int],
        steps: tuple[int, int], episodes: int, iterations: int, flags: Sequence[str],
    ) -> None:  # fmt: skip
        flags = [*format_flags(REINFORCEMENT), *flags]
        super().__init__(gate, out, [POLICY], episodes, iterations, False, flags)
        self.imagined, self.demonstrations, self.steps = imagined, demonstrations, steps
        if imagined is not None:
            self.text_model = imagined / "text_world_model"

    def stages(self) -> list[Stage]:
        """In order: LoRA adapts what was fitted before, and the rest is as for any cloned policy."""
        stages = [self._stage("pretrained", self.fit), self._stage("adapted", self.adapt)]
        if self.imagined is None:
            stages.append(self._stage("text_world_model", self.train_text_model))
        return stages + self.improvement(POLICY)

    def cloned(self, policy: str) -> Path:
        """That of LoRA."""
        return self.out / "adapted"

    def fit(self) -> list[str]:
        """All weights, to planned episodes."""
        episodes = optimal_episodes(self.gate / "planned", self.demonstrations[0])
        flags: Flags = {"policy.camera": CAMERA, "dataset.repo_id": "local/planned", "steps": self.steps[0]}
        given = [*preset_flags("demo", "sft", ["openvla"]), *format_flags(flags)]
        return lerobot_train(self.out / "pretrained", self.gate / "planned", episodes, given)

    def adapt(self) -> list[str]:
        """Adapters alone, to what other planners' seeds have shown."""
        episodes = optimal_episodes(self.gate / "good", self.demonstrations[1])
        flags: Flags = {
            "policy.path": str(checkpoint(self.out / "pretrained")), **LORA,
            "dataset.repo_id": "local/good", "steps": self.steps[1], "save_freq": self.steps[1],
        }  # fmt: skip
        given = [*preset_flags("demo", "sft"), *format_flags(flags)]
        return lerobot_train(self.cloned(POLICY), self.gate / "good", episodes, given)


def parse() -> tuple[argparse.Namespace, list[str]]:
    """→ this benchmark's arguments, and lerobot-wmrl-train's"""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gate", type=Path, default=Path("outputs/gate"), help="output folder of gate.py")
    parser.add_argument("--imagined", type=Path, help="output folder of imagined_ppo.py")
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/openvla_small"))
    parser.add_argument(
        "--demonstrations", type=int, nargs=2, default=[320, 60], help="for all weights, for the adapters"
    )
    parser.add_argument("--steps", type=int, nargs=2, default=[4000, 400], help="of these two trainings")
    parser.add_argument("--episodes", type=int, default=200, help="of each success rate")
    parser.add_argument("--iterations", type=int, default=60, help="of PPO")
    parser.add_argument("--output", type=Path, default=RESULTS, help="JSON file")
    given, flags = parser.parse_known_args()
    if given.imagined and not (given.imagined / "text_world_model" / LAST_CHECKPOINT).exists():
        parser.error(f"--imagined={given.imagined}: holds no text_world_model; leave it out to train one")
    return given, flags


def main() -> None:
    """Entry point."""
    register_third_party_plugins()
    given, flags = parse()
    experiment = Experiment(
        given.gate, given.output_dir, given.imagined, tuple(given.demonstrations), tuple(given.steps),
        given.episodes, given.iterations, flags,
    )  # fmt: skip
    run_stages(experiment.stages(), given.output_dir)
    results = experiment.results()
    settings = {name: getattr(given, name) for name in ("episodes", "iterations", "steps", "demonstrations")}
    write_json(given.output, {**settings, **results})
    draw(results, given.output.with_suffix(".png"))
    print(results_table(results))


if __name__ == "__main__":
    main()

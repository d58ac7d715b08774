"""What each option of the action world model is worth: variants trained alike, measured on the same episodes.

    python benchmarks/world_model_ablation.py --dataset.root=outputs/push --rollouts=outputs/rollouts \\
        --variants none keypoints self_rollout --preset=demo --output_dir=outputs/ablation

All variants have the same tokenizer, data, steps and seed, and differ by the flags in `VARIANTS`. They are
replayed open loop on the episodes held out from training, and on `--rollouts`, real episodes of policies, for
the gate. A variant that is trained, or trained and measured, is not trained or measured again. Prints a table
and writes docs/results/world_model_ablation.json.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import draccus
import numpy as np
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_wmrl.common.command_line import CONFIG_FILE
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.malloc import keep_freed_memory
from lerobot_wmrl.common.presets import Flags, format_flags, preset_flags
from lerobot_wmrl.common.statistics import Estimate
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.episode_table import choose_episodes, open_dataset, read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames
from lerobot_wmrl.evaluation.accuracy import EpisodeAccuracy, headline
from lerobot_wmrl.evaluation.gate import done_accuracy, success_gate
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.evaluation.report import TITLES, evaluate, markdown_table
from lerobot_wmrl.maniskill.scenes import scenes_of
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig, train_world_model
from lerobot_wmrl.world_models.checkpoint import load_model

RESULTS: Final = Path(__file__).parents[1] / "docs" / "results" / "world_model_ablation.json"

NONE: Final[Flags] = {
    "model.dynamics": "autoregressive", "model.width": 128, "model.clip_length": 40, "model.from_start": 0.75,
    "batch_size": 2,
}  # fmt: skip
"""RoboScape's network without its options. Sixteen clips a step would take it eight times as long."""

VARIANTS: Final[dict[str, Flags]] = {
    "none": NONE,
    "keypoints": {**NONE, "model.keypoint_weight": 1.0},
    "depth": {**NONE, "model.depth": True},
    "both": {**NONE, "model.depth": True, "model.keypoint_weight": 1.0},
    "self_rollout": {**NONE, "model.self_rollout": 0.4},
    "no_self_forcing": {**NONE, "model.self_forcing": 0.0},
    "cross_attention": {**NONE, "model.conditioning": "cross_attention"},
    "additive": {**NONE, "model.conditioning": "additive"},
    "no_state": {**NONE, "model.state_size": 0},
    "maskgit": {**NONE, "model.decoding": "maskgit"},
    "anchored": {"model.dynamics": "anchored"},
    "anchored_no_state": {"model.dynamics": "anchored", "model.state_size": 0},
}
"""Name → what differs from the preset. Depth needs a dataset recorded with it."""

PSNR_STEPS: Final = (1, 10, 30)
MEASURES: Final = {
    **{f"psnr_{step}": f"PSNR at step {step} (dB)" for step in PSNR_STEPS},
    **{name: TITLES[name] for name in ("delta_psnr_15", "moving_psnr", "abs_rel", "done_f1")},
}
"""Columns of the table, those of the gate beside them; one that nothing has is left out."""


def train_variant(given: argparse.Namespace, name: str, model: str, flags: Mapping[str, Any]) -> Path:
    """Train `model` as the preset says, with `flags` over it, unless that is done. → its folder"""
    folder: Path = given.output_dir / name
    common = {
        "model.type": model, "model.device": given.device, "dataset.root": given.dataset_root,
        "output_dir": folder, "seed": given.seed,
    }  # fmt: skip
    args = [*preset_flags(given.preset, "train-world-model", [model]), *format_flags({**common, **flags})]
    train_world_model(draccus.parse(TrainWorldModelConfig, args=args))
    return folder


def trained_tokenizer(given: argparse.Namespace) -> str:
    """The given tokenizer, or one that is trained first."""
    if given.tokenizer:
        return str(given.tokenizer)
    return str(train_variant(given, "frame_tokenizer", "frame_tokenizer", {}))


def psnr_at(accuracy: Sequence[EpisodeAccuracy], step: int) -> Estimate:
    """PSNR of the `step`-th imagined frame, over the episodes that last so long."""
    curves = [episode.steps.get("psnr", np.empty(0)) for episode in accuracy]
    return Estimate.mean(np.array([curve[step - 1] if len(curve) >= step else np.nan for curve in curves]))


def measure(given: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """One variant's row: estimates of held-out episodes, and the gate's counts."""
    model = load_model(folder, "action_world_model", given.device)
    table = read_episodes(open_dataset(given.dataset_root))
    source = Recording(table, cached_frames(table.dataset, model.config.tokenizer.camera_keys))
    unseen = {scene.index for scene in scenes_of("ood")}
    evaluation = evaluate(model, source, choose_episodes(table, given.split, given.max_episodes, unseen))
    estimates = headline(evaluation.accuracy) | done_accuracy(evaluation.outcomes, threshold=0.5, frames=3)
    estimates |= {f"psnr_{step}": psnr_at(evaluation.accuracy, step) for step in PSNR_STEPS}
    config, speed = json.loads((folder / CONFIG_FILE).read_text()), read_metrics(folder)[-1]["steps_per_s"]
    chosen = config["dataset"]["episodes"]
    row: dict[str, Any] = {
        "steps": config["steps"],
        "minutes": round(config["steps"] / speed / 60, 2),
        "episodes": table.dataset.num_episodes if chosen is None else len(chosen),
        "parameters": sum(p.numel() for p in model.parameters() if p.requires_grad),
        **{name: estimates[name].as_json() for name in MEASURES if name in estimates},
    }
    if given.rollouts:
        row["gate"] = success_gate(model, given.rollouts).as_json()
    return row


def measured_once(given: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """`measure`, or what it found before on the same episodes."""
    path = folder / "ablation.json"
    on = {"split": given.split, "max_episodes": given.max_episodes, "rollouts": given.rollouts}
    stored = json.loads(path.read_text()) if path.is_file() else {}
    if stored.get("measured_on") != on:
        stored = {"measured_on": on, **measure(given, folder)}
        write_json(path, stored)
    return {key: value for key, value in stored.items() if key != "measured_on"}


def estimate_cell(number: Mapping[str, Any] | None) -> str:
    """Value and bootstrap interval."""
    if number is None or number["value"] is None:
        return "–"
    low, high = number["bootstrap_95"]
    return f"{number['value']:.2f} ({low:.2f} to {high:.2f})"


def share_cell(number: Mapping[str, Any]) -> str:
    """Percentage and Wilson's interval."""
    if not number["n"]:
        return "–"
    low, high = number["wilson_95"]
    return f"{100 * number['share']:.0f} % ({100 * low:.0f} to {100 * high:.0f}; n = {number['n']})"


def results_table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """A line a variant, with 95 % intervals."""
    columns = [name for name in MEASURES if any(name in row for row in rows.values())]
    head, gated = (
        ["variant", *(MEASURES[name] for name in columns)],
        any("gate" in row for row in rows.values()),
    )
    if gated:
        head += ["failures called successes", "successes recognised", "AUC"]
    lines = []
    for variant, row in rows.items():
        line = [variant, *(estimate_cell(row.get(name)) for name in columns)]
        if gated:
            gate = row["gate"]
            line += [share_cell(gate[name]) for name in ("false_positive_rate", "recall")]
            line.append(f"{gate['auc']:.2f}" if gate["auc"] is not None else "–")
        lines.append(line)
    return markdown_table(head, lines)


def add_arguments(parser: argparse.ArgumentParser, output_dir: Path, results: Path) -> None:
    """What all comparisons of trainings are given."""
    parser.add_argument("--dataset.root", dest="dataset_root", required=True, help="what to learn from")
    parser.add_argument("--rollouts", help="dataset of real rollouts for the gate; none: no gate")
    parser.add_argument("--tokenizer", help="trained frame tokenizer; by default the preset's is trained")
    parser.add_argument("--preset", default="cpu", help="sizes of tokenizer and network (default: cpu)")
    parser.add_argument("--steps", type=int, help="of every variant; by default the preset's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--split", default="validation", help="episodes that are replayed")
    parser.add_argument("--max_episodes", type=int, default=200, help="of them, evenly spread")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--output_dir", type=Path, default=output_dir)
    parser.add_argument("--output", type=Path, default=results, help="JSON file")


def compare(given: argparse.Namespace, variants: Mapping[str, Flags]) -> dict[str, Any]:
    """Train and measure each of `variants`, name → what differs from the preset, and write the results
    after each. → rows by name"""
    keep_freed_memory()
    register_third_party_plugins()
    settings: dict[str, Any] = {"steps": given.steps} if given.steps else {}
    settings["model.tokenizer_path"] = trained_tokenizer(given)
    rows = {}
    for name, flags in variants.items():
        folder = train_variant(given, name, "action_world_model", {**settings, **flags})
        rows[name] = measured_once(given, folder)
        shared = {key: getattr(given, key) for key in ("preset", "seed", "split", "max_episodes")}
        write_json(given.output, {**shared, "variants": rows})
    return rows


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=["none", "keypoints"])
    add_arguments(parser, Path("outputs/ablation"), RESULTS)
    given = parser.parse_args()
    print(results_table(compare(given, {name: VARIANTS[name] for name in given.variants})))


if __name__ == "__main__":
    main()

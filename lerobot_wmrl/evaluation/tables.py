"""The evaluation as a page of Markdown."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lerobot_wmrl.common.statistics import Estimate
from lerobot_wmrl.evaluation.gate import SWEEP_FRAMES, SWEEP_THRESHOLDS, Gate

NAMES = {
    "psnr": "PSNR (dB)",
    "psnr_ceiling": "PSNR of the tokenizer alone (dB)",
    "psnr_30": "PSNR at step 30 (dB)",
    "psnr_ceiling_30": "PSNR of the tokenizer alone at step 30 (dB)",
    "psnr_below_ceiling_30": "below the tokenizer at step 30 (dB)",
    "moving_psnr": "PSNR of what moved (dB)",
    "moving_psnr_ceiling": "PSNR of what moved, tokenizer alone (dB)",
    "delta_psnr_15": "delta-PSNR at step 15 (dB)",
    "ssim": "SSIM",
    "tokenizer_lpips": "LPIPS's formula on tokenizer features",
    "lpips_alex": "LPIPS (AlexNet)",
    "token_accuracy": "token accuracy",
    "tcp_error_mm": "error of the TCP (mm)",
    "abs_rel": "AbsRel",
    "delta_1": "depth δ1",
    "delta_2": "depth δ2",
    "spatial_iou": "spatial IoU",
    "spatiotemporal_iou": "spatiotemporal IoU",
    "weighted_spatial_iou": "weighted spatial IoU",
    "mse": "MSE",
    "done_precision": "done precision, by frame",
    "done_recall": "done recall, by frame",
    "done_f1": "done F1, by frame",
    "done_log_loss": "done log loss (nats a frame)",
    "episode_precision": "success precision, by episode",
    "episode_recall": "success recall, by episode",
    "episode_f1": "success F1, by episode",
    "done_delay_frames": "delay of done (frames)",
    "done_distance_frames": "delay of done, early or late (frames)",
}
"""What the table calls each number of metrics.json."""


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Head and rows, one a line."""
    cells = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(str(cell) for cell in row)} |" for row in cells)


def headline_table(numbers: Mapping[str, Estimate]) -> str:
    """Every measured number with its interval, in the order of `NAMES`."""
    rows = [(title, str(numbers[name]), numbers[name].n) for name, title in NAMES.items() if name in numbers]
    return markdown_table(("measure", "mean (bootstrap 95 %)", "episodes"), rows)


def gate_lines(gate: Gate, best: Gate | None) -> str:
    """The gate where the user put it, and the best place to put it."""
    lines = [
        f"Gate at --done_threshold={gate.threshold} --done_frames={gate.frames}: "
        f"{'passed' if gate.passed else 'not passed'}.",
        f"Failures called successes: {gate.false_positives}. Successes recognised: {gate.recall}.",
        f"AUC of successes against failures, whatever the threshold: {gate.auc:.2f} (0.5 by chance).",
    ]
    if gate.cut_short:
        lines.append(
            f"{gate.cut_short} of the successes were recorded for fewer than {gate.frames} frames of success "
            "and cannot be recognised; lower --done_frames, or record on after success."
        )
    if best is None:
        lines.append("No operating point keeps false successes at 5 % or less and recognises anything.")
    else:
        lines.append(
            f"Best with at most 5 % false successes: --done_threshold={best.threshold} "
            f"--done_frames={best.frames}; false successes {best.false_positives}; "
            f"recognised {best.recall}."
        )
    return "\n".join(lines)


def task_table(gates: Mapping[str, Gate]) -> str:
    """The gate of each task, at one operating point."""
    rows = [
        (task, gate.false_positives, gate.recall, f"{gate.auc:.2f}", "yes" if gate.passed else "no")
        for task, gate in gates.items()
    ]
    return markdown_table(
        ("task", "failures called successes", "successes recognised", "AUC", "passed"), rows
    )


def sweep_table(gates: Sequence[Gate]) -> str:
    """Percent of false successes / of recognised successes by threshold and frames."""
    at = {(gate.threshold, gate.frames): gate for gate in gates}
    rows = [
        (threshold, *(_percents(at[threshold, frames]) for frames in SWEEP_FRAMES))
        for threshold in SWEEP_THRESHOLDS
    ]
    return markdown_table(("threshold", *(f"k = {frames}" for frames in SWEEP_FRAMES)), rows)


def robustness_table(result: Mapping[str, Any]) -> str:
    """Extreme actions: how many episodes are called successes, and how far the picture stays."""
    rows = [
        (
            name,
            f"{row['predicted_success']['k']} of {row['predicted_success']['n']}",
            _value(row["psnr_to_start"]),
        )
        for name, row in result.items()
        if isinstance(row, Mapping)
    ]
    return markdown_table(("actions", "called success", "PSNR to the start (dB)"), rows)


def goal_table(result: Mapping[str, Any]) -> str:
    """Goal frames of the text model."""
    rows = [
        ("goals that reach the threshold", _share(result["goal_reached"])),
        ("distance to the nearest true final frame", _value(result["nearest_final_tokenizer_lpips"])),
        ("the same of the start frame", _value(result["start_to_final_tokenizer_lpips"])),
        ("PSNR to the nearest true final frame (dB)", _value(result["nearest_final_psnr"])),
    ]
    if "probe" in result:
        accuracy = result["probe"]["balanced_accuracy"]
        believed = "unknown" if accuracy is None else f"{accuracy:.3f}"
        rows.append(("goals in which success holds, says a probe", _share(result["success_holds"])))
        rows.append(
            ("the same of true final frames it has not seen", _share(result["success_holds_in_finals"]))
        )
        rows.append(("balanced accuracy of that probe", believed))
    return markdown_table(("goal frames", "value"), rows)


def _percents(gate: Gate) -> str:
    false, recognised = (
        f"{100 * rate.share:.0f}" if rate.n else "–" for rate in (gate.false_positives, gate.recall)
    )
    return f"{false} / {recognised}"


def _share(rate: Mapping[str, Any]) -> str:
    return f"{rate['k']} of {rate['n']}"


def _value(estimate: Mapping[str, Any]) -> str:
    if estimate["value"] is None:
        return "not measured"
    low, high = estimate["bootstrap_95"]
    return f"{estimate['value']:.3g} ({low:.3g} to {high:.3g})"

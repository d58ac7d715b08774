"""Metrics of a run: JSON lines, which anything can plot; LeRobot's lines in the terminal, and its wandb."""

import json
import logging
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from lerobot.utils.logging_utils import MetricsTracker

from lerobot_wmrl.common.distributed import is_first_process

METRICS_FILE = "metrics.jsonl"


def append_metrics(output_dir: Path, step: int, metrics: Mapping[str, float]) -> None:
    """Add one line `{"step": step, name: value, …}` to the run's metrics file. It begins after a torn one."""
    with (output_dir / METRICS_FILE).open("ab+") as file:
        if size := file.seek(0, os.SEEK_END):
            file.seek(size - 1)
            if file.read() != b"\n":
                file.write(b"\n")
        file.write(json.dumps({"step": step, **metrics}).encode() + b"\n")


def log_metrics(
    output_dir: Path, step: int, metrics: Mapping[str, float], wandb: Any, mode: str = "train"
) -> None:
    """Write metrics to the file and, as `train/…` or `eval/…`, to wandb, if there is its logger; from the
    first process."""
    if is_first_process():
        append_metrics(output_dir, step, metrics)
        if wandb is not None:
            wandb.log_dict(dict(metrics), step, mode)


def read_metrics(output_dir: Path) -> list[dict[str, Any]]:
    """Return the metrics of each step, in order of steps.

    Of a metric that was written twice, as after a resume, the later value counts. Torn lines are dropped.
    """
    path = output_dir / METRICS_FILE
    lines: dict[int, dict[str, Any]] = {}
    for text in path.read_text().splitlines() if path.is_file() else []:
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        lines.setdefault(line["step"], {}).update(line)
    return [lines[step] for step in sorted(lines)]


def make_wandb(cfg: Any) -> Any:
    """Return LeRobot's WandBLogger if `cfg.wandb.enable`, else None. Of several processes the first logs.

    A run that wandb knows already is continued.

    Args:
        cfg: a command's dataclass, with what LeRobot's logger reads: wandb, output_dir, job_name, resume,
            seed, env, dataset, policy or reward_model, is_reward_model_training, to_dict.
    """
    if not cfg.wandb.enable or not is_first_process():
        return None
    from lerobot.common.wandb_utils import WandBLogger

    known = (cfg.output_dir / "wandb" / "latest-run").exists()
    return WandBLogger(replace(cfg, resume=known, job_name=cfg.job_name or cfg.output_dir.name))


class Tracker:
    """Log the metrics of a training.

    Args:
        output_dir: where metrics.jsonl goes.
        meters: LeRobot's averages between two lines in the terminal; it shows `shown` of the metrics.
        log_freq: steps from one line to the next.
        wandb: LeRobot's WandBLogger, None without.
    """

    def __init__(
        self, output_dir: Path, meters: MetricsTracker, shown: tuple[str, ...], log_freq: int, wandb: Any
    ) -> None:
        self.output_dir, self.meters, self.shown = output_dir, meters, shown
        self.log_freq, self.wandb = log_freq, wandb

    def log(self, step: int, metrics: Mapping[str, float], mode: str = "train") -> None:
        """Write metrics to the file and to wandb, as `log_metrics` does."""
        log_metrics(self.output_dir, step, metrics, self.wandb, mode)

    def log_step(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log a finished step, every `log_freq` steps also as a line in the terminal."""
        self.log(step, metrics)
        self.meters.step()
        self.meters.update_metrics({name: metrics[name] for name in self.shown if name in metrics})
        if step % self.log_freq == 0 and is_first_process():
            logging.info(self.meters)
            self.meters.reset_averages()

    def log_policy(self, checkpoint: Path) -> None:
        """Upload the policy of a checkpoint as wandb's artifact."""
        if self.wandb is not None and is_first_process():
            self.wandb.log_policy(checkpoint)

import json
from pathlib import Path

from lerobot_wmrl.demo.report.sources import lerobot_train_curve, metric_curves, success_rate


def test_success_rate_counts_every_episode_of_every_task(tmp_path: Path) -> None:
    tasks = [{"metrics": {"successes": [True, False]}}, {"metrics": {"successes": [True]}}]
    (tmp_path / "eval_info.json").write_text(json.dumps({"per_task": tasks}))
    rate = success_rate(tmp_path)
    assert (rate.k, rate.n) == (2, 3)


def test_curve_from_lerobots_log_lines(tmp_path: Path) -> None:
    log = tmp_path / "sft.log"
    log.write_text(
        "INFO ot_train.py:1 step:200 smpl:2K ep:3 epch:0.10 loss:0.250 grdn:1.2 lr:1.0e-04\n"
        "Training:  10%|\rINFO step:1K smpl:9K ep:9 epch:0.20 loss:1.5e-02 grdn:1.1 lr:1.0e-04\n"
    )
    assert lerobot_train_curve(log) == ([200.0, 1000.0], [0.25, 0.015])


def test_curves_skip_rows_and_columns_that_are_missing() -> None:
    rows = [{"step": 1, "loss": 2.0}, {"step": 2, "speed": 9.0}, {"step": 3, "loss": 1.0}]
    assert metric_curves(rows, ["loss", "accuracy"]) == {"loss": ([1.0, 3.0], [2.0, 1.0])}

"""Metrics that a killed run has left."""

from pathlib import Path

from lerobot_wmrl.common.tracking import METRICS_FILE, append_metrics, read_metrics


def test_a_torn_line_takes_none_with_it(tmp_path: Path) -> None:
    append_metrics(tmp_path, 1, {"loss": 3.0})
    with (tmp_path / METRICS_FILE).open("a") as file:
        file.write('{"step": 2, "lo')
    append_metrics(tmp_path, 2, {"loss": 2.0})
    append_metrics(tmp_path, 3, {"loss": 1.0})
    assert [line["loss"] for line in read_metrics(tmp_path)] == [3.0, 2.0, 1.0]

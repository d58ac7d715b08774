"""Which episodes of a recording a policy is cloned from."""

from pathlib import Path

import pyarrow.parquet as pq
import pytest

from experiments.choose_episodes import main, optimal_episodes, successes
from tests.recorded import write_recording


def test_only_successful_optimal_episodes_are_taken(tmp_path: Path) -> None:
    write_recording(tmp_path)
    assert optimal_episodes(tmp_path, 2) == [0, 3]
    with pytest.raises(ValueError, match="holds 2 successful optimal episodes, 3 are needed"):
        optimal_episodes(tmp_path, 3)


def test_successes_are_the_first_or_all(tmp_path: Path) -> None:
    write_recording(tmp_path)
    assert successes(tmp_path, 1) == [0]
    assert successes(tmp_path, None) == [0, 3]
    with pytest.raises(ValueError, match="2 successes, 3 are needed"):
        successes(tmp_path, 3)


def test_a_dataset_without_labels_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_recording(tmp_path)
    (file,) = tmp_path.rglob("*.parquet")
    pq.write_table(pq.read_table(file).drop_columns("next.success"), file)
    monkeypatch.setattr("sys.argv", ["choose_episodes", str(tmp_path), "--every_success"])
    with pytest.raises(SystemExit, match=r"error: .*has no column next\.success; record it with"):
        main()

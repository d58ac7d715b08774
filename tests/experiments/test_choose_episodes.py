"""Which episodes of a recording a policy is cloned from."""

from pathlib import Path

import pytest

from experiments.choose_episodes import optimal_episodes, successes
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

"""An output folder belongs to the settings of one run."""

from pathlib import Path

import pytest

from lerobot_wmrl.common.output_folders import CONFIG_FILE, claim_output_dir, locked


def test_a_run_that_was_killed_while_it_claimed_its_folder_claims_it_again(tmp_path: Path) -> None:
    (tmp_path / f".{CONFIG_FILE}.partial").write_text("{")
    claim_output_dir(tmp_path, {"seed": 1})
    claim_output_dir(tmp_path, {"seed": 1})
    with pytest.raises(ValueError, match=r"was begun with other settings \(seed 1 → 2\)"):
        claim_output_dir(tmp_path, {"seed": 2})


def test_a_file_and_a_foreign_folder_are_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "thesis.txt"
    file.write_text("mine")
    for place, problem in ((file, "is a file"), (tmp_path, "holds something else")):
        with pytest.raises(ValueError, match=problem):
            claim_output_dir(place, {"seed": 1})
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_folder_is_held_by_one_run_at_a_time(tmp_path: Path) -> None:
    file = tmp_path / "lock"
    with locked(tmp_path, file), pytest.raises(ValueError, match="another command"), locked(tmp_path, file):
        pass
    with locked(tmp_path, file):
        pass

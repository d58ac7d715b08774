"""An output folder belongs to the settings of one run, and to one command at a time."""

from pathlib import Path

import pytest

from lerobot_wmrl.common.output_folders import RUN_CONFIG_FILE, Claim


def test_a_run_that_was_killed_while_it_claimed_its_folder_claims_it_again(tmp_path: Path) -> None:
    (tmp_path / f".{RUN_CONFIG_FILE}.partial").write_text("{")
    for _ in range(2):
        with Claim(tmp_path, {"seed": 1}).held():
            assert (tmp_path / RUN_CONFIG_FILE).is_file()


def test_other_settings_are_refused_by_name_but_for_those_that_may_differ(tmp_path: Path) -> None:
    with Claim(tmp_path, {"seed": 1, "steps": 5}).held():
        pass
    with Claim(tmp_path, {"seed": 1, "steps": 9}, free=["steps"]).held():
        pass
    with (
        pytest.raises(ValueError, match=r"^output_dir=.* was begun with other settings \(seed 1 → 2\)"),
        Claim(tmp_path, {"seed": 2, "steps": 5}).held(),
    ):
        pass


def test_a_file_and_a_foreign_folder_are_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "thesis.txt"
    file.write_text("mine")
    for place, problem in ((file, "is a file"), (tmp_path, "holds something else")):
        with pytest.raises(ValueError, match=problem), Claim(place, {"seed": 1}).held():
            pass
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_folder_is_held_by_one_command_at_a_time(tmp_path: Path) -> None:
    with (
        Claim(tmp_path, {}).held(),
        pytest.raises(ValueError, match="another command"),
        Claim(tmp_path, {}).held(),
    ):
        pass
    with Claim(tmp_path, {}).held():
        pass

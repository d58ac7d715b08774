"""Folders are whole or absent."""

from pathlib import Path

import pytest

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.files import require_new, whole_folder


def test_a_torn_folder_leaves_nothing_in_its_place(tmp_path: Path) -> None:
    target = tmp_path / "new" / "target"

    def tear() -> None:
        with whole_folder(target) as partial:
            partial.mkdir()
            (partial / "half").touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tear()
    assert not target.exists()
    with whole_folder(target) as partial:
        partial.mkdir()
        (partial / "whole").touch()
    assert [path.name for path in target.iterdir()] == ["whole"]
    assert list(target.parent.iterdir()) == [target]


def test_what_is_there_already_is_refused_but_for_an_empty_folder(tmp_path):
    file, folder = tmp_path / "file", tmp_path / "folder"
    file.touch()
    folder.mkdir()
    for new in (folder, tmp_path / "absent"):
        require_new("output_dir", new)
    (folder / "own").touch()
    for target in (file, folder):
        with pytest.raises(FieldError, match=rf"^target={target}: there is something already; choose a new"):
            require_new("target", target)

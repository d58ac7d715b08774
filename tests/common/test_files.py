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


def test_the_place_behind_a_link_is_filled_and_a_mounted_disk_is_refused(tmp_path, monkeypatch):
    """Output folders are often links to a larger disk."""
    disk = tmp_path / "disk"
    disk.mkdir()
    for name, behind in (("link", disk / "empty"), ("dangling", disk / "absent")):
        (tmp_path / name).symlink_to(behind)
    (disk / "empty").mkdir()
    for name in ("link", "dangling"):
        target = tmp_path / name
        require_new("output_dir", target)
        with whole_folder(target) as partial:
            assert partial.parent == disk
            partial.mkdir()
            (partial / "whole").touch()
        assert target.is_symlink()
        assert [path.name for path in target.iterdir()] == ["whole"]
    monkeypatch.setattr(Path, "is_mount", lambda path: path.name == "mounted")
    (tmp_path / "mounted").mkdir()
    with pytest.raises(FieldError, match=r"^output_dir=.*mounted: a disk is mounted there"):
        require_new("output_dir", tmp_path / "mounted")

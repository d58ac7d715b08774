"""Folders are whole or absent."""

from pathlib import Path

import pytest

from lerobot_wmrl.common.files import whole_folder


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

"""Hugging Face's client, whose requests go to a hub on the loopback."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.hub_server import Hub, hub_at_its_address


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Hub]:
    """LeRobot publishes at one address only."""
    with hub_at_its_address(monkeypatch, tmp_path / "cache") as hub:
        yield hub

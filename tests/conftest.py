"""What several test packages need. It imports little: the processes that run the tests wait for one that only
deals them out, and imports this too."""

import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from tests.hub_server import Hub


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> "Iterator[Hub]":
    """A hub on the loopback for Hugging Face's client. LeRobot publishes at one address only."""
    from tests.hub_server import hub_at_its_address

    with hub_at_its_address(monkeypatch, tmp_path / "cache") as hub:
        yield hub


@pytest.fixture(scope="session", autouse=True)
def quick_parsing() -> Iterator[None]:
    """LeRobot's commands look up the help text of every flag, which takes seconds and nobody reads here."""
    from lerobot_wmrl.common.quick_parsing import parsed_quickly

    with parsed_quickly():
        yield


@pytest.fixture(autouse=True)
def ordinary_priority() -> None:
    """Give up the real-time priority that SVT-AV1 gives the thread in which root encodes a video: processes
    that a test starts would have it too, and keep all others from running."""
    give_up_priority()


@pytest.fixture(autouse=True)
def ordinary_log_level() -> None:
    """Log from INFO on, whatever a test before has set: LeRobot's commands let every library's DEBUG lines
    through, and a test that looks for words in the log would find theirs."""
    logging.getLogger().setLevel(logging.INFO)


def give_up_priority() -> None:
    """Schedule this thread, and what it starts, like any other."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@pytest.fixture(scope="session")
def make_synthetic_dataset() -> "Callable[..., LeRobotDataset]":
    """The factory of small datasets."""
    from tests.synthetic import synthetic_dataset

    return synthetic_dataset


@pytest.fixture(scope="session")
def small_dataset(tmp_path_factory: pytest.TempPathFactory) -> "LeRobotDataset":
    """Six short episodes of 32x32 images, shared: do not change it."""
    from tests.synthetic import synthetic_dataset

    return synthetic_dataset(tmp_path_factory.mktemp("synthetic") / "dataset")


@pytest.fixture(scope="session")
def trained_models(
    small_dataset: "LeRobotDataset", tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Output folders of a tokenizer and both world models, three steps each, by name."""
    from tests.trained import action_config, run_training, text_config, train_tokenizer

    folder, root = tmp_path_factory.mktemp("models"), Path(small_dataset.root)
    tokenizer = train_tokenizer(root, folder / "frame_tokenizer")
    return {
        "frame_tokenizer": tokenizer,
        "action_world_model": run_training(action_config(tokenizer), root, folder / "action_world_model"),
        "text_world_model": run_training(text_config(tokenizer), root, folder / "text_world_model"),
    }

from pathlib import Path

import numpy as np
import pytest

from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from tests.pusht import record_pusht


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """Two episodes of PushT; the second succeeds before it must end."""
    root = tmp_path_factory.mktemp("pusht") / "data"
    return record_pusht(root, "--num_episodes=2", "--steps=200", "--noise", "2")


def test_the_scripted_pusher_records_what_a_world_model_can_learn_from(recorded):
    table = read_episodes(open_dataset(recorded))
    assert len(table.length) == 2
    assert table.done_known
    assert table.success.any()
    assert table.action.shape[1] == table.state.shape[1] == 2
    assert np.linalg.norm(np.diff(table.action, axis=0), axis=1).mean() > 1

import runpy
from pathlib import Path

import numpy as np
import pytest
from gymnasium.envs.registration import registry
from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from tests.pusht import record_pusht

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.parametrize(
    ("folder", "type_name", "columns"), [("gym_hil", "hil_pick", 4), ("metaworld", "metaworld_small", 2)]
)
def test_an_environment_shows_what_its_script_records(folder, type_name, columns, monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES / folder)
    recorded = runpy.run_path(str(EXAMPLES / folder / "record.py"))["FEATURES"]
    env = EnvConfig.get_choice_class(type_name)()
    assert env.gym_id in registry
    shapes = {env.features_map[name]: feature.shape for name, feature in env.features.items()}
    both = shapes.keys() & recorded.keys()
    assert {"action", "observation.state"} <= both
    assert len(both) == columns
    assert all(shapes[column] == recorded[column]["shape"] for column in both)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """Two episodes of PushT; the second succeeds before it must end."""
    root = tmp_path_factory.mktemp("pusht") / "data"
    return record_pusht(root, "--num_episodes=2", "--steps=200", "--noise", "2")


def test_the_scripted_pusher_records_what_a_world_model_can_learn_from(recorded):
    table = read_episodes(open_dataset(recorded))
    assert len(table.length) == 2
    assert table.has_labels
    assert table.success.any()
    assert table.action.shape[1] == table.state.shape[1] == 2
    assert np.linalg.norm(np.diff(table.action, axis=0), axis=1).mean() > 1

"""The success classifier, judged task by task on recorded frames."""

from pathlib import Path

import numpy as np
import pytest

from experiments.steps.told import other_instructions, outcomes_with, told
from lerobot_wmrl.common.constants import TASK_NAMES
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.evaluation.outcomes import seen_outcomes
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.world_models.checkpoint import load_model
from tests.trained import PULL, PUSH, told_apart


@pytest.fixture
def table(make_synthetic_dataset, tmp_path, monkeypatch) -> EpisodeTable:
    """Six episodes of two tasks in turn."""
    monkeypatch.setattr(EpisodeTable, "column", lambda table, name: np.arange(len(table.start)) % 2)
    return read_episodes(make_synthetic_dataset(tmp_path / "data", instructions=(PUSH, PULL)))


def test_frames_are_judged_as_the_gate_judges_them_and_under_another_instruction_too(table, tmp_path):
    folder = told_apart(Path(table.dataset.root), tmp_path)
    world_model, model = (
        load_model(folder, "action_world_model"),
        load_model(folder.parent / "frame_tokenizer", "frame_tokenizer"),
    )
    model.tokenizer.load_state_dict(world_model.tokenizer.state_dict())
    own = outcomes_with(model, table, table.instructions)
    expected = seen_outcomes(world_model, Recording.read(table, world_model), range(6))
    length = min(own.probability.shape[1], expected.probability.shape[1]) - 1
    np.testing.assert_allclose(own.probability[:, :length], expected.probability[:, :length], atol=1e-5)
    other = outcomes_with(model, table, other_instructions(np.arange(6) % 2, table.instructions))
    assert not np.allclose(own.probability, other.probability, atol=1e-3, equal_nan=True)
    everything = told(model, table, criterion=SuccessCriterion(0.0, 1))
    assert [*everything] == [TASK_NAMES[0], TASK_NAMES[1]]
    for task, found in enumerate(everything.values()):
        successes = int(table.success[task::2].sum())
        assert found["recall"]["k"] == found["recall"]["n"] == successes
        assert found["under_another_instruction"]["k"] == successes
        assert found["false_positive_rate"]["n"] == 3 - successes
    nothing = told(model, table, criterion=SuccessCriterion(1.1, 1))
    assert {found["under_another_instruction"]["n"] for found in nothing.values()} == {0}


def test_another_instruction_is_one_of_another_task():
    tasks = np.array([0, 0, 1, 2])
    found = other_instructions(tasks, ["push", "shove", "pull", "lift"])
    assert {*found[:2]} <= {"pull", "lift"}
    assert found[2] in {"push", "shove", "lift"}
    assert found[3] in {"push", "shove", "pull"}

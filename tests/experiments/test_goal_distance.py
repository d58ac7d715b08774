"""The goal frame as judge of success, beside the success classifier."""

import argparse

import numpy as np
import pytest

from experiments.steps.goal_distance import MEASURES, compare, imagined, lowest_threshold
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.evaluation.outcomes import Outcomes, predict_outcomes
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.world_models.checkpoint import load_model


def judged(scores: list[float], successes: int) -> Outcomes:
    """Episodes of six frames that keep their score; the first ones hold success throughout."""
    probability = np.repeat(np.array(scores)[:, None], 6, axis=1)
    done = np.zeros(probability.shape, bool)
    done[:successes] = True
    return Outcomes(np.arange(len(scores)), probability, done)


def test_a_threshold_lets_a_twentieth_of_the_failures_pass_and_no_more():
    failures = [each / 100 for each in range(40)]
    outcomes = judged([0.375, 0.9, *failures], successes=2)
    threshold = lowest_threshold(outcomes)
    assert 0.37 < threshold < 0.38
    found = compare({"goal": outcomes}, {"unseen": {"goal": judged([0.1, 0.9, 0.5], successes=2)}})["goal"]
    assert (found["chosen"]["false_positive_rate"]["k"], found["chosen"]["recall"]["k"]) == (2, 2)
    assert (found["unseen"]["false_positive_rate"]["k"], found["unseen"]["recall"]["k"]) == (1, 1)
    assert found["unseen"]["done_threshold"] == threshold


def test_without_failures_there_is_no_threshold():
    with pytest.raises(ValueError, match="none fails"):
        lowest_threshold(judged([0.5, 0.9], successes=2))


def test_the_classifier_says_the_same_as_in_the_gate(small_dataset, trained_models):
    given = argparse.Namespace(
        model_path=str(trained_models["action_world_model"]),
        text_model_path=str(trained_models["text_world_model"]),
        max_episodes=3,
    )
    found = imagined(given, str(small_dataset.root))
    assert found.keys() == MEASURES.keys()
    model = load_model(trained_models["action_world_model"], "action_world_model")
    table = read_episodes(open_dataset(small_dataset.root))
    episodes = found["classifier"].episodes
    expected = predict_outcomes(model, Recording.read(table, model))
    expected = expected.where(np.isin(expected.episodes, episodes))
    np.testing.assert_allclose(found["classifier"].probability, expected.probability, atol=1e-5)
    np.testing.assert_array_equal(found["goal"].length, table.length[episodes])
    assert (found["goal"].done == expected.done).all()
    assert not np.allclose(found["goal"].probability, found["classifier"].probability, equal_nan=True)

"""The gate's arithmetic on made-up verdicts: no model, no pictures."""

import json
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.common.success_criterion import SuccessCriterion, first_run
from lerobot_wmrl.data.episodes import solved_at_end
from lerobot_wmrl.evaluation.gate import (
    Gate,
    best_operating_point,
    done_accuracy,
    done_delay,
    done_log_loss,
    gate_at,
    gate_details,
    sweep,
)
from lerobot_wmrl.evaluation.outcomes import Outcomes, by_task
from lerobot_wmrl.evaluation.report import gate_lines, task_table

CRITERION = SuccessCriterion(0.5, 3)


@pytest.fixture
def outcomes() -> Outcomes:
    """A success seen at once, one seen two frames late, one missed; a failure believed in, one not."""
    nan = np.nan
    probability = [
        [0.1, 0.9, 0.9, 0.9, 0.9, 0.9],
        [0.1, 0.1, 0.1, 0.8, 0.8, 0.8],
        [0.1, 0.1, 0.1, 0.1, nan, nan],
        [0.1, 0.7, 0.7, 0.7, 0.1, 0.1],
        [0.1, 0.6, 0.1, 0.1, nan, nan],
    ]
    done = np.zeros((5, 6), bool)
    done[0, 1:] = done[1, 1:] = done[2, 2:4] = True
    return Outcomes(np.arange(5), np.array(probability), done)


def test_the_first_run_is_of_consecutive_frames():
    fired = np.array([[0, 1, 1, 0, 1], [1, 0, 1, 1, 1], [0, 0, 0, 0, 0]], bool)
    assert first_run(fired, 2).tolist() == [1, 2, -1]
    assert first_run(fired, 1).tolist() == [1, 0, -1]
    assert first_run(fired, 6).tolist() == [-1, -1, -1]


@pytest.mark.parametrize(
    ("threshold", "frames", "false", "recognised"),
    [
        (0.5, 3, 1, 2),
        (0.5, 1, 2, 2),
        (0.75, 3, 0, 2),
        (0.85, 3, 0, 1),
        (0.85, 4, 0, 1),
        (0.95, 1, 0, 0),
    ],
)
def test_the_gate_counts_as_the_environment_ends_episodes(outcomes, threshold, frames, false, recognised):
    gate = gate_at(outcomes, SuccessCriterion(threshold, frames))
    assert (gate.false_positives.k, gate.false_positives.n) == (false, 2)
    assert (gate.recall.k, gate.recall.n) == (recognised, 3)
    assert not gate.passed


def test_successes_that_end_too_early_are_counted(outcomes):
    """The third success holds for the last two of its four frames."""
    assert [gate_at(outcomes, SuccessCriterion(0.5, frames)).cut_short for frames in (1, 2, 3, 4)] == [
        0,
        0,
        1,
        1,
    ]
    lines = gate_lines(gate_at(outcomes, CRITERION), None)
    assert "1 of the successes end before they have held for 3 frames. They cannot be predicted" in lines
    assert "have held" not in gate_lines(gate_at(outcomes, SuccessCriterion(0.5, 2)), None)


def test_where_episodes_end_at_success_their_last_frames_count_as_lasting():
    """The success is recorded for one frame; a failure whose last frame looks the same counts as one too."""
    nan = np.nan
    probability = np.array([[0.1, 0.1, 0.9, nan], [0.1, 0.1, 0.1, 0.9], [0.1, 0.9, 0.1, 0.1]])
    done = np.array([[False, False, True, False], [False] * 4, [False] * 4])
    at_success = Outcomes(np.arange(3), probability, done)
    gate = gate_at(at_success, CRITERION)
    assert (gate.recall.k, gate.false_positives.k) == (1, 1)
    assert "As most do, the prediction for the last frame" in gate_lines(gate, None)
    assert at_success.scores(3).tolist() == [0.9, 0.9, 0.1]
    assert done_delay(at_success, CRITERION)[0] == 0
    parts = [at_success.where(np.array(kept)) for kept in ([True, False, True], [False, True, False])]
    assert [gate_at(part, CRITERION).false_positives.k for part in parts] == [0, 1], (
        "a part is judged as the whole"
    )
    seen_out = Outcomes(np.arange(3), np.nan_to_num(probability), done)
    assert gate_at(seen_out, CRITERION).recall.k == 0


@pytest.mark.parametrize(("held", "late"), [(3, 1), (3, 2), (5, 2)])
def test_a_success_that_is_seen_late_counts_although_its_episode_ends(held, late):
    """However many frames are asked for: a stricter criterion does not recognise more."""
    done = np.arange(12) >= 12 - held
    probability = np.where(np.arange(12) >= 12 - held + late, 0.9, 0.1)
    outcomes = Outcomes(
        np.arange(2), np.stack([probability, np.full(12, 0.1)]), np.stack([done, done & False])
    )
    found = [gate_at(outcomes, SuccessCriterion(0.5, frames)).recall.k for frames in range(1, 8)]
    assert found == [1] * 7


def test_what_comes_later_than_an_imagined_episode_is_not_judged():
    """A success after three frames is none within two; what is predicted later is not counted."""
    probability = np.array([[0.1, 0.1, 0.9], [0.9, 0.1, 0.1], [0.1, 0.1, 0.9]])
    done = np.array([[False, False, True], [True, True, True], [False] * 3])
    whole = Outcomes(np.arange(3), probability, done)
    for outcomes, failures, mistakes, found in ((whole, 1, 1, 2), (whole.within(2), 2, 0, 1)):
        gate = gate_at(outcomes, SuccessCriterion(0.5, 1))
        assert (gate.false_positives.n, gate.false_positives.k) == (failures, mistakes)
        assert (gate.recall.n, gate.recall.k) == (3 - failures, found)
    assert whole.within(None).length.tolist() == [3, 3, 3]


def test_frames_are_scored_by_what_the_model_was_taught():
    """Where episodes end at success, their last frames are taken for solved; a model that has learnt it is
    right."""
    done = np.array([False, False, False, True, False, False, False])
    start, length = np.array([0, 4]), np.array([4, 3])
    table = SimpleNamespace(
        success_target=solved_at_end(done, start[:1], length[:1]),
        rows=lambda episodes: [slice(start[each], start[each] + length[each]) for each in episodes],
    )
    probability = np.array([[0.1, 0.9, 0.9, 0.9], [0.1, 0.1, 0.1, np.nan]])
    outcomes = Outcomes(np.arange(2), probability, np.array([[False] * 3 + [True], [False] * 4]))
    taught = outcomes.as_taught(table)
    quality = {name: each.value for name, each in done_accuracy(taught, CRITERION).items()}
    assert (quality["done_precision"], quality["done_recall"], quality["done_delay_frames"]) == (1, 1, 0)
    assert done_accuracy(outcomes, CRITERION)["done_precision"].value == pytest.approx(1 / 3)
    assert taught.held == outcomes.held == 1


def test_what_is_cut_where_imagination_ends_does_not_last():
    """Episodes end at success here, and a failure goes on after a frame that looks like one."""
    probability = np.array([[0.1, 0.9, np.nan, np.nan], [0.1, 0.9, 0.1, 0.1]])
    done = np.array([[False, True, False, False], [False] * 4])
    whole = Outcomes(np.arange(2), probability, done)
    for frames, recall in (
        (None, 1),
        (4, 1),
        (3, 0),
        (2, 0),
    ):  # a success needs three frames, from the second on
        gate = gate_at(whole.within(frames), CRITERION)
        assert (gate.recall.k, gate.false_positives.k) == (recall, 0)
    assert gate_at(whole.within(2).where(np.array([False, True])), CRITERION).false_positives.k == 0


@pytest.mark.parametrize("recorded", [4, 5])
def test_a_failure_that_looks_solved_when_imagination_ends_is_none(recorded):
    """Whether it was recorded just so long, as where an environment ends there, or a frame longer."""
    probability = np.full((2, recorded), np.nan)
    probability[0, :2] = 0.1, 0.9
    probability[1, :4] = 0.1, 0.1, 0.1, 0.9
    probability[1, 4:] = 0.1
    done = np.zeros((2, recorded), bool)
    done[0, 1] = True
    found = Outcomes(np.arange(2), probability, done).within(4)
    gate = gate_at(found, CRITERION)
    assert (gate.recall.k, gate.false_positives.k) == (1, 0)
    assert gate.auc == 1


def test_auc_is_the_share_of_pairs_in_the_right_order(outcomes):
    """Scores over three frames: successes 0.9, 0.8, 0.1; failures 0.7, 0.1. One pair ties."""
    assert outcomes.scores(3).tolist() == [0.9, 0.8, 0.1, 0.7, 0.1]
    assert outcomes.auc(3) == pytest.approx((2 + 2 + 0.5) / 6)
    wins = Outcomes(np.arange(2), np.ones((2, 4)), np.ones((2, 4), bool))
    assert math.isnan(wins.auc(3))
    assert not any("AUC" in line for line in gate_lines(gate_at(wins, CRITERION), None))
    below = np.array([[-0.3, -0.2, np.nan], [-0.3, -0.2, -0.1]])
    labels = np.array([[False, True, False], [False] * 3])
    assert Outcomes(np.arange(2), below, labels).auc(1) == 0, "a shorter episode has no frame of 0"
    assert outcomes.auc(7) == pytest.approx((2 + 2 + 1) / 6), "most successes are cut short: last frames last"
    assert Outcomes(np.arange(2), np.ones((2, 4)), np.array([[True] * 4, [False] * 4])).auc(7) == 0.5


def test_the_best_operating_point_is_tolerable_and_recognises_most(outcomes):
    best = best_operating_point(sweep(outcomes))
    assert best.criterion == SuccessCriterion(0.8, 3)
    assert (best.false_positives.k, best.recall.k) == (0, 2)
    believed = Outcomes(outcomes.episodes, np.ones((5, 6)), outcomes.done)
    assert best_operating_point(sweep(believed)) is None
    knowing = Outcomes(outcomes.episodes, outcomes.done.astype(float), outcomes.done)
    assert gate_at(knowing, SuccessCriterion(0.5, 2)).passed


def test_successes_alone_have_an_operating_point_too(outcomes):
    wins = Outcomes(outcomes.episodes[:3], outcomes.probability[:3], outcomes.done[:3])
    best = best_operating_point(sweep(wins))
    assert best is not None
    assert (best.false_positives.n, best.recall.k) == (0, 2)


def test_verdicts_of_every_episode_are_reported_as_json(outcomes):
    agreement = json.loads(json.dumps(gate_details(outcomes, gate_at(outcomes, CRITERION))))
    assert agreement["predicted_success"] == [True, True, False, True, False]
    assert agreement["recorded_success"] == [True, True, True, False, False]
    assert (agreement["failures"], agreement["true_positives"]) == (2, 2)


def test_done_by_frame_by_episode_and_how_late(outcomes):
    """By frame: 5 + 3 of 5 + 5 + 2 true ones called, and 3 + 1 false ones."""
    quality = {name: estimate.value for name, estimate in done_accuracy(outcomes, CRITERION).items()}
    assert quality["done_precision"] == pytest.approx(8 / 12)
    assert quality["done_recall"] == pytest.approx(8 / 12)
    assert quality["done_f1"] == pytest.approx(8 / 12)
    assert quality["episode_precision"] == pytest.approx(2 / 3)
    assert quality["episode_recall"] == pytest.approx(2 / 3)
    assert quality["done_delay_frames"] == pytest.approx((0 + 2) / 2)
    assert np.isnan(done_delay(outcomes, CRITERION)[2:]).all()


def test_done_is_scored_without_a_threshold_too():
    """What happened was thought likely with 0.8, 0.5 and 1; frames after an episode's end do not count."""
    probability = np.array([[0.8, 0.5, np.nan], [0.0, np.nan, np.nan]])
    done = np.array([[True, False, False], [False, False, False]])
    loss = done_log_loss(Outcomes(np.arange(2), probability, done))
    assert loss.value == pytest.approx(-(math.log(0.8) + math.log(0.5) + math.log(1)) / 3)
    surprised = done_log_loss(Outcomes(np.arange(1), np.ones((1, 1)), np.zeros((1, 1), bool)))
    assert surprised.value == pytest.approx(6 * math.log(10), rel=1e-3)


def test_early_and_late_calls_do_not_cancel(outcomes):
    outcomes.done[0, 1] = False
    quality = {name: estimate.value for name, estimate in done_accuracy(outcomes, CRITERION).items()}
    assert quality["done_delay_frames"] == pytest.approx((-1 + 2) / 2)
    assert quality["done_distance_frames"] == pytest.approx((1 + 2) / 2)


def test_without_any_success_rates_are_no_numbers():
    never = Outcomes(np.arange(3), np.zeros((3, 4)), np.zeros((3, 4), bool))
    assert math.isnan(done_accuracy(never, CRITERION)["done_f1"].value)
    assert gate_details(never, gate_at(never, CRITERION))["recall"]["share"] is None
    assert not gate_at(never, CRITERION).passed


def test_every_task_has_a_gate_of_its_own(outcomes):
    columns = {"start.task": np.array([0, 0, 1, 1, -1])}
    table: Any = SimpleNamespace(column=columns.__getitem__)
    tasks = by_task(outcomes, table)
    gates = {task: gate_at(own, CRITERION) for task, own in tasks.items()}
    assert list(gates) == ["push", "pull"]
    assert (gates["push"].recall.k, gates["push"].recall.n, gates["push"].false_positives.n) == (
        2,
        2,
        0,
    )
    assert (gates["pull"].recall.k, gates["pull"].false_positives.k) == (0, 1)
    lines = task_table(gates, {"push": gates["push"], "pull": None}).splitlines()
    assert lines[2].endswith("| – |"), "without failures nothing says how many false positives there would be"
    assert lines[3].endswith("| none |")
    assert lines[5].startswith("No recorded success of pull is recognised")
    assert len(task_table({"push": gates["push"]}, {"push": None}).splitlines()) == 3
    assert "| 0.5, 3: 0 % (0 of 1;" in task_table({"pull": gates["pull"]}, {"pull": gates["pull"]})


def test_tasks_of_own_data_are_told_by_their_instructions(outcomes):
    unknown: Any = SimpleNamespace(
        column=lambda _: np.full(5, -1), instructions=["pull", "push", "push", "pull", "push"]
    )
    tasks = by_task(outcomes, unknown)
    assert {task: own.episodes.tolist() for task, own in tasks.items()} == {"pull": [0, 3], "push": [1, 2, 4]}
    unknown.instructions = ["push"] * 5
    assert by_task(outcomes, unknown) == {}


def gate_of(false: int, failures: int, recognised: int, successes: int) -> Gate:
    return Gate(
        criterion=SuccessCriterion(0.5, 2),
        false_positives=Proportion(false, failures),
        recall=Proportion(recognised, successes),
        cut_short=0,
        repeats_last=False,
        auc=0.9,
    )


def test_the_gate_allows_five_false_positives_in_a_hundred_and_asks_for_ninety_recognised() -> None:
    assert gate_of(5, 100, 90, 100).passed
    assert not gate_of(6, 100, 100, 100).passed
    assert not gate_of(0, 100, 89, 100).passed
    allowed, tempting = gate_of(5, 100, 50, 100), gate_of(6, 100, 100, 100)
    assert best_operating_point([tempting, allowed]) is allowed

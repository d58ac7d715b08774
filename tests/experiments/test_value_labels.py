"""Advantages from labelled episodes: as weights that LeRobot reads, and as instructions."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.rewards.sarm.rabc import RABCWeights
from lerobot.utils.sample_weighting import SampleWeightingConfig, make_sample_weighter

from experiments.steps import value_labels, value_model
from experiments.steps.value_labels import (
    NEGATIVE,
    advantages,
    label,
    make_parser,
    relative_advantages,
    write_weights,
)
from experiments.steps.value_model import cross_fitted_values, deal_folds, log_loss
from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_wmrl.common.constants import KINDS
from lerobot_wmrl.common.statistics import roc_auc
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import EpisodeTable, parquet_files, read_episodes
from tests.relabelled import UNLABELLED, relabelled

DEMONSTRATIONS = 2
EPISODES = 15
"""Of which every third fails."""

POLICY = KINDS.index("policy")


@pytest.fixture(scope="module")
def rollouts(tmp_path_factory: pytest.TempPathFactory, make_synthetic_dataset: Callable[..., Any]) -> Path:
    """Two demonstrations and thirteen rollouts, in which a dot pushes a square or goes past it."""
    root = tmp_path_factory.mktemp("rollouts") / "dataset"
    make_synthetic_dataset(root, episodes=EPISODES)
    (path,) = parquet_files(root)
    rows = pq.read_table(path)
    rollout = rows["episode_index"].to_numpy() >= DEMONSTRATIONS
    kind = np.where(rollout, POLICY, KINDS.index("optimal"))
    column = rows.schema.get_field_index("start.kind")
    pq.write_table(rows.set_column(column, rows.schema.field(column), pa.array(kind)), path)
    return root


@pytest.fixture(scope="module")
def table(rollouts: Path) -> EpisodeTable:
    return read_episodes(open_dataset(rollouts))


@pytest.fixture(scope="module")
def values(table: EpisodeTable) -> np.ndarray:
    return quick_values(table, seed=0)


def quick_values(table: EpisodeTable, seed: int, steps: int = 120) -> np.ndarray:
    """Values after few steps: the made-up pictures are easy."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(value_model, "MAX_STEPS", steps)
        patch.setattr(value_model, "CHECK_EVERY", 40)
        return cross_fitted_values(table, seed)


@pytest.fixture
def known_values(values: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command takes these values instead of training again."""
    monkeypatch.setattr(value_labels, "cross_fitted_values", lambda table, seed: values)


def toy_table(success: list[bool], kind: int = POLICY) -> Any:
    """Episodes of four frames."""
    count = len(success)
    return SimpleNamespace(
        success=np.array(success),
        start=4 * np.arange(count),
        length=np.full(count, 4),
        column=lambda name: np.full(count, kind),
    )


def run(*arguments: str | Path) -> None:
    label(make_parser().parse_args([str(argument) for argument in arguments]))


def test_advantages_look_ahead_and_end_in_the_outcome() -> None:
    values = np.array([0.5, 0.6, 0.4, 0.9, 0.5, 0.3, 0.2, 0.1])
    found = advantages(values, toy_table([True, False]), steps=2)
    assert found == pytest.approx([-0.1, 0.3, 0.6, 0.1, -0.3, -0.2, -0.2, -0.1])


def test_steps_beyond_the_episode_give_the_outcome_above_the_value() -> None:
    values = np.linspace(0.1, 0.8, 8)
    found = advantages(values, toy_table([True, False]), steps=9)
    assert found == pytest.approx(np.concatenate([1 - values[:4], -values[4:]]))


def test_the_quantile_is_of_rollouts_and_demonstrations_are_positive() -> None:
    table = toy_table([True, False, True])
    table.column = lambda name: np.array([KINDS.index("human_like"), POLICY, POLICY])
    values = np.array([0.9, 0.1, 0.9, 0.1, *np.linspace(0.1, 0.8, 8)])
    relative = relative_advantages(values, table, steps=1, quantile=0.75)
    assert (relative[:4] > 0).all()
    assert (relative[4:] < 0).mean() == 0.75


def test_folds_share_successes_and_failures_equally() -> None:
    success = np.arange(30) < 12
    fold = deal_folds(success, np.random.default_rng(1))
    assert np.bincount(fold).tolist() == [10, 10, 10]
    assert np.bincount(fold[success]).tolist() == [4, 4, 4]


def test_scores_of_values() -> None:
    outcome = np.array([1, 1, 0, 0])
    assert roc_auc(np.array([0.9, 0.4, 0.5, 0.1]), outcome.astype(bool)) == 0.75
    assert log_loss(np.full(4, 0.5), outcome) == pytest.approx(np.log(2))


def test_values_of_unseen_episodes_tell_success_and_rise_towards_it(
    table: EpisodeTable, values: np.ndarray
) -> None:
    outcome = np.repeat(table.success, table.length)
    assert roc_auc(values, outcome.astype(bool)) > 0.8
    assert log_loss(values, outcome) < log_loss(np.full(len(outcome), outcome.mean()), outcome)
    ends = table.start + table.length - 1
    assert (values[ends] - values[table.start])[table.success].mean() > 0.1
    assert (values[ends] - values[table.start])[~table.success].mean() < 0


def test_no_model_values_an_episode_that_it_was_trained_on(
    table: EpisodeTable, monkeypatch: pytest.MonkeyPatch
) -> None:
    episode = np.repeat(np.arange(EPISODES), table.length)
    seen = []

    def fit(frames: Any, train: np.ndarray, held_out: np.ndarray, rng: Any) -> np.ndarray:
        assert not set(episode[train]) & set(episode[held_out])
        assert len(train) + len(held_out) == len(episode)
        seen.extend(held_out)
        return held_out

    monkeypatch.setattr(value_model, "fit_and_predict", fit)
    assert np.array_equal(cross_fitted_values(table, seed=3), np.arange(len(episode)))
    assert sorted(seen) == list(range(len(episode)))


def test_lerobot_reads_the_weights_as_relative_advantages(
    table: EpisodeTable, values: np.ndarray, tmp_path: Path
) -> None:
    relative = relative_advantages(values, table, steps=5, quantile=0.5)
    write_weights(tmp_path / "weights.parquet", table, relative)
    weights = RABCWeights(tmp_path / "weights.parquet", chunk_size=1, kappa=0.01, device=torch.device("cpu"))
    last = table.start + table.length - 1
    before_last = np.setdiff1d(np.arange(len(relative)), last)
    found = np.array([weights._compute_delta(row) for row in range(len(relative))])
    assert found[before_last] == pytest.approx(relative[before_last], abs=1e-9)
    assert not found[last].any()


@pytest.mark.usefixtures("known_values")
def test_successes_weigh_more_and_demonstrations_most(
    rollouts: Path, table: EpisodeTable, tmp_path: Path
) -> None:
    run(rollouts, f"--weights={tmp_path / 'weights.parquet'}", "--steps=5", "--quantile=0")
    config = SampleWeightingConfig(progress_path=str(tmp_path / "weights.parquet"), kappa=2.0)
    policy: Any = SimpleNamespace(config=CnnConfig(device="cpu"))
    weighter = make_sample_weighter(config, policy, torch.device("cpu"))
    found, _ = weighter.compute_batch_weights({"index": torch.arange(int(table.length.sum()))})
    mean = np.array([found[a : a + n - 1].mean() for a, n in zip(table.start, table.length, strict=True)])
    demonstrated = np.arange(EPISODES) < DEMONSTRATIONS
    assert mean[table.success & ~demonstrated].mean() > 1.1 * mean[~table.success].mean()
    assert mean[demonstrated].min() > mean[~demonstrated].max()


@pytest.mark.usefixtures("known_values")
def test_negative_actions_and_no_others_have_another_instruction(
    rollouts: Path, table: EpisodeTable, values: np.ndarray, tmp_path: Path
) -> None:
    target = tmp_path / "conditioned"
    run(rollouts, f"--conditioned={target}", "--steps=5", "--quantile=0.6")
    copy = LeRobotDataset("local/conditioned", root=target)
    tasks = np.array([copy[row]["task"] for row in range(len(copy))])
    negative = relative_advantages(values, table, steps=5, quantile=0.6) < 0
    plain = table.instructions[0]
    assert tasks.tolist() == np.where(negative, plain + NEGATIVE, plain).tolist()
    rollout = np.repeat(np.arange(EPISODES), table.length) >= DEMONSTRATIONS
    assert negative[rollout].mean() == pytest.approx(0.6, abs=0.01)
    assert not negative[~rollout].any()
    assert copy.meta.episodes[0]["tasks"] == [plain]
    first = zip(table.instructions, negative[table.start], strict=True)
    expected = [f"{text}{value_labels.NEGATIVE}" if bad else text for text, bad in first]
    assert read_episodes(copy).instructions == expected
    before, after = table.dataset[20], copy[20]
    for key in ("action", "observation.state", "observation.images.third_view"):
        assert torch.equal(before[key], after[key])


def test_a_seed_gives_its_values_again(table: EpisodeTable) -> None:
    first, again, other = (quick_values(table, seed, steps=40) for seed in (0, 0, 1))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_dataset_without_labels_is_refused(rollouts: Path, tmp_path: Path) -> None:
    root = relabelled(rollouts, tmp_path / "unlabelled", UNLABELLED)
    with pytest.raises(ValueError, match=r"root=.*unlabelled: has no column next\.success; add it"):
        run(root, f"--weights={tmp_path / 'weights.parquet'}")


@pytest.mark.parametrize(("success", "problem"), [(True, "succeeds"), (False, "fails")])
def test_a_single_outcome_is_refused(
    success: bool, problem: str, rollouts: Path, table: EpisodeTable, tmp_path: Path
) -> None:
    root = relabelled(rollouts, tmp_path / "one", {"next.success": [success] * int(table.length.sum())})
    with pytest.raises(ValueError, match=f"every episode {problem}; add rollouts with the other outcome"):
        run(root, f"--weights={tmp_path / 'weights.parquet'}")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "weights=None: nothing to write"),
        (["--weights=OUT"], "weights=.*: exists; remove it"),
        (["--conditioned=OUT"], "conditioned=.*: exists; remove it"),
        (["--weights=OUT/new", "--steps=0"], "steps=0: must be at least 1"),
        (["--weights=OUT/new", "--quantile=1"], r"quantile=1\.0: must be from 0 to below 1"),
    ],
)
def test_bad_arguments_are_refused(
    arguments: list[str], message: str, rollouts: Path, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        run(rollouts, *(argument.replace("OUT", str(tmp_path)) for argument in arguments))

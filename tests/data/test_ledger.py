"""The ledger of real episodes: it charges once, keeps to its limits, and knows an episode in any dataset."""

import json
import multiprocessing
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.constants import KINDS, START_KIND
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.data.ledger import IMAGINED, ROLLOUTS, Ledger, Limits, episode_digests, spending

LIMITS = Limits(demonstrations=6, rollouts=10)


@pytest.fixture
def table(small_dataset: LeRobotDataset) -> EpisodeTable:
    """Four optimal episodes and two near misses, all of them demonstrations."""
    return read_episodes(small_dataset)


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    return Ledger.create(tmp_path / "study" / "budget.json", LIMITS)


def entries_of(ledger: Ledger) -> dict[str, Any]:
    return json.loads(ledger.path.read_text())


def spent(ledger: Ledger) -> Counter[str]:
    return Counter(entry["spent"] for entry in ledger.read().episodes.values())


def test_every_kind_is_spent_on_something() -> None:
    kinds = {kind: spending(kind) for kind in KINDS}
    assert (kinds.pop("policy"), kinds.pop("play")) == ("rollouts", "play")
    assert set(kinds.values()) == {"demonstrations"}


def test_a_dataset_is_charged_once(ledger: Ledger, table: EpisodeTable) -> None:
    for _ in range(2):
        ledger.charge(table)
    assert spent(ledger) == {"demonstrations": 6}
    assert {entry["dataset"] for entry in ledger.read().episodes.values()} == {"dataset"}
    ledger.require_known(table)
    with pytest.raises(FieldError, match="1 more demonstrations are wanted, 0 of 6 are left"):
        ledger.require_left({"demonstrations": 1})
    content = json.loads(ledger.path.read_text())
    content["limits"]["demonstrations"] = 5  # lowered by hand
    ledger.path.write_text(json.dumps(content))
    ledger.require_left({"rollouts": 1})


def test_nothing_is_entered_beyond_a_limit(table: EpisodeTable, tmp_path: Path) -> None:
    ledger = Ledger.create(tmp_path / "budget.json", Limits(demonstrations=5, rollouts=10))
    before = ledger.path.read_text()
    with pytest.raises(FieldError, match="6 more demonstrations are wanted, 5 of 5 are left"):
        ledger.charge(table)
    assert ledger.path.read_text() == before


def test_what_a_dataset_does_not_say_can_be_said(ledger: Ledger, table: EpisodeTable) -> None:
    """A recording with the columns of another dataset may not say who acted."""
    table.columns = {name: values for name, values in table.columns.items() if name != START_KIND}
    ledger.charge(table, ROLLOUTS)
    assert spent(ledger) == {"rollouts": 6}


def test_imagined_episodes_are_known_and_cost_nothing(table: EpisodeTable, tmp_path: Path) -> None:
    ledger = Ledger.create(tmp_path / "budget.json", Limits())
    ledger.charge(table, IMAGINED)
    assert spent(ledger) == {"imagined": 6}
    ledger.require_known(table)


def test_an_unknown_episode_is_named(ledger: Ledger, table: EpisodeTable) -> None:
    with pytest.raises(FieldError, match="6 of 6 episodes are not in the budget"):
        ledger.require_known(table)
    ledger.charge(table)
    content = entries_of(ledger)
    del content["episodes"][episode_digests(table)[4]]
    ledger.path.write_text(json.dumps(content))
    ledger.require_known(table, [0, 1, 5])
    with pytest.raises(FieldError, match=r"1 of 2 episodes are not in the budget .* is episode 4;"):
        ledger.require_known(table, [0, 4])


def test_an_episode_is_known_in_any_dataset(
    ledger: Ledger, table: EpisodeTable, small_dataset: LeRobotDataset, tmp_path: Path
) -> None:
    """Merged, copied, or without the episode before it; another start or action is another episode."""
    ledger.charge(table)
    rest = delete_episodes(small_dataset, [0, 2], output_dir=tmp_path / "rest", repo_id="local/rest")
    merge_datasets([rest, small_dataset], output_repo_id="local/merged", output_dir=tmp_path / "merged")
    shutil.copytree(small_dataset.root, tmp_path / "copied")
    digests = episode_digests(table)
    merged = episode_digests(read_episodes(open_dataset(tmp_path / "merged")))
    assert merged == [digests[episode] for episode in (1, 3, 4, 5, *range(6))]
    assert episode_digests(read_episodes(open_dataset(tmp_path / "copied"))) == digests
    assert len({*digests}) == 6
    table.action[table.start[0]] += 1e-3
    table.columns["start.seed"][1] += 1
    changed = episode_digests(table)
    assert [old == new for old, new in zip(digests, changed, strict=True)] == [False, False, *[True] * 4]


def test_a_training_in_the_simulator_is_charged_once(ledger: Ledger, tmp_path: Path) -> None:
    for _ in range(2):
        ledger.charge_training(tmp_path / "study" / "rl", 6)
    assert ledger.read().trainings == {"rl": 6}
    with pytest.raises(FieldError, match="5 more rollouts are wanted, 4 of 10 are left"):
        ledger.charge_training(tmp_path / "study" / "other", 5)
    ledger.charge_training(tmp_path / "study" / "rl", 10)
    assert ledger.read().trainings == {"rl": 10}


def test_a_ledger_is_opened_again_with_the_same_limits(ledger: Ledger, table: EpisodeTable) -> None:
    ledger.charge(table)
    assert spent(Ledger.create(ledger.path, LIMITS)) == {"demonstrations": 6}
    with pytest.raises(FieldError, match="has other limits"):
        Ledger.create(ledger.path, Limits(demonstrations=7))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (None, "there is no such file"),
        ("{", "is no ledger"),
        ('{"limits": {"rollout": 3}}', "is no ledger .*'rollout'"),
        ('{"limits": {"rollouts": -3}}', r"is no ledger \(rollouts=-3: must be at least 0\)"),
    ],
)
def test_a_file_without_limits_is_refused_with_an_example(
    text: str | None, problem: str, table: EpisodeTable, tmp_path: Path
) -> None:
    path = tmp_path / "budget.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(FieldError, match=problem + '.*; write it: {"limits": {"demonstrations": 8'):
        Ledger(path).charge(table)
    assert [*tmp_path.iterdir()] == ([path] if text is not None else [])


def charge_trainings(path: Path, process: int) -> None:
    for number in range(20):
        Ledger(path).charge_training(path.parent / f"{process}_{number}", 1)


def test_two_processes_lose_no_entry_of_each_other(tmp_path: Path) -> None:
    ledger = Ledger.create(tmp_path / "budget.json", Limits(rollouts=40))
    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=charge_trainings, args=(ledger.path, each)) for each in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert sum(ledger.read().trainings.values()) == 40

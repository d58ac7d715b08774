"""What each change is worth: the tables at the top of docs/results.md."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.page.levers import LEVERS, START, Lever, Source, rows
from experiments.tables import DOCS, loader

PUBLISHED = [lever for levers in LEVERS.values() for lever in levers]
KNOWN, UNSEEN = [1, 1, 1, 0], [1, 0, 0, 0]


@pytest.mark.parametrize("lever", PUBLISHED, ids=lambda lever: lever.change)
def test_every_change_has_been_measured(lever: Lever) -> None:
    assert [*rows(loader(DOCS), lever)]


def test_the_changes_are_differences_of_the_published_shares() -> None:
    lever = next(lever for lever in PUBLISHED if lever.change == "planner distilled after PPO")
    load = loader(DOCS)
    cells = [load(path.relative_to(DOCS / "results").with_suffix("").as_posix()) for path in pull()]
    shares = [
        [cell["methods"][method][domain]["share"] for method in (lever.after, lever.before)]
        for domain in ("ind", "ood")
        for cell in cells
    ]
    known, unseen = np.subtract(*np.transpose(shares)).reshape(2, -1).mean(axis=1)
    (*_, found) = rows(load, lever)
    assert found[:4] == ["[planner distilled after PPO](#value_tasks)", "pull, cnn", "8 + 300", len(cells)]
    assert str(found[4]).startswith(f"{100 * known:+.1f} (".replace("-", "−"))
    assert str(found[5]).startswith(f"{100 * unseen:+.1f} (".replace("-", "−"))


def pull() -> list[Path]:
    return sorted((DOCS / "results" / "value_tasks").glob("pull_*.json"))


def run(success: list[int]) -> dict[str, Any]:
    return {"share": np.mean(success), "outcomes": success}


def test_ppo_is_compared_with_what_it_began_from_and_other_recordings_are_marked() -> None:
    nothing, everything = run([0] * 4), run([1] * 4)
    methods = {
        "cloning": {"ind": run(KNOWN), "ood": run(UNSEEN)},
        "filtered": {"ind": nothing, "ood": nothing},
        "imagined_ppo": {"ind": everything, "ood": everything},
    }
    cell = {
        "demonstrations": 50,
        "rollouts": 300,
        "start": "cloning",
        "real_successes": 9,
        "methods": methods,
    }
    other = {"real_successes": 8, "methods": {"dyna": {"ind": nothing, "ood": everything}}}
    cells = {
        "value_push/demonstrations50_rollouts300_seed0": cell,
        "value_dyna/demonstrations50_rollouts300_seed0": other,
    }

    def load(stem: str) -> dict[str, Any]:
        if stem not in cells:
            raise FileNotFoundError
        return cells[stem]

    source = Source("value_push", ("value_dyna",))
    ((*where, known, unseen),) = rows(load, Lever("PPO", START, "imagined_ppo", (source,)))
    assert where == ["[PPO](#value_push)", "push, cnn", "50 + 300", 1]
    assert [str(each).partition(" ")[0] for each in (known, unseen)] == ["+25.0", "+75.0"]
    ((*where, known, unseen),) = rows(load, Lever("Dyna", "imagined_ppo", "dyna", (source,)))
    assert where[2] == "50 + 300 *"
    assert [known, unseen] == ["−100.0 (−100.0 to −100.0)", "+0.0 (+0.0 to +0.0)"]
    renamed = Source("value_push", names={"success": "filtered"})
    ((*_, known, unseen),) = rows(load, Lever("reward", "success", "imagined_ppo", (renamed,)))
    assert known == unseen == "+100.0 (+100.0 to +100.0)"

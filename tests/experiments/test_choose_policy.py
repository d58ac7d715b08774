"""Which policy of a comparison a study goes on with."""

import json
from pathlib import Path
from typing import Any

import pytest

from experiments.steps.choose_policy import chosen_policy, main
from lerobot_wmrl.evaluation.comparison import most_successful


def results(better: dict[str, str | None], finished: bool = True) -> dict[str, Any]:
    shares = {"first": 0.7, "second": 0.8, "third": 0.9}
    return {
        "policies": {name: {"share": share} for name, share in shares.items()},
        "finished": finished,
        "pairs": [{"before": "first", "after": name, "better": won} for name, won in better.items()],
    }


@pytest.mark.parametrize(
    ("better", "chosen"),
    [
        ({"second": None, "third": None}, "first"),
        ({"second": "first", "third": None}, "first"),
        ({"second": "second", "third": None}, "second"),
        ({"second": "second", "third": "third"}, "third"),
    ],
)
def test_the_first_is_kept_unless_another_is_better(better: dict[str, str | None], chosen: str) -> None:
    assert chosen_policy(results(better)) == chosen


def test_being_better_than_another_one_is_not_enough() -> None:
    found = results({"second": None, "third": None})
    found["pairs"].append({"before": "second", "after": "third", "better": "third"})
    assert chosen_policy(found) == "first"


def test_an_interrupted_comparison_chooses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "comparison.json").write_text(json.dumps(results({"second": None}, finished=False)))
    monkeypatch.setattr("sys.argv", ["choose_policy", str(tmp_path)])
    with pytest.raises(SystemExit, match="the comparison is not finished: run its command again"):
        main()


def test_the_most_successful_is_the_first_of_equally_good_ones() -> None:
    found = results({})
    assert most_successful(found) == "third"
    found["policies"]["second"]["share"] = 0.9
    assert most_successful(found) == "second"
    with pytest.raises(ValueError, match="the comparison is not finished"):
        most_successful({**found, "finished": False})


def test_the_policy_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "comparison.json").write_text(json.dumps(results({"second": "second"})))
    monkeypatch.setattr("sys.argv", ["choose_policy", str(tmp_path)])
    main()
    assert capsys.readouterr().out == "second\n"

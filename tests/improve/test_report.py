"""The page and the words from a small made-up run, whose numbers are known."""

import json
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from lerobot.envs.configs import PushtEnv
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
from PIL import Image

from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.stages import read_record
from lerobot_wmrl.common.tracking import append_metrics
from lerobot_wmrl.improve.report import figures
from lerobot_wmrl.improve.report.page import Page
from lerobot_wmrl.improve.report.results import curve, lerobot_train_curve, training_curves
from lerobot_wmrl.improve.report.words import compared, trust, verdict
from lerobot_wmrl.improve.stages import CLONED, DISTILLED, PPO, Improvement
from tests.experiments.typed import check
from tests.improve.made_up import improvement_of

SUCCESSES = {"as it was": 4, CLONED: 6, PPO: 5, DISTILLED: 9}


@pytest.fixture
def finished(tmp_path: Path) -> Improvement:
    """An output folder as ten starts of each policy and nine replayed episodes would leave it."""
    improvement, out = improvement_of(tmp_path, failures=20), tmp_path
    improvement.config.real_env = PushtEnv()
    for stage in improvement.stages():
        write_json(out / "stages" / f"{stage.name}.json", {
            "name": stage.name, "title": stage.title, "command": f"run-{stage.name}", "seconds": 3.0,
            "peak_memory_bytes": 2e9,
        })  # fmt: skip
    write_json(out / "comparison" / "comparison.json", comparison([*SUCCESSES.values()]))
    write_json(out / "check" / "metrics.json", {
        "false_positives": 2, "failures": 5, "true_positives": 3, "successes": 4, "auc": 0.9,
        "dataset": "data", "split": "validation",
    })  # fmt: skip
    Image.new("RGB", (8, 8)).save(out / "check" / "comparison_success_strip.png")
    (out / "logs").mkdir()
    (out / "logs" / "cloned.log").write_text("INFO step:1 loss:2.0 \nINFO step:2 loss:1.0 \n")
    for folder in ("tokenizer", "world_model", "rl", "distilled"):
        (out / folder).mkdir()
        append_metrics(out / folder, 1, {"loss": 1.0, "policy_loss": 2.0, "success_rate": 0.5})
    return improvement


def comparison(successes: Sequence[int]) -> dict[str, Any]:
    """Return what a comparison of policies on ten starts would have written; the first is decided."""
    names = [f"policy_{number}" for number in range(len(successes))]
    pairs = [
        {"before": before, "after": after, "gained": 3, "lost": 1, "better": after if first == 0 else None}
        for first, before in enumerate(names)
        for after in names[first + 1 :]
    ]
    return {
        "policies": {name: {"k": k, "n": 10} for name, k in zip(names, successes, strict=True)},
        "pairs": pairs,
        "episodes": [{"successes": [start < k for k in successes]} for start in range(10)],
    }


def page_of(improvement: Improvement) -> Page:
    return Page.of(improvement, [read_record(improvement.out, stage) for stage in improvement.stages()])


@pytest.fixture
def without_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the figures, which take seconds, where a test is about words and numbers."""
    monkeypatch.setattr(figures, "drawn", lambda figure: "data:image/png;base64,")


def test_the_page_is_self_contained_and_says_the_numbers(finished: Improvement) -> None:
    page = page_of(finished).write(finished.out).read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", page), "the page needs other files"
    assert "<h3>Success in pusht</h3>" in page
    assert f"<td>{CLONED}</td><td>60 % (6 of 10; 31–83 %)</td>" in page
    changed = "3 starts gained, 1 lost, p = 0.62"
    assert f"<li>{DISTILLED}, against as it was: {changed}: better</li>" in page
    assert f"<li>{DISTILLED}, against {PPO}: {changed}: not decided</li>" in page
    for stage in finished.stages():
        assert f"<pre>run-{stage.name}</pre>" in page
    assert page.count("data:image/png;base64,") == 8, "bars, the replayed episode, and six curves"


@pytest.mark.usefixtures("without_drawing")
def test_a_success_in_imagination_is_said_to_be_a_belief(finished: Improvement) -> None:
    warned = "shows nothing about the real world"
    assert warned not in page_of(finished).write(finished.out).read_text()
    finished.config.real_env = None
    page = page_of(finished)
    assert warned in page.write(finished.out).read_text()
    assert (
        "<h3>Success in imagination, from frames of the dataset</h3>" in page.write(finished.out).read_text()
    )
    assert warned in verdict(finished, page.places)


@pytest.mark.usefixtures("without_drawing")
def test_the_command_that_drives_the_world_model_takes_its_flags(finished: Improvement) -> None:
    command = shlex.join(finished.drive())
    check(command)
    assert "--done_threshold=0.95" in command
    assert "--real_env.type=pusht" in command
    assert f"--policy.path={finished.out}/distilled/" in command
    assert command in page_of(finished).write(finished.out).read_text()


@pytest.mark.usefixtures("without_drawing")
def test_what_the_gate_found_is_shown_and_its_last_warning_in_red(finished: Improvement) -> None:
    fresh = {"false_positive_rate": {"k": 1, "n": 10}, "recall": {"k": 3, "n": 4}}
    gate, shown = finished.out / "rl" / "gate", '<p class="warning">'
    assert shown not in page_of(finished).write(finished.out).read_text()
    write_json(gate / "000000" / "record.json", {"warning": "many false positives", "fresh": fresh})
    page = page_of(finished).write(finished.out).read_text()
    assert f"{shown}many false positives." in page
    assert "On 14 fresh rollouts of the policy that RL began with: false positives 10 % (1 of 10;" in page
    write_json(gate / "000010" / "record.json", {"warning": None, "fresh": fresh})
    assert shown not in page_of(finished).write(finished.out).read_text()


@pytest.mark.usefixtures("without_drawing")
def test_the_summary_holds_every_headline_number(finished: Improvement) -> None:
    page_of(finished).write(finished.out)
    summary = json.loads((finished.out / "summary.json").read_text())
    place = summary["places"]["in pusht"]
    assert {title: rate["k"] for title, rate in place["policies"].items()} == SUCCESSES
    assert sum(place["outcomes"][PPO]) == SUCCESSES[PPO]
    (change,) = (
        each for each in place["changes"] if (each["after"], each["before"]) == (CLONED, "as it was")
    )
    assert (change["gained"], change["lost"], change["decision"]) == (3, 1, "better")
    assert summary["check"] == {
        "false_positives": 2,
        "failures": 5,
        "true_positives": 3,
        "successes": 4,
    }
    assert summary["gate"] is None
    assert summary["seconds"] == 3.0 * len(finished.stages())


def test_the_command_says_what_the_last_policy_gained_over_each_other_one(finished: Improvement) -> None:
    said = verdict(finished, [compared(finished)])
    path = finished.policies[CLONED]
    assert f"- {CLONED}: 60 % (6 of 10; 31–83 %), `{path}`" in said
    for other, decided in (("as it was", "better"), (CLONED, "not decided"), (PPO, "not decided")):
        assert f"- {DISTILLED}, against {other}: 3 starts gained, 1 lost, p = 0.62: {decided}" in said
    assert said.count("starts gained") == 3


def test_a_policy_that_loses_is_said_to_be_worse(finished: Improvement) -> None:
    path = finished.out / "comparison" / "comparison.json"
    found = json.loads(path.read_text())
    for pair in found["pairs"]:
        pair["better"] = pair["before"]
    write_json(path, found)
    assert verdict(finished, [compared(finished)]).count(": worse") == 3


def test_the_curves_are_those_of_the_algorithms(finished: Improvement) -> None:
    """PPO and distillation log different things; columns that are missing have no curve."""
    assert training_curves(finished) == {
        "Frame tokenizer": ([1.0], [1.0]),
        "World model": ([1.0], [1.0]),
        "Cloning": ([1.0, 2.0], [2.0, 1.0]),
        "PPO: imagined success": ([1.0], [0.5]),
        "Planner: imagined success after the policy's first steps": ([1.0], [0.5]),
        "Fitting to the planner: loss": ([1.0], [2.0]),
    }
    fitted = improvement_of(
        finished.out, policy=VQBeTConfig(device="cpu", pretrained_path=finished.out), failures=20
    )
    assert [*training_curves(fitted)] == [
        "Frame tokenizer",
        "World model",
        "Cloning",
        "Planner: imagined success after the policy's first steps",
        "Fitting to the planner: loss",
    ]


def test_curve_from_lerobots_log_lines(tmp_path: Path) -> None:
    log = tmp_path / "cloned.log"
    log.write_text(
        "INFO ot_train.py:1 step:200 smpl:2K ep:3 epch:0.10 loss:0.250 grdn:1.2 lr:1.0e-04\n"
        "Training:  10%|\rINFO step:1K smpl:9K ep:9 epch:0.20 loss:1.5e-02 grdn:1.1 lr:1.0e-04\n"
    )
    assert lerobot_train_curve(log) == ([200.0, 1000.0], [0.25, 0.015])


def test_curves_skip_rows_that_lack_the_column() -> None:
    rows = [{"step": 1, "loss": 2.0}, {"step": 2, "speed": 9.0}, {"step": 3, "loss": 1.0}]
    assert curve(rows, "loss") == ([1.0, 3.0], [2.0, 1.0])


def test_the_report_says_that_success_was_taken_for_less(tmp_path: Path) -> None:
    share = {"k": 3, "n": 4}
    point = {
        "done_threshold": 0.5,
        "done_frames": 1,
        "false_positive_rate": {"k": 0, "n": 9},
        "recall": share,
    }
    found = {"true_positives": 0, "successes": 4, "failures": 9, "false_positives": 0, "auc": 0.9}
    found |= {"dataset": str(tmp_path / "merged"), "split": "all", "seen_auc": 0.44}
    write_json(tmp_path / "check" / "metrics.json", found | {"operating_point": point})
    said = trust(improvement_of(tmp_path))
    assert "imagination took done_threshold=0.5 and done_frames=1, chosen on the same episodes" in said
    assert "3 of 4" in said
    assert "the success classifier has an AUC of 0.44: it hardly sees success in them" in said
    assert "`--size=cpu` has larger frames" in said
    assert "larger" not in trust(improvement_of(tmp_path, frame_side=64))
    assert "On 13 rollouts (most of which it has learnt from): false" in said

"""The page and the summary from a small made-up run, whose numbers are known."""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.statistics import PairedChange, Proportion
from lerobot_wmrl.common.tracking import append_metrics
from lerobot_wmrl.demo.report import figures
from lerobot_wmrl.demo.report.page import conclusion, verdict, write_report
from lerobot_wmrl.demo.report.results import lerobot_train_curve, metric_curves, success_rate
from lerobot_wmrl.demo.stages import DemoConfig, demo_stages, drive, successful
from lerobot_wmrl.maniskill.recordings import recorded_episodes
from tests.experiments.typed import check
from tests.recorded import write_recording

SUCCESSES = {
    "eval_known_cloned": 2, "eval_known_filtered": 4, "eval_known_rl": 5,
    "eval_unseen_cloned": 1, "eval_unseen_filtered": 3, "eval_unseen_rl": 2,
    "imagine_cloned": 3, "imagine_filtered": 5, "imagine_rl": 9,
    "eval_known_distilled": 6, "eval_unseen_distilled": 3, "imagine_distilled": 8,
}  # fmt: skip


@pytest.fixture
def finished(tmp_path: Path) -> DemoConfig:
    """An output folder as ten episodes of evaluation and four recorded episodes would leave it."""
    tmp_path = tmp_path / "demo"
    config = DemoConfig(tmp_path)
    write_recording(tmp_path / "dataset")
    for stage in demo_stages(config):
        record: dict[str, object] = {"name": stage.name, "title": stage.title, "command": f"run-{stage.name}"}
        record |= {"seconds": 3.0, "peak_memory_bytes": 2e9}
        write_json(
            tmp_path / "stages" / f"{stage.name}.json", {**record, "seconds": 3.0, "peak_memory_bytes": 2e9}
        )
    for folder, successes in SUCCESSES.items():
        outcomes = [i < successes for i in range(10)]
        write_json(tmp_path / folder / "eval_info.json", {"per_task": [{"metrics": {"successes": outcomes}}]})
    for policy in ("filtered", "distilled", "held_out"):
        replay = {"false_positives": 2, "failures": 5, "true_positives": 3, "successes": 4}
        write_json(tmp_path / f"replay_{policy}" / "metrics.json", replay)
        Image.new("RGB", (8, 8)).save(tmp_path / f"replay_{policy}" / "comparison_0.png")
    (tmp_path / "logs").mkdir()
    for policy in ("cloned", "filtered"):
        (tmp_path / "logs" / f"{policy}.log").write_text("INFO step:1 loss:2.0 \nINFO step:2 loss:1.0 \n")
    for folder in ("frame_tokenizer", "action_world_model", "text_world_model", "rl"):
        (tmp_path / folder).mkdir()
        append_metrics(tmp_path / folder, 1, {"loss": 1.0, "success_rate": 0.5})
    return config


@pytest.fixture
def without_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the curves, which take seconds, where a test is about words and numbers."""
    monkeypatch.setattr(figures, "drawn", lambda figure: "data:image/png;base64,")


def test_page_is_self_contained_and_says_the_numbers(finished: DemoConfig) -> None:
    stages = [stage.name for stage in demo_stages(finished)]
    page = write_report(finished, stages).read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", page), "the page needs other files"
    assert "4 of 10; 95 %: 17–69 %" in page
    assert (
        "In known scenes PPO and a planner in the world model brought success in ManiSkill from 40 % to 60 % "
        "(+20 points): of the same 10 starts, 2 were gained" in page
    )
    assert (
        "In unseen scenes PPO and a planner in the world model brought success in ManiSkill from 30 % to 30 %"
        in page
    )
    assert "40 % (2 of 5; 12–77 %)" in page
    for name in stages:
        assert f"<pre>run-{name}</pre>" in page
    assert page.count("data:image/png;base64,") >= 8


def test_the_demo_ends_by_saying_what_came_of_it(finished: DemoConfig) -> None:
    said = conclusion(finished, finished.output_dir / "report.html")
    assert "brought success in ManiSkill from 40 % to 60 %" in said
    assert "predicts 2 of 5 failures as successes (false positives) and 3 of 4 successes (recall)" in said
    assert f"Report: {finished.output_dir}/report.html" in said


@pytest.mark.usefixtures("without_drawing")
def test_the_command_that_drives_the_world_model_takes_its_flags(finished: DemoConfig) -> None:
    command = shlex.join(drive(finished))
    assert command in conclusion(finished, Path("report.html"))
    assert "--done_threshold=0.95" in command
    check(command)


def test_the_gates_last_warning_is_shown_in_red(finished: DemoConfig) -> None:
    stages, gate = [stage.name for stage in demo_stages(finished)], finished.output_dir / "rl" / "gate"
    shown = '<p class="warning">'
    assert shown not in write_report(finished, stages).read_text()
    write_json(gate / "000000" / "record.json", {"warning": "many false positives"})
    assert f"{shown}many false positives" in write_report(finished, stages).read_text()
    write_json(gate / "000010" / "record.json", {"warning": None})
    assert shown not in write_report(finished, stages).read_text()


@pytest.mark.usefixtures("without_drawing")
def test_summary_holds_every_headline_number(finished: DemoConfig) -> None:
    write_report(finished, [stage.name for stage in demo_stages(finished)])
    summary = json.loads((finished.output_dir / "summary.json").read_text())
    assert summary["policies"]["rl"]["known"]["k"] == SUCCESSES["eval_known_rl"]
    assert summary["replayed"]["filtered"]["false_positive_rate"]["share"] == 0.4
    assert summary["changes"]["known"] == {"gained": 2, "lost": 0, "p_value": 0.5}
    assert sum(summary["outcomes"]["unseen"]["rl"]) == SUCCESSES["eval_unseen_rl"]
    assert summary["dataset"] == {"episodes": 4, "frames": 12}
    assert summary["seconds"] == 3.0 * len(demo_stages(finished))


@pytest.mark.usefixtures("without_drawing")
def test_runs_with_other_seeds_stand_side_by_side(finished: DemoConfig) -> None:
    """Those beside this one, of the same size and on as many starts; each seed once."""
    config = replace(finished, eval_episodes=10)
    stages = [stage.name for stage in demo_stages(config)]
    assert "Other seeds" not in write_report(config, stages).read_text()
    own = json.loads((config.output_dir / "summary.json").read_text())
    beside = config.output_dir.parent
    changed = {**own["outcomes"]["known"], "filtered": [False] * 10, "distilled": [True] * 4 + [False] * 6}
    other = {**own, "seed": 1, "outcomes": {**own["outcomes"], "known": changed}}
    write_json(beside / "another" / "summary.json", other)
    write_json(beside / "copy" / "summary.json", own)
    write_json(beside / "tiny" / "summary.json", {**own, "preset": "tiny", "seed": 2})
    page = write_report(config, stages).read_text()
    assert "+30.0 points" in page
    assert "2 runs on the same 10 starts" in page


@pytest.mark.parametrize(
    ("gained", "lost", "words"),
    [(20, 5, "It is better than cloning"), (5, 20, "It is worse than"), (14, 9, "does not show")],
)
def test_verdict_claims_no_more_than_the_same_starts_show(gained: int, lost: int, words: str) -> None:
    before, after = Proportion(50, 100), Proportion(50 + gained - lost, 100)
    assert words in verdict("known", before, after, PairedChange(gained, lost))


def test_episode_table_reads_outcomes_by_episode(tmp_path: Path) -> None:
    write_recording(tmp_path)
    table = recorded_episodes(tmp_path)
    assert table["length"].tolist() == [3, 3, 3, 3]
    assert table["success"].tolist() == [True, False, False, True]


def test_cloning_with_successes_leaves_failures_out(tmp_path: Path) -> None:
    write_recording(tmp_path)
    assert successful(tmp_path) == "[0,3]"


def test_success_rate_counts_every_episode_of_every_task(tmp_path: Path) -> None:
    tasks = [{"metrics": {"successes": [True, False]}}, {"metrics": {"successes": [True]}}]
    (tmp_path / "eval_info.json").write_text(json.dumps({"per_task": tasks}))
    rate = success_rate(tmp_path)
    assert (rate.k, rate.n) == (2, 3)


def test_curve_from_lerobots_log_lines(tmp_path: Path) -> None:
    log = tmp_path / "cloned.log"
    log.write_text(
        "INFO ot_train.py:1 step:200 smpl:2K ep:3 epch:0.10 loss:0.250 grdn:1.2 lr:1.0e-04\n"
        "Training:  10%|\rINFO step:1K smpl:9K ep:9 epch:0.20 loss:1.5e-02 grdn:1.1 lr:1.0e-04\n"
    )
    assert lerobot_train_curve(log) == ([200.0, 1000.0], [0.25, 0.015])


def test_curves_skip_rows_and_columns_that_are_missing() -> None:
    rows = [{"step": 1, "loss": 2.0}, {"step": 2, "speed": 9.0}, {"step": 3, "loss": 1.0}]
    assert metric_curves(rows, ["loss", "accuracy"]) == {"loss": ([1.0, 3.0], [2.0, 1.0])}

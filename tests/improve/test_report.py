"""The page and the words from a small made-up run, whose numbers are known."""

import html
import json
import re
import shlex
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lerobot.envs.configs import PushtEnv
from lerobot.policies.vqbet.configuration_vqbet import VQBeTConfig
from PIL import Image

from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.tracking import append_metrics
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.evaluation.comparison import Comparison, Episode
from lerobot_wmrl.improve import commands
from lerobot_wmrl.improve.learnt import LearntEpisodes
from lerobot_wmrl.improve.progress import CLONED, DISTILLED, FITTED, PPO, SFT, Progress
from lerobot_wmrl.improve.report import figures
from lerobot_wmrl.improve.report.curves import curve, lerobot_train_curve, training_curves
from lerobot_wmrl.improve.report.page import Page
from lerobot_wmrl.improve.report.words import compared, reservations, trust, verdict
from lerobot_wmrl.improve.stages import list_stages
from tests.experiments.typed import check
from tests.improve.made_up import improvement_of

SUCCESSES = {SFT: 16, CLONED: 24, PPO: 20, DISTILLED: 36}
"""Of 40 starts."""


@pytest.fixture
def finished(tmp_path: Path) -> Progress:
    """An output folder as 40 starts of each policy and nine replayed episodes would leave it."""
    improvement, out = improvement_of(tmp_path, failures=20), tmp_path
    improvement.plan.config.real_env = PushtEnv()
    write_records(improvement)
    write_json(out / "comparison" / "comparison.json", comparison([*SUCCESSES.values()]))
    write_json(out / "start" / "comparison.json", comparison([7, 9], 10))
    write_json(out / "choice" / "comparison.json", comparison([10, 12, 13, 18], 20))
    for iteration, k in ((0, 5), (10, 8), (20, 6)):
        record = {"real": {"k": k, "n": 10}, "imagined": {"k": iteration // 2, "n": 10}}
        write_json(out / "rl" / "selection" / f"{iteration:06d}" / "record.json", record)
    write_json(
        out / "check" / "metrics.json",
        {
            "false_positives": 2,
            "failures": 5,
            "true_positives": 3,
            "successes": 4,
            "auc": 0.9,
            "dataset": "data",
            "split": "validation",
        },
    )
    Image.new("RGB", (8, 8)).save(out / "check" / "comparison_success_strip.png")
    (out / "logs").mkdir()
    (out / "logs" / "cloned.log").write_text("INFO step:1 loss:2.0 \nINFO step:2 loss:1.0 \n")
    for folder in ("tokenizer", "world_model", "rl", "distilled"):
        (out / folder).mkdir(exist_ok=True)
        append_metrics(out / folder, 1, {"loss": 1.0, "policy_loss": 2.0, "success_rate": 0.5})
    return improvement


def write_records(improvement: Progress) -> None:
    """Write those of finished stages."""
    for stage in list_stages(improvement):
        write_json(
            improvement.plan.out / "stages" / f"{stage.name}.json",
            {
                "name": stage.name,
                "title": stage.title,
                "command": f"run-{stage.name}",
                "seconds": 3.0,
                "peak_memory_bytes": 2e9,
            },
        )


def comparison(successes: Sequence[int], starts: int = 40) -> dict[str, Any]:
    """Return what a comparison of policies would have written: each succeeds from the first starts."""
    names = [f"policy_{number}" for number in range(len(successes))]
    episodes = [Episode("env", 0, seed, [seed < k for k in successes]) for seed in range(starts)]
    return Comparison(names, starts, "all", 0.06, stop_early=False, episodes=episodes).as_json()


def text_of(improvement: Progress) -> str:
    """Return the page."""
    return Page.of(improvement).write(improvement.plan.out).read_text()


@pytest.fixture
def without_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the figures, which take seconds, where a test is about words and numbers."""
    monkeypatch.setattr(figures, "drawn", lambda figure: "data:image/png;base64,")


def test_the_page_is_self_contained_and_says_the_numbers(finished: Progress) -> None:
    page = text_of(finished)
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", page), "the page needs other files"
    assert "<h3>Changes in pusht, on the same starts</h3>" in page
    path = finished.policies[CLONED]
    assert f"<tr><td>{CLONED}</td><td>60 % (24 of 40; 45–74 %)</td><td><code>{path}</code></td>" in page
    assert f'<tr class="chosen"><td>{DISTILLED}</td>' in page
    assert f"<li>{DISTILLED}, against {SFT}: 20 starts gained, 0 lost, p = 1.9e-06: better</li>" in page
    assert f"<li>{PPO}, against {CLONED}: 0 starts gained, 4 lost, p = 0.12: not decided</li>" in page
    assert "decides a pair where p is at most 0.01: 0.06 over the number of pairs" in page
    assert (
        f"RL began with: {CLONED}. Success in imagination, from frames of the dataset: {CLONED} 70 %" in page
    )
    assert "RL&#39;s checkpoint is that of iteration 10: none succeeded more often in the real" in page
    assert "on starts set aside for this: 0: 50 % (5 of 10; 24–76 %), 10: 80 % (8 of 10; " in page
    for stage in list_stages(finished):
        assert f"<pre>run-{stage.name}</pre>" in page
    assert page.count("data:image/png;base64,") == 8, "bars, the replayed episode, and six curves"


def labelled(success: np.ndarray) -> SimpleNamespace:
    """A table of episodes of one task."""
    return SimpleNamespace(
        success=success, among=lambda episodes: None, column=lambda name: np.zeros(len(success))
    )


@pytest.mark.usefixtures("without_drawing")
def test_failures_among_the_rollouts_count(finished: Progress, monkeypatch: pytest.MonkeyPatch) -> None:
    """Demonstrations alone lack them, and that was said before there were rollouts."""
    finished.plan.config.rollouts = 20
    write_records(finished)
    for failures, lacking in ((3, True), (20, False)):
        table = labelled(np.arange(60) < 60 - failures)
        monkeypatch.setattr(table, "subset", lambda among, table=table: table, raising=False)
        monkeypatch.setattr(LearntEpisodes, "table", property(lambda learnt, table=table: table))
        page = text_of(finished)
        assert f"20 rollouts of the {SFT} in pusht, exploration 0.2: {20 - failures} succeed" in page
        said = verdict(finished, [compared(finished)])
        for text in (page, said):
            assert ("failures: 3. The world model will hardly tell them from successes" in text) == lacking
            assert ("Record more rollouts" in text) == lacking


@pytest.mark.usefixtures("without_drawing")
def test_a_planner_that_could_not_be_distilled_is_left_out(finished: Progress) -> None:
    write_json(
        finished.plan.out / "stages" / "distilled.json",
        {
            "name": "distilled",
            "title": "Fit",
            "command": "run",
            "seconds": 1.0,
            "peak_memory_bytes": 1e9,
            "failed": True,
        },
    )
    write_json(finished.plan.out / "comparison" / "comparison.json", comparison([16, 24, 20]))
    write_json(finished.plan.out / "choice" / "comparison.json", comparison([10, 12, 13], 20))
    said = f"Fitting the policy to a planner failed ({finished.plan.out}/logs/distilled.log)"
    page = text_of(finished)
    assert said in page
    assert "<td>Fit, failed</td>" in page
    assert said in verdict(finished, [compared(finished)])
    assert [*finished.policies] == [SFT, CLONED, PPO]
    assert finished.chosen() == PPO
    assert "Fitting to the planner: loss" not in training_curves(finished)


@pytest.mark.usefixtures("without_drawing")
def test_rl_that_stopped_early_is_named(finished: Progress) -> None:
    stopped = f"RL stopped ({finished.plan.out}/logs/rl.log)"
    warned = f"{stopped}. A checkpoint from before that is compared. error: too far"
    assert warned not in text_of(finished)
    record = json.loads((finished.plan.out / "stages" / "rl.json").read_text())
    write_json(finished.plan.out / "stages" / "rl.json", {**record, "failed": "error: too far"})
    finished.plan.rl_checkpoint.mkdir(parents=True)
    assert warned in text_of(finished)
    assert warned in verdict(finished, [compared(finished)])
    shutil.rmtree(finished.plan.rl_checkpoint)
    assert [*finished.policies] == [SFT, CLONED, FITTED]
    assert f"{stopped}. It left no policy. error: too far" in reservations(finished)


@pytest.mark.usefixtures("without_drawing")
def test_a_success_in_imagination_is_said_to_be_a_belief(finished: Progress) -> None:
    warned = "shows nothing about the real world"
    assert warned not in text_of(finished)
    assert f"The world model: {trust(finished)}" in verdict(finished, [compared(finished)])
    finished.plan.config.real_env = None
    page = text_of(finished)
    assert warned in page
    assert "<h3>Changes in imagination, from frames of the dataset, on the same starts</h3>" in page
    assert f"The last policy: {DISTILLED}, {finished.policies[DISTILLED]}. RL can make a policy worse" in page
    assert 'class="chosen"' not in page
    assert json.loads((finished.plan.out / "summary.json").read_text())["chosen"] is None
    assert warned in verdict(finished, [compared(finished)])


@pytest.mark.usefixtures("without_drawing")
def test_one_of_several_tasks_is_driven(finished: Progress) -> None:
    config = replace(finished.plan.config, real_env=WmrlManiSkillEnv(task="pull,push"))
    several = replace(finished, plan=replace(finished.plan, config=config))
    assert "--real_env.task=pull" in commands.drive_command(several)


def test_the_command_that_drives_the_world_model_takes_its_flags(finished: Progress) -> None:
    finished.plan.config.dataset.episodes = [0, 2]
    command = shlex.join(commands.drive_command(finished))
    check(command)
    assert "--dataset.root=data " in command
    assert "--done_threshold=0.95" in command
    assert "--real_env.type=pusht" in command
    assert f"--policy.path={finished.plan.out}/distilled/" in command
    assert html.escape(command).replace("&#x27;", "&#39;") in text_of(finished)


@pytest.mark.usefixtures("without_drawing")
def test_another_round_begins_from_the_policy_to_use_on_all_episodes(
    finished: Progress, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From starts of its own."""
    assert commands.another_round_command(finished) is None
    assert "Another round" not in text_of(finished)
    finished.plan.config.rollouts, finished.plan.config.seed = 20, 7
    command = shlex.join(commands.another_round_command(finished) or [])
    check(command)
    merged = f"--dataset.root={finished.plan.out}/merged --real_env.type=pusht --rollouts=20"
    assert (
        f"--policy.path={finished.plan.out}/distilled/checkpoints/last/pretrained_model {merged}" in command
    )
    assert f"--seed=27 --output_dir={finished.plan.out}_again" in command
    assert f"--max_frames={2 * finished.plan.findings.longest} " in command, "as many as in this round"
    write_records(finished)
    table = labelled(np.arange(60) < 40)
    monkeypatch.setattr(table, "subset", lambda among: table, raising=False)
    monkeypatch.setattr(LearntEpisodes, "table", property(lambda learnt: table))
    page = text_of(finished)
    assert "<p>This records as many rollouts of the policy to use" in page
    assert html.escape(command).replace("&#x27;", "&#39;") in page


@pytest.mark.usefixtures("without_drawing")
def test_what_the_gate_found_is_shown_and_its_last_warning_in_red(finished: Progress) -> None:
    fresh = {"false_positive_rate": {"k": 1, "n": 10}, "recall": {"k": 3, "n": 4}}
    gate, shown = finished.plan.out / "rl" / "gate", '<p class="warning">'
    assert shown not in text_of(finished)
    record = {"warning": "many false positives", "failed": True, "fresh": fresh}
    write_json(gate / "000000" / "record.json", record)
    page = text_of(finished)
    assert f"{shown}many false positives. Success in imagination may rise with nothing behind it" in page
    assert "On 14 fresh rollouts of the policy that RL began with: false positives 10 % (1 of 10;" in page
    write_json(gate / "000005" / "record.json", {**record, "failed": False, "warning": "no rollout failed"})
    assert f"{shown}no rollout failed.</p>" in text_of(finished)
    write_json(gate / "000010" / "record.json", {"warning": None, "failed": False, "fresh": fresh})
    assert shown not in text_of(finished)


@pytest.mark.usefixtures("without_drawing")
def test_the_summary_holds_every_headline_number(finished: Progress) -> None:
    text_of(finished)
    summary = json.loads((finished.plan.out / "summary.json").read_text())
    place = summary["places"]["in pusht"]
    assert {title: rate["k"] for title, rate in place["policies"].items()} == SUCCESSES
    assert sum(episode["successes"][2] for episode in place["episodes"]) == SUCCESSES[PPO]
    (pair,) = (each for each in place["pairs"] if (each["after"], each["before"]) == (CLONED, SFT))
    assert (pair["gained"], pair["lost"], pair["better"]) == (8, 0, CLONED)
    assert summary["check"] == {
        "false_positives": 2,
        "failures": 5,
        "true_positives": 3,
        "successes": 4,
    }
    assert summary["gate"] is None
    assert summary["chosen"] == DISTILLED
    assert summary["seconds"] == 3.0 * len(list_stages(finished))


@pytest.mark.usefixtures("without_drawing")
@pytest.mark.parametrize(
    ("successes", "chosen"),
    [
        ([10, 12, 13, 18], DISTILLED),
        ([10, 12, 6, 12], CLONED),
        ([13, 12, 6, 13], SFT),
    ],
)
def test_the_policy_to_use_is_the_best_one_on_other_starts(
    successes: list[int], chosen: str, finished: Progress
) -> None:
    """Of equally good ones the earliest, whatever the reported starts say."""
    write_json(finished.plan.out / "choice" / "comparison.json", comparison(successes, 20))
    said, path = verdict(finished, [compared(finished)]), finished.policies[chosen]
    assert f"Policy to use: {chosen}, {path}. None succeeded more often in pusht, on starts set aside" in said
    assert said.count(": better") + said.count(": worse") + said.count(": not decided") == 3
    assert said.count(f"{chosen}, against ") + said.count(f", against {chosen}:") == 3
    assert f"--policy.path={path}" in commands.drive_command(finished)
    assert f'<tr class="chosen"><td>{chosen}</td>' in text_of(finished)
    assert json.loads((finished.plan.out / "summary.json").read_text())["chosen"] == chosen


@pytest.mark.usefixtures("without_drawing")
def test_an_rl_that_never_helped_is_said_to_be_where_it_began(finished: Progress) -> None:
    for iteration in (10, 20):
        record = {"real": {"k": 5, "n": 10}, "imagined": {"k": 9, "n": 10}}
        write_json(finished.plan.out / "rl" / "selection" / f"{iteration:06d}" / "record.json", record)
    assert "RL&#39;s checkpoint is iteration 0, the policy that RL began with: none" in text_of(finished)


def test_the_command_says_what_the_chosen_policy_gained_over_each_other_one(finished: Progress) -> None:
    said = verdict(finished, [compared(finished)])
    path = finished.policies[CLONED]
    assert f"- {CLONED}: 60 % (24 of 40; 45–74 %), `{path}`" in said
    for other, gained in ((SFT, 20), (CLONED, 12), (PPO, 16)):
        assert f"- {DISTILLED}, against {other}: {gained} starts gained, 0 lost, p = " in said
    assert said.count("starts gained") == said.count(": better") == 3


def test_a_policy_that_loses_is_said_to_be_worse(finished: Progress) -> None:
    write_json(finished.plan.out / "comparison" / "comparison.json", comparison([36, 36, 36, 16]))
    assert verdict(finished, [compared(finished)]).count(": worse") == 3


def test_the_curves_are_those_of_the_algorithms(finished: Progress) -> None:
    """PPO and distillation log different things; columns that are missing have no curve."""
    assert training_curves(finished) == {
        "Frame tokenizer": ([1.0], [1.0], "step"),
        "World model": ([1.0], [1.0], "step"),
        "Further BC": ([1.0, 2.0], [2.0, 1.0], "step"),
        "PPO: imagined success": ([1.0], [0.5], "iteration"),
        "Planner: imagined success after the policy's first steps": ([1.0], [0.5], "iteration"),
        "Fitting to the planner: loss": ([1.0], [2.0], "iteration"),
    }
    fitted = improvement_of(
        finished.plan.out, policy=VQBeTConfig(device="cpu", pretrained_path=finished.plan.out), failures=20
    )
    assert [*training_curves(fitted)] == [
        "Frame tokenizer",
        "World model",
        "Further BC",
        "Planner: imagined success after the policy's first steps",
        "Fitting to the planner: loss",
    ]


def test_curve_from_lerobots_log_lines(tmp_path: Path) -> None:
    log = tmp_path / "cloned.log"
    log.write_text(
        "INFO ot_train.py:1 step:200 smpl:2K ep:3 epch:0.10 loss:0.250 grdn:1.2 lr:1.0e-04\n"
        "Training:  10%|\rINFO step:1K smpl:9K ep:9 epch:0.20 loss:1.5e-02 grdn:1.1 lr:1.0e-04\n"
        "Training:  10%|\rINFO step:1K smpl:9K ep:9 epch:0.20 loss:0.5e-02 grdn:1.1 lr:1.0e-04\n"
    )
    assert lerobot_train_curve(log) == ([200.0, 1000.0], [0.25, 0.01], "step")


def test_curves_skip_rows_that_lack_the_column() -> None:
    rows = [{"step": 1, "loss": 2.0}, {"step": 2, "speed": 9.0}, {"step": 3, "loss": 1.0}]
    assert curve(rows, "loss") == ([1.0, 3.0], [2.0, 1.0], "step")


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
    assert "Recall is 0 at done_threshold=0.95: imagination took done_threshold=0.5 and done_frames=1" in said
    assert "3 of 4" in said
    assert "the success classifier has an AUC of 0.44: it hardly sees success in them" in said
    assert "`--size=cpu` has larger frames" in said
    assert "larger" not in trust(improvement_of(tmp_path, frame_side=64))
    assert "On 13 rollouts (most of which it has learnt from): false" in said
    improvement = improvement_of(tmp_path)
    improvement.plan.config.check = ChosenEpisodes("data/kept")
    assert "On 13 episodes of data/kept: false" in trust(improvement)

"""What imagination is worth: a cell is collected, and the section says what the cells hold."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments.page import four_tasks, rewards
from experiments.page.controls import CONTROLLED, CONTROLS, UNCHANGED, value_controls
from experiments.page.value import (
    aims,
    recorded_anew,
    value_others,
    value_push,
)
from experiments.page.value_cells import TITLES, best, gain, groups
from experiments.page.value_figure import draw_value
from experiments.run import record_path
from experiments.steps import value
from experiments.study import ROOT, Study, read_cells
from experiments.tables import loader
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.statistics import Proportion, RunsMean

STUDY = ROOT / "experiments" / "value_push.yaml"
SUCCESSES = {"cloning": 5, "filtered": 7, "weighted": 6, "imagined_ppo": 8, "planned": 9}

FAILING: dict[str, Any] = {"share": 0.4, "outcomes": [0] * 6 + [1] * 4}


def made_up_cell(demonstrations: int, seed: int) -> dict[str, Any]:
    """Ten starts, of which each method succeeds in the first ones; one more in the second seed."""
    methods = {}
    for name, successes in SUCCESSES.items():
        k = successes + bool(seed)
        rate = {"share": k / 10, "outcomes": [1] * k + [0] * (10 - k)}
        methods[name] = {"ind": rate, "ood": rate, "minutes": 2.0, "seconds_an_episode": 0.5}
    budget = {"demonstrations": demonstrations, "rollouts": 300, "seed": seed}
    return {**budget, "start": "filtered", "real_successes": 100, "methods": methods}


@pytest.fixture
def docs(tmp_path: Path) -> Path:
    """Two seeds of one budget are published, of nine cells."""
    for cell in read_cells(STUDY, ["demonstrations=8", "rollouts=300", "seed=[0,100000]"]):
        content = made_up_cell(8, cell.variables["seed"])
        write_json(tmp_path / "results" / "value_push" / f"{cell.variables['cell']}.json", content)
    return tmp_path


def test_the_section_compares_the_best_with_and_without_a_world_model(docs: Path) -> None:
    cells = groups(loader(docs))[8, 300]
    assert len(cells) == 2
    assert best(cells, ["cloning", "filtered", "weighted"], "ind") == "filtered"
    change = gain(cells, "planned", "filtered", "ood")
    assert change.mean == pytest.approx(0.2)
    assert change.low < 0.2 < change.high
    text = value_push(loader(docs))
    assert (
        "| 8 | 300 | known | filtered BC: demonstrations and successful rollouts | "
        f"{TITLES['planned']} | +20.0 points" in text
    )
    assert "from the demonstrations alone in 0 of 2 cells" in text
    assert "| 8 | 300 | BC of the demonstrations | 50, 60 → 55 %" in text


@pytest.mark.parametrize(("k", "reached"), [(10, "8 demonstrations and 300 rollouts"), (7, "no budget")])
def test_aims_and_other_episodes_are_said(docs: Path, k: int, reached: str) -> None:
    rate = {"share": k / 10, "outcomes": [1] * k + [0] * (10 - k)}
    for cell in read_cells(STUDY, ["demonstrations=8", "rollouts=300", "seed=[0,100000]"]):
        own = made_up_cell(8, cell.variables["seed"]) | {"real_successes": 100 + bool(cell.variables["seed"])}
        own["methods"] = {"ppo_distilled": {"ind": rate, "ood": rate, "minutes": 40.0}}
        write_json(docs / "results" / "value_ppo_distilled" / f"{cell.variables['cell']}.json", own)
        whole = docs / "results" / "value_push" / f"{cell.variables['cell']}.json"
        content = json.loads(whole.read_text())
        content["methods"] = {"cloning": content["methods"]["cloning"]}
        write_json(whole, content)
    load = loader(docs)
    text = " ".join(f"{aims(groups(load))} {recorded_anew(groups(load), 'ppo_distilled')}".split())
    assert f"The means reach that with {reached} alone" in text
    planner = f"{reached}, in 40 minutes" if k == 10 else reached
    assert f"It reaches both rates with {planner}." in text
    assert "300 rollouts, seed 100000 (101 successes, the others 100)" in text


def test_rounds_stand_in_the_same_table_for_the_seeds_that_have_them(docs: Path) -> None:
    (cell,) = read_cells(STUDY, ["demonstrations=8", "rollouts=300", "seed=0"])
    content = made_up_cell(8, 0)
    content["methods"] = {"iterated": content["methods"]["planned"]}
    write_json(docs / "results" / "value_iterated" / f"{cell.variables['cell']}.json", content)
    cells = groups(loader(docs))[8, 300]
    content["methods"]["iterated"] = {**content["methods"]["iterated"], "ood": {"outcomes": [1] * 10}}
    write_json(docs / "results" / "value_iterated" / f"{cell.variables['cell']}.json", content)
    assert best(groups(loader(docs))[8, 300], list(TITLES), "ood") == "planned", "the other has one seed"
    assert gain(cells, "imagined_ppo", "iterated", "ind").mean == pytest.approx(-0.1)
    assert f"| 8 | 300 | {TITLES['iterated']} | 90 %" in value_push(loader(docs))


def test_controls_are_compared_with_the_policy_that_they_begin_from(docs: Path) -> None:
    row = {"ind": FAILING, "ood": FAILING}
    made = read_cells(ROOT / "experiments" / "value_controls.yaml", ["demonstrations=8", "seed=0"])
    for cell in made:
        write_json(docs / cell.results[0], {"methods": {"imagined_ppo": row, "planned": row}})
    lines = value_controls(loader(docs)).splitlines()
    unchanged, changed = "80 %: 1 gained, 0 lost (p = 1)", "40 %: 3 gained, 6 lost (p = 0.5)"
    assert f"| 8 | 300 | 0 | {UNCHANGED} | {TITLES['imagined_ppo']} | {unchanged} | {unchanged} |" in lines
    assert [cell.variables["control"] for cell in made] == list(CONTROLS)
    for title in CONTROLS.values():
        for method in CONTROLLED:
            assert f"| 8 | 300 | 0 | {title} | {TITLES[method]} | {changed} | {changed} |" in lines
    assert not any("| 100000 |" in line for line in lines), "that seed has no controls"


def test_ppo_without_a_reward_is_compared_with_the_policy_before_it(docs: Path) -> None:
    (cell,) = read_cells(STUDY, ["demonstrations=8", "rollouts=300", "seed=0"])
    others = {"methods": {name: {"ind": FAILING, "ood": FAILING} for name in ("distilled", "unrewarded")}}
    write_json(docs / "results" / "value_others" / f"{cell.variables['cell']}.json", others)
    lines = value_others(loader(docs)).splitlines()
    assert (
        lines[-1] == "| 8 | 300 | 0 | 40 %: 3 gained, 6 lost (p = 0.5) | 40 %: 3 gained, 6 lost (p = 0.5) |"
    )


def test_methods_of_one_beginning_are_compared_with_it_seed_by_seed(docs: Path) -> None:
    """Those that were not run are left out."""
    for cell in read_cells(ROOT / "experiments" / "value_rewards.yaml", ["seed=[0,100000]"]):
        content = {**made_up_cell(8, cell.variables["seed"]), "starts": 10}
        content["methods"]["success"] = {"ind": FAILING, "ood": FAILING, "minutes": 7.0}
        if cell.variables["seed"]:
            content["methods"]["grpo"] = content["methods"]["filtered"]
            content["methods"]["longer_filtered"] = content["methods"]["filtered"]
        write_json(docs / cell.results[0], content)
    lines = rewards.section(loader(docs)).splitlines()
    title = rewards.TITLES["success"]
    assert f"| {title} | 40, 40 → 40 % (10–70) | 40, 40 → 40 % (10–70) | 7 |" in lines
    assert len([line for line in lines if line.startswith("| 0 |")]) == 1
    assert not any("Student" in line for line in lines)
    before, over_rival = "\n".join(lines).split("Against filtered BC, three times as many steps")
    assert before.count("| 100000 |") == 3
    assert over_rival.count("| 100000 |") == 2


def test_gains_of_three_seeds_have_an_interval_over_these(docs: Path) -> None:
    for cell in read_cells(ROOT / "experiments" / "value_rewards.yaml"):
        content = {**made_up_cell(8, cell.variables["seed"]), "starts": 10}
        content["methods"]["longer_filtered"] = {"ind": FAILING, "ood": FAILING, "minutes": 7.0}
        content["methods"]["success"] = content["methods"]["filtered"]
        write_json(docs / cell.results[0], content)
    title = rewards.TITLES["success"]
    (row,) = [line for line in rewards.section(loader(docs)).splitlines() if " to +" in line]
    assert row == f"| {title} | +36.7 (+22.3 to +51.0) | +36.7 (+22.3 to +51.0) |", "30, 40 and 40 points"


MAY_DIFFER = {
    "output_dir",
    "dataset.root",
    "model.tokenizer_path",
    "env.world_model_path",
    "policy.world_model_path",
    "policy.proposal_path",
}
"""Flags of a control that name its own dataset and models."""


@pytest.mark.parametrize(
    ("studies", "controls", "begins", "number"),
    [
        (["value_push"], "value_controls", "start", 7),
        (["value_push", "value_act"], "value_act_controls", "filtered", 5),
    ],
)
def test_a_control_differs_from_the_study_in_nothing_but_the_world_model(
    studies: list[str], controls: str, begins: str, number: int
) -> None:
    """Its PPO and its planner have the settings of the rows that they are compared with."""
    given = ["demonstrations=8", "rollouts=300", "seed=0"]
    cells = [read_cells(STUDY.parent / f"{name}.yaml", given)[0] for name in studies]
    control, *_ = read_cells(STUDY.parent / f"{controls}.yaml", ["demonstrations=8", "seed=0"])
    assert control.variables["run"] == str(cells[0].folder)
    steps = {step.name: set(step.command.partition(" || ")[0].split()) for step in control.steps}
    compared = {step.name: step for cell in cells for step in cell.steps}
    compared = {name: compared[name] for name in steps if name != "dataset" and name in compared}
    assert len(compared) == number
    assert begins not in steps, "the policy that the methods begin from is the study's"
    for name, step in compared.items():
        words, budgets = set(step.command.split()), {f"--budget={cell.budget}" for cell in cells}
        for word in steps[name] ^ words - budgets:
            flag = word[2:].partition("=")[0]
            own = flag == "policy.path" and name.startswith("eval_")
            assert own or flag in MAY_DIFFER, (name, word)


def test_a_figure_is_drawn(docs: Path) -> None:
    path = docs / "images" / "value.png"
    draw_value(loader(docs), path)
    assert path.stat().st_size > 10_000


def test_nothing_is_drawn_without_a_cell(tmp_path: Path) -> None:
    for draw in (draw_value, four_tasks.draw):
        draw(loader(tmp_path), tmp_path / "value.png")
        assert not (tmp_path / "value.png").exists()


def finish_cell(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write what the study's steps leave, but for evaluations and the steps' records."""
    episodes = {str(episode): {"spent": "rollouts"} for episode in range(208)}
    write_json(study.budget, {"limits": {}, "episodes": episodes, "trainings": {"dyna": 100}})
    (study.folder / "dataset").mkdir()
    first, second = (f"runs/{name}/checkpoints/003000" for name in ("filtered", "cloning"))
    comparison = {
        "policies": {first: {"share": 0.5}, second: {"share": 0.7}},
        "finished": True,
        "pairs": [{"before": first, "after": second, "better": second}],
    }
    write_json(study.folder / "comparison" / "comparison.json", comparison)
    monkeypatch.setattr(value, "open_dataset", lambda root: root)
    monkeypatch.setattr(value, "read_episodes", lambda _: SimpleNamespace(success=np.arange(308) < 140))


def write_outcomes(folder: Path, k: int) -> None:
    """As lerobot-eval does: k successes, then failures, ten in all."""
    task = {"metrics": {"successes": [True] * k + [False] * (10 - k)}}
    write_json(folder / "eval_info.json", {"per_task": [task]})


def write_records(study: Study) -> None:
    for step in study.steps:
        write_json(record_path(study.folder, step.name), {"seconds": 60.0})


def test_a_cell_keeps_outcomes_and_minutes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = read_cells(STUDY, ["demonstrations=8", "rollouts=300", "seed=0", f"output_dir={tmp_path}"])[0]
    for name, k in SUCCESSES.items():
        for domain in ("ind", "ood"):
            write_outcomes(study.folder / f"eval_{name}_{domain}", k)
    finish_cell(study, monkeypatch)
    with pytest.raises(ValueError, match="step cloning is not finished"):
        value.cell(study)
    write_records(study)
    (content,) = value.cell(study).values()
    assert (content["real_episodes"], content["real_successes"]) == (308, 140)
    assert content["start"] == "cloning"
    assert content["imagined"] == {"filtered": 0.5, "cloning": 0.7}
    assert content["methods"]["planned"]["minutes"] == 6
    assert content["methods"]["planned"]["seconds_an_episode"] == 6
    assert content["methods"]["filtered"]["ind"]["outcomes"] == [1] * 7 + [0] * 3
    assert content["methods"].keys() == SUCCESSES.keys()
    json.dumps(content)


def test_four_tasks_are_collected_and_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = ROOT / "experiments" / "value_four_tasks.yaml"
    study = read_cells(path, ["seed=0", f"output_dir={tmp_path / 'runs'}"])[0]
    for method, k in {"cloning": 5, "longer": 4, "filtered": 3, "imagined_ppo": 8}.items():
        for task in study.variables["tasks"]:
            better = task == "pull" and method == "filtered"
            for domain in ("ind", "ood"):
                write_outcomes(study.folder / f"eval_{method}_{task}_{domain}", 6 if better else k)
    finish_cell(study, monkeypatch)
    compared = study.folder / "comparison" / "comparison.json"
    content = json.loads(compared.read_text())
    content["policies"]["runs/longer/checkpoints/015000"] = {"share": 0.6}
    write_json(compared, content)
    rate = Proportion(4, 10).as_json()
    gates = {"push": {"false_positive_rate": rate, "recall": Proportion(9, 10).as_json()}}
    write_json(study.folder / "check" / "metrics.json", {"gate_by_task": gates})
    write_records(study)
    ((name, content),) = value.four_tasks(study).items()
    assert content["minutes"] == {"cloning": 1, "longer": 2, "filtered": 2, "imagined_ppo": 7}
    write_json(tmp_path / "results" / "value_four_tasks" / f"{name}.json", content)
    text = four_tasks.section(loader(tmp_path))
    known = "| push | known | 50 % (20–80) | 40 % (10–70) | 30 % (10–60)"
    unseen = "| pull | unseen | 50 % (20–80) | 40 % (10–70) | 60 % (30–90)"
    assert f"{known} | 80 % (50–100) |" in text
    assert f"{unseen} | 80 % (50–100) |" in text
    assert "| push | known | +30.0 points" in text
    assert "| pull | unseen | +20.0 points" in text
    assert "| all four | known | 50 % (35–65) | 40 % (" in text
    begun = "that succeeds most often there: with seed 0 BC (filtered BC 50 %, BC 70 %, longer BC 60 % of "
    assert begun in text
    assert "| 0 | push | 4 of 10, 40 % (17–69) | 9 of 10, 90 % (60–98) |" in text
    part = {**content, "minutes": {"simulated_ppo": 3}, "tasks": {}}
    for task in content["tasks"]:
        rates = {"ind": Proportion(9, 10), "ood": Proportion(2, 10)}
        part["tasks"][task] = {
            domain: {"simulated_ppo": {**rate.as_json(), "outcomes": [1] * rate.k + [0] * (10 - rate.k)}}
            for domain, rate in rates.items()
        }
    write_json(tmp_path / "results" / "value_four_tasks_simulator" / f"{name}.json", part)
    text = four_tasks.section(loader(tmp_path))
    assert f"{known} | 90 % (70–100) | 80 % (50–100) |" in text
    assert re.search(r"\| push \| known \| \+30\.0 points .* \| -10\.0 points .* \| \+40\.0 points ", text)
    four_tasks.draw(loader(tmp_path), tmp_path / "four.png")
    assert (tmp_path / "four.png").stat().st_size > 10_000
    another = {**content, "seed": 100000}
    write_json(tmp_path / "results" / "value_four_tasks" / f"{name[:-1]}100000.json", another)
    text = four_tasks.section(loader(tmp_path))
    assert "Run with some seeds alone: PPO in ManiSkill with seed 0." in text
    assert "| push | known | 50, 50 → 50 % (20–80) | 40, 40 → 40 %" in text


def test_an_interval_over_runs_and_starts_covers_the_mean_of_both() -> None:
    """Runs and starts have effects of their own; the interval misses the true mean in few cases."""
    rng, missed = np.random.default_rng(0), {"both": 0, "starts": 0}
    for _ in range(60):
        rate = 0.5 + rng.normal(0, 0.1, (8, 1)) + rng.normal(0, 0.15, (1, 60))
        found = (rng.random((8, 60)) < rate).astype(float)
        both, pooled = RunsMean.over(found), RunsMean.over(found.reshape(1, -1))
        missed["both"] += not both.low <= 0.5 <= both.high
        missed["starts"] += not pooled.low <= 0.5 <= pooled.high
    assert missed["both"] <= 8
    assert missed["starts"] > 2 * missed["both"], "outcomes of the same runs are not independent"

"""The studies as committed: every file parses, today's commands take its flags, every result has one."""

from pathlib import Path

import pytest

from experiments.budget import check_commands
from experiments.page.contents import CHAPTERS
from experiments.run import provenance
from experiments.study import ROOT, read_cells
from experiments.tables import results_page
from tests.experiments.typed import check

CELLS = {path.stem: read_cells(path) for path in sorted((ROOT / "experiments").glob("*.yaml"))}
STUDIES = {name: cells[0] for name, cells in CELLS.items()}


@pytest.mark.parametrize("name", STUDIES)
def test_todays_commands_take_the_flags_of_every_step(name: str) -> None:
    for step in STUDIES[name].steps:
        check(step.command)


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_writes_into_its_own_folder(name: str) -> None:
    study = STUDIES[name]
    for step in study.steps:
        assert step.output is None or study.folder in [step.output, *step.output.parents], step.name


@pytest.mark.parametrize("name", [name for name, study in STUDIES.items() if study.limits])
def test_every_command_of_a_study_with_a_budget_has_it(name: str) -> None:
    check_commands(STUDIES[name])


@pytest.mark.parametrize("name", STUDIES)
def test_what_a_study_needs_is_there(name: str) -> None:
    """Its commands read no folder of a study that it does not name."""
    study = STUDIES[name]
    assert set(study.needs) <= STUDIES.keys()
    read = {word for step in study.steps for word in STUDIES if f"experiments/{word}/" in step.command}
    assert read <= {study.name, *study.needs}


def test_every_result_is_made_by_exactly_one_study() -> None:
    made = [result for cells in CELLS.values() for study in cells for result in study.results]
    assert len(made) == len(set(made))
    docs = ROOT / "docs"
    committed = {str(path.relative_to(docs)) for path in (docs / "results").rglob("*") if path.is_file()}
    due = {
        result
        for cells in CELLS.values()
        for result in cells[0].results
        if len(cells) == 1 and result.startswith("results/")
    }
    assert due <= committed <= set(made), "a study with cells may have published some of them"


def test_what_cells_publish_is_collected() -> None:
    """No step writes it, and a study does not inherit how: hours later nothing could be published."""
    assert [name for name, cells in CELLS.items() if len(cells) > 1 and not cells[0].collect] == []


def test_every_study_with_results_has_a_section() -> None:
    told = {name for name, study in STUDIES.items() if any(r.endswith(".json") for r in study.results)}
    assert told == {name for sections in CHAPTERS.values() for name in sections}


def test_the_committed_page_is_what_the_json_says() -> None:
    assert (ROOT / "docs" / "results.md").read_text() == results_page(), "run python -m experiments.tables"


def test_results_say_where_they_come_from(tmp_path: Path) -> None:
    (study,) = read_cells(ROOT / "experiments" / "planning.yaml", [f"output_dir={tmp_path}"])
    assert provenance(study)["commands"]["eval_ood"].startswith("lerobot-eval --policy.type=wm_mpc")

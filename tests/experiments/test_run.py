"""The runner of studies: it resumes, refuses what has changed, and publishes with provenance."""

import json
import shutil
import sys
from pathlib import Path

import pytest

from experiments.run import StudyError, main, publish, run_study
from experiments.study import Study, read_cells

COUNT = """
question: How often
  does it run?
variables: {seeds: [0, 1], word: one, greeting: hello $word}
steps:
  - name: say_$seed
    for: {seed: seeds}
    command: >
      mkdir -p $output_dir && echo '{greeting: $greeting}' $$((1 + 1))
      >> $output_dir/said_$seed
  - name: result
    command: echo '{"n":' $$(cat $output_dir/said_* | wc -l)'}' > $output_dir/count.json
results: [results/count.json]
"""


@pytest.fixture
def study_file(tmp_path: Path) -> Path:
    path = tmp_path / "count.yaml"
    path.write_text(COUNT)
    return path


def read(path: Path, *given: str) -> Study:
    (study,) = read_cells(path, [f"output_dir={path.parent / 'out'}", *given])
    return study


def lines(study: Study) -> list[str]:
    return [line for path in sorted(study.folder.glob("said_*")) for line in path.read_text().splitlines()]


def test_commands_are_as_a_user_types_them(study_file: Path) -> None:
    study = read(study_file)
    assert study.question == "How often does it run?"
    assert [step.name for step in study.steps] == ["say_0", "say_1", "result"]
    out = study_file.parent / "out"
    assert study.steps[0].command == (
        f"mkdir -p {out} && echo '{{greeting: hello one}}' $((1 + 1)) >> {out}/said_0"
    )


def test_a_finished_step_is_not_repeated(study_file: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run_study(read(study_file))
    assert f"$ {read(study_file).steps[0].command}" in capfd.readouterr().out
    run_study(read(study_file))
    assert lines(read(study_file)) == ["{greeting: hello one} 2"] * 2
    assert "[1/3] say_0: done in" in capfd.readouterr().out


def test_a_failed_step_is_run_again_and_those_before_it_are_not(study_file: Path) -> None:
    broken = study_file.with_name("broken.yaml")
    broken.write_text(COUNT.replace('echo \'{"n"', 'false && echo \'{"n"'))
    with pytest.raises(StudyError, match=r"result: exit status 1\. Run the study again"):
        run_study(read(broken))
    run_study(read(study_file))
    assert len(lines(read(study_file))) == 2


def test_a_changed_command_is_refused_or_repeated(study_file: Path) -> None:
    run_study(read(study_file))
    with pytest.raises(StudyError, match="say_0 was finished with another command") as refused:
        run_study(read(study_file, "word=two"))
    assert "hello one" in str(refused.value)
    assert "hello two" in str(refused.value)
    assert len(lines(read(study_file))) == 2
    run_study(read(study_file, "word=two"), repeat=True)
    assert sum("hello two" in line for line in lines(read(study_file))) == 2


TWO = """
question: x
variables: {word: one}
steps:
  - name: a
    command: mkdir -p $output_dir/a && echo $word --output_dir=$output_dir/a > $output_dir/a/said
  - name: b
    command: test -e $output_dir/b || cp -r $output_dir/a $output_dir/b; true --output_dir=$output_dir/b
"""


def test_an_interrupted_repetition_is_repeated(study_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study_file.write_text(TWO)
    run_study(read(study_file))

    def interrupt(folder: Path) -> None:
        raise KeyboardInterrupt

    changed = read(study_file, "word=two")
    with monkeypatch.context() as patched:
        patched.setattr(shutil, "rmtree", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run_study(changed, repeat=True)
    with pytest.raises(StudyError, match="finished with another command"):
        run_study(changed)
    run_study(changed, repeat=True)
    assert (changed.folder / "b" / "said").read_text().startswith("two")


def test_a_step_that_is_missing_is_not_put_before_what_was_made_without_it(study_file: Path) -> None:
    study_file.write_text(TWO)
    study = read(study_file)
    run_study(study)
    (study.folder / "steps" / "a.json").unlink()
    with pytest.raises(StudyError, match=r"^a is not finished, but steps after it are"):
        run_study(study)
    (study.folder / "b" / "said").unlink()
    run_study(study, repeat=True)
    assert (study.folder / "b" / "said").is_file()


def test_a_study_that_is_not_finished_is_no_ground_for_another(study_file: Path) -> None:
    needed = study_file.with_name("needed.yaml")
    needed.write_text(COUNT.replace('echo \'{"n"', 'false && echo \'{"n"'))
    study_file.write_text("needs: [needed]\n" + COUNT)
    folder = study_file.parent / "made"
    study = read(study_file, f"needed={folder}")
    with pytest.raises(StudyError, match="exit status 1"):
        run_study(read(needed, f"output_dir={folder}"))
    with pytest.raises(StudyError, match=rf"^needs needed, and {folder} is not finished"):
        run_study(study)
    needed.write_text(COUNT)
    run_study(read(needed, f"output_dir={folder}"), repeat=True)
    run_study(study)
    publish(study, study_file.parent / "docs")
    source = json.loads((study_file.parent / "docs/results/count.json").read_text())["provenance"]
    assert source["needs"] == {"needed": source["commit"]}


def test_results_are_published_with_commit_machine_and_commands(study_file: Path) -> None:
    study = read(study_file)
    run_study(study)
    assert publish(study, study_file.parent / "docs") == [study_file.parent / "docs/results/count.json"]
    content = json.loads((study_file.parent / "docs/results/count.json").read_text())
    assert content["n"] == 2
    source = content["provenance"]
    assert (source["study"], list(source["commands"])) == ("count", ["say_0", "say_1", "result"])
    assert source["commit"]
    assert "cores" in source["machine"]


def test_a_result_that_no_step_wrote_is_named(study_file: Path) -> None:
    study = read(study_file)
    run_study(study)
    (study.folder / "count.json").unlink()
    with pytest.raises(StudyError, match=r"count\.json is missing"):
        publish(study, study_file.parent / "docs")


def test_what_is_needed_must_be_there(study_file: Path) -> None:
    """Of a study with cells, the cell with the same values."""
    study_file.write_text("needs: [needed]\ncells: {letter: [a, b], seed: [0, 1]}\n" + COUNT)
    needed = study_file.with_name("needed.yaml")
    needed.write_text("cells: {seed: [0, 1]}\n" + COUNT)
    folder = study_file.parent / "made"
    (one,) = read_cells(needed, ["seed=1", f"output_dir={folder}"])
    run_study(one)
    both = read_cells(
        study_file, ["letter=b", f"output_dir={study_file.parent / 'out'}/", f"needed={folder}/"]
    )
    assert [str(study.folder) for study in both] == [f"{study_file.parent}/out/b_seed{k}" for k in (0, 1)]
    with pytest.raises(StudyError, match=rf"needs needed, of which {folder}/seed0 holds nothing: run"):
        run_study(both[0])
    run_study(both[1])
    study_file.write_text("needs: [needed]\n" + COUNT)
    with pytest.raises(ValueError, match="`cells` lacks seed, which makes the cells of needed"):
        read_cells(study_file)


def test_a_value_that_makes_a_cell_may_bring_more_variables(study_file: Path) -> None:
    study_file.write_text("cells: {letter: {a: {word: $output_dir/x}, b: {word: why}}}\n" + COUNT)
    words = [study.variables["word"] for study in read_cells(study_file, ["output_dir=out"])]
    assert words == ["out/a/x", "why"]
    with pytest.raises(ValueError, match="letter=c: there are a, b"):
        read_cells(study_file, ["letter=c"])


def test_a_value_that_makes_a_cell_replaces_an_inherited_variable(study_file: Path) -> None:
    child = study_file.with_name("child.yaml")
    child.write_text("extends: count.yaml\ncells: {word: [two, three]}\n")
    cells = read_cells(child, ["output_dir=out"])
    assert [study.variables["greeting"] for study in cells] == ["hello two", "hello three"]


def test_only_what_the_step_itself_writes_is_deleted(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.mkdir()
    text = "question: x\nsteps:\n  - {name: a, fresh: true, command: 'true --output_dir=FOLDER'}\n"
    path = tmp_path / "fresh.yaml"
    path.write_text(text.replace("FOLDER", str(precious)))
    with pytest.raises(StudyError, match="nothing was deleted"):
        run_study(read(path))
    assert precious.exists()
    path.write_text(text.replace("FOLDER", "$output_dir/left"))
    left = tmp_path / "out" / "left"
    left.mkdir(parents=True)
    run_study(read(path))
    assert not left.exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (COUNT + "colour: red\n", "unknown key colour"),
        (COUNT.replace("$word", "$wrd"), r"\$wrd in .* there is no such variable"),
        (COUNT.replace("say_$seed", "say"), "steps with the same name: say"),
        (COUNT.replace("name: result", "name: result\n    fresh: true"), "step result: `fresh` needs a flag"),
        ("question: x\nsteps: [say]\n", r"step say: write its name and command; .* \(it extends none\)"),
    ],
)
def test_mistakes_are_named(study_file: Path, text: str, message: str) -> None:
    study_file.write_text(text)
    with pytest.raises(ValueError, match=message):
        read(study_file)


def test_a_variable_that_is_not_there_cannot_be_set(study_file: Path) -> None:
    with pytest.raises(ValueError, match="sed=3: give name=value, with one of output_dir, seeds"):
        read(study_file, "sed=3")


def test_a_study_may_extend_another(study_file: Path) -> None:
    other = study_file.with_name("other.yaml")
    other.write_text("question: Again?\nextends: count.yaml\nvariables: {word: three}\n")
    study = read(other)
    assert "hello three" in study.steps[0].command
    assert (study.name, study.results) == ("other", ())


def test_a_step_of_the_extended_study_may_be_named_alone(study_file: Path) -> None:
    other = study_file.with_name("other.yaml")
    other.write_text(
        "question: Again?\nextends: count.yaml\nvariables: {word: three}\n"
        "steps:\n  - {name: first, command: echo $word}\n  - say_$seed\n"
    )
    names, commands = zip(*((step.name, step.command) for step in read(other).steps), strict=True)
    assert names == ("first", "say_0", "say_1")
    assert "hello three" in commands[1]
    other.write_text("question: x\nextends: count.yaml\nsteps: [say]\n")
    with pytest.raises(ValueError, match=r"step say: .* \(say_\$seed, result\)"):
        read(other)


CELLS = """
question: How many?
cells: {size: [1, 2], word: [a, b]}
steps:
  - name: say
    command: mkdir -p $output_dir && echo '{"n":' $size'}' > $output_dir/$cell.json
results: [results/sizes/$cell.json]
"""


def test_every_cell_has_a_folder_and_results_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "sizes.yaml"
    path.write_text(CELLS)
    cells = read_cells(path, [f"output_dir={tmp_path / 'out'}", "word=b"])
    assert [cell.variables["cell"] for cell in cells] == ["size1_b", "size2_b"]
    for cell in cells:
        run_study(cell)
        assert publish(cell, tmp_path / "docs") == [
            tmp_path / "docs/results/sizes" / f"{cell.variables['cell']}.json"
        ]
        assert (cell.folder / "steps" / "say.json").exists()
    assert json.loads((tmp_path / "docs/results/sizes/size2_b.json").read_text())["n"] == 2


def test_a_cell_whose_results_are_published_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "sizes.yaml"
    path.write_text(CELLS)
    for given, ran in ((["size=1"], 2), ([], 2), ([], 0)):
        places = f"output_dir={tmp_path / 'out'}", f"--docs={tmp_path / 'docs'}"
        monkeypatch.setattr(sys, "argv", ["run", str(path), *given, *places])
        main()
        assert capfd.readouterr().out.count("$ mkdir") == ran


def test_a_cell_that_publishes_nothing_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "sizes.yaml"
    path.write_text(CELLS[: CELLS.index("results:")])
    monkeypatch.setattr(sys, "argv", ["run", str(path), "size=1", f"output_dir={tmp_path / 'out'}"])
    main()
    assert capfd.readouterr().out.count("$ mkdir") == 2


def test_cells_are_chosen_from_those_that_there_are(tmp_path: Path) -> None:
    path = tmp_path / "sizes.yaml"
    path.write_text(CELLS)
    with pytest.raises(ValueError, match="size=7: there are 1, 2"):
        read_cells(path, ["size=[2,7]", "word=a"])
    assert [each.variables["cell"] for each in read_cells(path, ["size=2", "word=a"])] == ["size2_a"]

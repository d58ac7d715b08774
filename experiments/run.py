"""Run a study: every command once, in order, then its results into docs/.

    python -m experiments.run experiments/gate.yaml
    python -m experiments.run experiments/gate.yaml steps=200 output_dir=outputs/short --docs=outputs/docs
    python -m experiments.run experiments/rl_comparison.yaml --dry_run

    python -m experiments.run experiments/value_push.yaml demonstrations=8 seed=[0,100000]

Commands are printed before they run. The same call again continues: a finished step is not repeated. A step
whose command has changed since it was finished is refused, unless `--repeat` says that it and the steps after
it are to run again. `name=value` sets one of the study's variables, or restricts its cells. A study with
cells runs one after the other; a cell whose results are in docs/ already is left out, unless `--repeat` is
given.
"""

import argparse
import importlib
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from experiments import budget
from experiments.budget import StudyError
from experiments.study import ROOT, Step, Study, read_cells
from lerobot_wmrl.common.files import write_json

RECORDS: Final = "steps"
PROVENANCE: Final = "provenance"
RUNNING: Final = "running"
"""A file in the folder of a study that is not finished."""


def run_study(study: Study, repeat: bool = False) -> None:
    """Run every step that is not finished.

    Raises:
        StudyError: a needed study has not been run, a command has changed, a command fails, or learns from
            episodes that are not in the study's budget.
    """
    for name, folder in study.needs.items():
        if not (folder / RECORDS).exists():
            raise StudyError(
                f"needs {name}, of which {folder} holds nothing: run experiments/{name}.yaml first, or give "
                f"{name}=FOLDER"
            )
        if (folder / RUNNING).exists():
            raise StudyError(
                f"needs {name}, and {folder} is not finished: run experiments/{name}.yaml to its end first"
            )
    budget.begin(study)
    for number, step in enumerate(study.steps, start=1):
        heading = f"[{number}/{len(study.steps)}] {step.name}"
        record = read_record(study.folder, step.name)
        later = study.steps[number:]
        if record is None and any(read_record(study.folder, each.name) for each in later):
            if not repeat:
                raise StudyError(
                    f"{step.name} is not finished, but steps after it are, without what it makes now. Give "
                    "--repeat to run them again too, or another output_dir=FOLDER."
                )
            forget(study, later)
        if record is None:
            run_step(study, step, heading)
        elif record["command"] == step.command:
            print(f"{heading}: done in {record['seconds']:.0f} s", flush=True)
        elif repeat:
            print(f"{heading}: its command has changed, so it and what follows is repeated", flush=True)
            forget(study, study.steps[number - 1 :])
            run_step(study, step, heading)
        else:
            raise StudyError(
                f"{step.name} was finished with another command.\n  then: {record['command']}\n"
                f"  now:  {step.command}\nGive --repeat to run it and all steps after it again, or another "
                "output_dir=FOLDER."
            )
    (study.folder / RUNNING).unlink(missing_ok=True)


def run_step(study: Study, step: Step, heading: str) -> None:
    """Print one command, run it, and record that it is finished."""
    study.folder.mkdir(parents=True, exist_ok=True)
    (study.folder / RUNNING).touch()
    if step.fresh:
        delete(written_by(study, [step]))
    checked = budget.check_datasets(study, step)
    print(f"\n{heading}\n$ {step.command}", flush=True)
    commands = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{commands}{os.pathsep}{os.environ['PATH']}"}
    began, ran = time.monotonic(), commit()
    status = subprocess.run(["bash", "-euo", "pipefail", "-c", step.command], env=environment).returncode
    if status != 0:
        raise StudyError(f"{step.name}: exit status {status}. Run the study again to continue here.")
    budget.check_datasets(study, step, checked)
    seconds = round(time.monotonic() - began, 1)
    finished = {"command": step.command, "seconds": seconds, "commit": ran, "machine": machine()}
    write_json(record_path(study.folder, step.name), finished)


def record_path(folder: Path, step: str) -> Path:
    """Return where a step of the study in this folder is recorded."""
    return folder / RECORDS / f"{step}.json"


def read_record(folder: Path, step: str) -> dict[str, Any] | None:
    """Return what was recorded of a finished step, None if it is not finished."""
    path = record_path(folder, step)
    return json.loads(path.read_text()) if path.exists() else None


def forget(study: Study, steps: Sequence[Step]) -> None:
    """Delete the folders that steps wrote, and then their records, the first step's last: until then, a
    changed command is refused."""
    delete(written_by(study, steps))
    for step in reversed(steps):
        record_path(study.folder, step.name).unlink(missing_ok=True)


def written_by(study: Study, steps: Iterable[Step]) -> list[Path]:
    """Return the folders that steps write within the study's own. StudyError if one is outside it."""
    own = study.folder.resolve()
    folders = []
    for step in steps:
        if step.output is not None and step.output.resolve() != own:
            if own not in step.output.resolve().parents:
                raise StudyError(f"{step.name}: {step.output} is outside {study.folder}; nothing was deleted")
            folders.append(step.output)
    return folders


def delete(folders: Iterable[Path]) -> None:
    """Delete the folders that exist."""
    for folder in folders:
        if folder.exists():
            shutil.rmtree(folder)


def publish(study: Study, docs: Path) -> list[Path]:
    """Collect the results of a finished study into docs/, each JSON with its provenance.

    Returns:
        The written files.
    """
    if study.collect:
        module, _, function = study.collect.partition(".")
        collected = getattr(importlib.import_module(f"experiments.steps.{module}"), function)(study)
        for stem, content in collected.items():
            write_json(study.folder / f"{stem}.json", content)
    written = []
    for result in study.results:
        source, target = study.folder / Path(result).name, docs / result
        if not source.exists():
            raise StudyError(f"{source} is missing, though all steps are finished: does a step write it?")
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.suffix == ".json":
            write_json(target, {PROVENANCE: provenance(study), **json.loads(source.read_text())})
        else:
            shutil.copyfile(source, target)
        written.append(target)
    return written


def provenance(study: Study) -> dict[str, Any]:
    """Return what the results of a finished study come from: commits, machines, commands."""
    records = [record for step in study.steps if (record := read_record(study.folder, step.name))]
    return {
        "study": study.name,
        "commit": ", ".join(dict.fromkeys(record["commit"] for record in records)),
        "machine": "; ".join(dict.fromkeys(record["machine"] for record in records)),
        "needs": {name: commits_of(folder) for name, folder in study.needs.items()},
        "commands": {step.name: step.command for step in study.steps},
    }


def commits_of(folder: Path) -> str:
    """Return the commits of the code that has run a study, by its folder."""
    records = (json.loads(path.read_text()) for path in sorted((folder / RECORDS).glob("*.json")))
    return ", ".join(dict.fromkeys(record["commit"] for record in records))


def commit() -> str:
    """Return the commit of the code that runs, `+` behind it where files were changed."""
    describe = ["git", "-C", str(ROOT), "describe", "--always", "--abbrev=7", "--exclude=*", "--dirty=+"]
    found = subprocess.run(describe, capture_output=True, text=True)
    return found.stdout.strip() or "unknown"


def machine() -> str:
    """Return the processor, the number of cores that may be used, and the GPU if there is one."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    processor = names[0] if names else platform.processor() or platform.machine()
    gpu = shutil.which("nvidia-smi") and subprocess.run(
        ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"], capture_output=True, text=True
    ).stdout.strip().replace("\n", ", ")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{processor}, {cores} cores" + (f", {gpu}" if gpu else "")


def is_published(study: Study, docs: Path) -> bool:
    """Return whether the results of a cell are in docs/; without cells or results a study is always run."""
    cell = study.variables.get("cell")
    published = bool(cell and study.results) and all((docs / result).exists() for result in study.results)
    if published:
        print(f"{study.name}, {cell}: its results are in {docs}")
    return published


def show(study: Study) -> None:
    """Print what a study asks, its commands, and what it writes."""
    print(f"{study.name}: {study.question}\n")
    for step in study.steps:
        print(f"# {step.name}\n{step.command}\n")
    for result in study.results:
        print(f"writes docs/{result}")


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", type=Path, help="YAML file")
    parser.add_argument("variables", nargs="*", help="name=value")
    parser.add_argument("--dry_run", action="store_true", help="print the commands and stop")
    parser.add_argument("--repeat", action="store_true", help="run steps again whose commands have changed")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs", help="where results/ and images/ are")
    return parser


def main() -> None:
    """Entry point."""
    given = make_parser().parse_args()
    try:
        for study in read_cells(given.study, given.variables):
            if given.dry_run:
                show(study)
            elif given.repeat or not is_published(study, given.docs):
                run_study(study, given.repeat)
                for path in publish(study, given.docs):
                    print(f"wrote {path}")
    except (OSError, ValueError, StudyError) as error:
        sys.exit(f"error: {error}")
    if not given.dry_run:
        print("Next: python -m experiments.tables, which writes docs/results.md")


if __name__ == "__main__":
    main()

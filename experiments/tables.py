"""Write docs/results.md from the JSON in docs/results, its tables and their numbers.

Numbers of runs without a file are typed into the text of the sections.

python -m experiments.tables
python -m experiments.tables --check
"""

import argparse
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from experiments.page import four_tasks, levers, value_figure
from experiments.page.cells import Load
from experiments.page.contents import CHAPTERS
from experiments.study import ROOT, read_cells
from lerobot_wmrl.common.files import write_text

DOCS: Final = ROOT / "docs"
STUDIES: Final = ROOT / "experiments"

INTRODUCTION: Final = """# Results

Each section has a question, its answer, one table and its limits. The page is generated from
[`docs/results/`](results) by `python -m experiments.tables`; each JSON there is made by one file of
[`experiments/`](../experiments).

- Success is success in ManiSkill unless a column says otherwise. *Known* scenes are those that policies and
  world model were trained in; *unseen* ones are in no training data. Starts are held out in both.
- Intervals in parentheses are 95 %: Wilson's for a share, bootstrap over episodes for a mean, bootstrap over
  starts for a change and in the studies of what imagination is worth. Where a table shows several seeds
  and their mean, seeds are drawn too, but of two or three such intervals are too narrow for other seeds: read
  the gains by seed. Scenes are not drawn.
- All numbers come from CPUs but those of [speed_gpu](#speed_gpu) and where a GPU is named under the table,
  and all from earlier commits than the present one. The commit is under each table; *before* means that only
  the commit that added the numbers is known. Today's studies repeat the set-up, but not all have been run
  again.
- Null results stay here.
"""


def loader(docs: Path) -> Load:
    """Return what reads a file of docs/results by its stem."""

    def load(stem: str) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((docs / "results" / f"{stem}.json").read_text())
        return content

    return load


def results_page() -> str:
    """Return docs/results.md."""

    load = loader(DOCS)
    parts, missing = [f'## What each change is worth<a id="levers"></a>\n\n{levers.section(load)}\n'], []
    contents = ["- [What each change is worth](#levers)"]
    for chapter, sections in CHAPTERS.items():
        shown: list[str] = []
        for name, section in sections.items():
            cells = read_cells(STUDIES / f"{name}.yaml")
            results = [each for cell in cells for each in cell.results if each.endswith(".json")]
            published = [result for result in results if (DOCS / result).exists()]
            if results and not published:
                missing.append(f"- {link(name)}: {' '.join(cells[0].question.split())}")
                continue
            if absent := [each for each in results if each not in published]:
                stems = dict.fromkeys(re.sub(r"_seed\d+", "", Path(each).stem) for each in absent)
                missing.append(
                    f"- {len(absent)} of {len(results)} cells of {link(name)}, with one seed or more of: "
                    f"{', '.join(stems)}"
                )
            parts += [] if shown else [f"## {chapter}\n"]
            shown.append(f"[{section.title}](#{name})")
            parts.append(
                f'### {section.title}<a id="{name}"></a>\n\n**{cells[0].question}**\n\n'
                f"{joined(section.write(load))}\n\n{origin(name, published, load)}\n"
            )
        if shown:
            contents.append(f"- {chapter}: {', '.join(shown)}")
    if missing:
        contents.append("- [Not run yet](#not-run-yet)")
        parts.append("## Not run yet\n\n" + "\n".join(missing) + "\n")
    return "\n".join([INTRODUCTION, "\n".join(contents) + "\n", *parts])


def link(study: str) -> str:
    """Return a link to a study's file."""
    return f"[{study}.yaml](../experiments/{study}.yaml)"


def joined(text: str) -> str:
    """Return Markdown with each paragraph on one line, whatever the length of its numbers."""
    blocks = text.split("\n\n")
    return "\n\n".join(block if block.startswith("|") else " ".join(block.split()) for block in blocks)


def origin(study: str, results: Sequence[str], load: Load) -> str:
    """Return the line that says where a study's published results come from and how to repeat them."""
    sources = [
        load(result.removeprefix("results/").removesuffix(".json"))["provenance"] for result in results
    ]
    named = (commit for source in sources for commit in source["commit"].split(", "))
    commits = ", ".join(dict.fromkeys(named))
    machines = "; ".join(dict.fromkeys(source["machine"] for source in sources if "machine" in source))
    where = f", {machines}".replace(", 1 cores", ", 1 core") if machines else ""
    notes = dict.fromkeys(source["note"].removesuffix(".") for source in sources if "note" in source)
    where += "".join(f". {note}" for note in notes)
    parts = [f"Commit {commits}{where}"] if sources else []
    parts += [", ".join(f"[{Path(result).name}]({result})" for result in results)] if results else []
    return f"*{'; '.join([*parts, f'`python -m experiments.run experiments/{study}.yaml`'])}*"


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="only say whether the page is current")
    return parser


def main() -> None:
    """Entry point."""
    given = make_parser().parse_args()
    target, page = DOCS / "results.md", results_page()
    if given.check:
        if not target.exists() or target.read_text() != page:
            sys.exit("docs/results.md is not what the JSON says: run python -m experiments.tables")
        return
    load, images = loader(DOCS), DOCS / "images"
    value_figure.draw_value(load, images / "value_push.png")
    four_tasks.draw(load, images / "value_four_tasks.png")
    write_text(target, page)
    print(f"wrote {target.relative_to(ROOT)}")


if __name__ == "__main__":
    main()

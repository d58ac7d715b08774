"""Write docs/results.md from the JSON in docs/results, its tables and their numbers.

Numbers of runs without a file are typed into the text of the sections.

python -m experiments.tables
python -m experiments.tables --check
"""

import argparse
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from experiments import (
    act_section,
    codes_section,
    foreign,
    four_tasks_section,
    judged,
    rewards_section,
    same_recordings_section,
    value_cells,
    value_figure,
)
from experiments import policy_sections as policies
from experiments import speed_sections as speed
from experiments import value_sections as value
from experiments import world_model_sections as world_models
from experiments.cells import Load
from experiments.study import ROOT, read_cells
from lerobot_wmrl.common.files import write_text

DOCS: Final = ROOT / "docs"
STUDIES: Final = ROOT / "experiments"

SECOND_ROWS: Final = partial(value.rows_above, study=value_cells.SECOND_STUDY, parts=value_cells.SECOND_PARTS)

TASKS_ROWS: Final = partial(value.rows_above, study=value_cells.TASKS_STUDY, parts=value_cells.TASKS_PARTS)

SECTIONS: Final[Mapping[str, tuple[str, Callable[[Load], str]]]] = {
    "value_push": ("Policies", value.value_push),
    "value_pick_place": ("Policies", value.value_pick_place),
    "value_pick_place_longer_imagined": (
        "Policies",
        partial(SECOND_ROWS, ["longer_imagined_ppo"]),
    ),
    "value_pick_place_discount": (
        "Policies",
        partial(SECOND_ROWS, ["longer_filtered", "longer_discounted_ppo", "discounted_ppo"]),
    ),
    "value_pick_place_simulator": ("Policies", partial(SECOND_ROWS, ["simulated_ppo"])),
    "value_pick_place_dyna": ("Policies", partial(SECOND_ROWS, ["dyna"])),
    "value_pick_place_iterated": ("Policies", partial(SECOND_ROWS, ["iterated", "iterated_ppo"])),
    "value_tasks": ("Policies", value.value_tasks),
    "value_tasks_simulator": ("Policies", partial(TASKS_ROWS, ["simulated_ppo"])),
    "value_tasks_ppo_distilled": ("Policies", partial(TASKS_ROWS, ["ppo_distilled"])),
    "value_four_tasks": ("Policies", four_tasks_section.section),
    **{
        part: ("Policies", partial(four_tasks_section.column_above, part=part))
        for part in four_tasks_section.PARTS
    },
    "value_longer": ("Policies", partial(value.rows_above, ["longer", "longer_filtered"])),
    "value_longer_imagined": (
        "Policies",
        partial(value.rows_above, ["longer_imagined_ppo", "longer_ppo_distilled"]),
    ),
    "value_others": ("Policies", value.value_others),
    "value_iterated": (
        "Policies",
        partial(value.rows_above, ["iterated", "iterated_ppo", "iterated_ppo_distilled"]),
    ),
    "value_simulator": ("Policies", partial(value.rows_above, ["simulated_ppo"])),
    "value_dyna": ("Policies", partial(value.rows_above, ["dyna"])),
    "value_imagined": ("Policies", partial(value.rows_above, ["imagined_cloning"])),
    "value_distilled_ppo": ("Policies", partial(value.rows_above, ["distilled_ppo"])),
    "value_ppo_distilled": ("Policies", partial(value.rows_above, ["ppo_distilled"])),
    "value_same_recordings": ("Policies", same_recordings_section.section),
    "value_time_limit": ("Policies", codes_section.time_limit),
    "value_act": ("Policies", act_section.section),
    "value_act_controls": ("Policies", act_section.controls_section),
    "value_rewards": ("Policies", rewards_section.section),
    "value_controls": ("Policies", value.value_controls),
    "driven": ("Policies", policies.driven),
    "demo": ("Policies", policies.demo),
    "metaworld": ("Policies", foreign.section),
    "cloning_control": ("Policies", policies.cloning_control),
    "rl_comparison": ("Policies", policies.rl_comparison),
    "planning": ("Policies", policies.planning),
    "synthetic_data": ("Policies", policies.synthetic_data),
    "imagined_ppo": ("Policies", policies.imagined_ppo),
    "openvla_small": ("Policies", policies.openvla_small),
    "gate": ("Trust", world_models.gate),
    "gate_one_scene": ("Trust", world_models.gate_one_scene),
    "gate_autoregressive": ("Trust", world_models.gate_autoregressive),
    "gate_sensitivity": ("Trust", world_models.gate_sensitivity),
    "policies": ("Trust", world_models.policies),
    "judge": ("Trust", judged.section),
    "reward_curves": ("Trust", world_models.reward_curves),
    "four_tasks": ("World models", world_models.four_tasks),
    "instructions": ("World models", world_models.instructions),
    "codes": ("World models", codes_section.section),
    "learning_curve": ("World models", world_models.learning_curve),
    "text_dynamics": ("World models", world_models.text_dynamics),
    "ablation": ("World models", world_models.ablation),
    "ablation_network": ("World models", world_models.ablation_network),
    "planners": ("Recording, algorithms, speed", speed.planners),
    "cameras": ("Recording, algorithms, speed", speed.cameras),
    "control": ("Recording, algorithms, speed", speed.control),
    "speed": ("Recording, algorithms, speed", speed.speed),
    "speed_gpu": ("Recording, algorithms, speed", speed.speed_gpu),
    "training_memory": ("Recording, algorithms, speed", speed.training_memory),
}
"""Study → chapter and section, in the order of the page."""

INTRODUCTION: Final = """# Results

Each section is a question, its answer, one table and its limits. The page is generated from
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


def results_page(docs: Path = DOCS) -> str:
    """Return docs/results.md."""

    load = loader(docs)
    parts, chapter, missing = [INTRODUCTION], "", []
    for name, (title, section) in SECTIONS.items():
        cells = read_cells(STUDIES / f"{name}.yaml")
        results = [each for cell in cells for each in cell.results if each.endswith(".json")]
        published = [result for result in results if (docs / result).exists()]
        if results and not published:
            missing.append(f"- {link(name)}: {' '.join(cells[0].question.split())}")
            continue
        if absent := [each for each in results if each not in published]:
            stems = dict.fromkeys(re.sub(r"_seed\d+", "", Path(each).stem) for each in absent)
            missing.append(
                f"- {len(absent)} of {len(results)} cells of {link(name)}, with one seed or more of: "
                f"{', '.join(stems)}"
            )
        if title != chapter:
            chapter = title
            parts.append(f"## {chapter}\n")
        heading = f'### {cells[0].question}<a id="{name}"></a>'
        parts.append(f"{heading}\n\n{joined(section(load))}\n\n{origin(name, published, load)}\n")
    if missing:
        parts.append("## Not run yet\n\n" + "\n".join(missing) + "\n")
    return "\n".join(parts)


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
    four_tasks_section.draw(load, images / "value_four_tasks.png")
    write_text(target, page)
    print(f"wrote {target.relative_to(ROOT)}")


if __name__ == "__main__":
    main()

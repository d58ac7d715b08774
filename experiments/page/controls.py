"""Controls of what imagination is worth: their section of docs/results.md."""

from typing import Final

from experiments.page.cells import Load
from experiments.page.value import improved
from experiments.page.value_cells import BUDGET, SCENES, STUDY, TITLES, Cell, against, published
from lerobot_wmrl.common.files import markdown_table as table

CONTROLLED: Final = ("imagined_ppo", "planned")
"""Those that controls are made for."""

UNCHANGED: Final = "all episodes"
CONTROLS: Final = {
    "labels": "all, each with the labels of another",
    "actions": "all, each with the actions of another",
    "rollouts_only": "rollouts alone",
    "demonstrations_only": "demonstrations alone",
}
"""What a control's world model learnt from."""


def value_controls(load: Load) -> str:
    """Return the section: success under each control, against the policy before it on the same starts."""
    rows = [
        [
            *budget,
            learnt,
            TITLES[method],
            *(against(found[method][domain], before[domain]) for domain in SCENES),
        ]
        for cell, budget, before in improved(load)
        for learnt, found in controls(load, cell)
        for method in CONTROLLED
    ]
    return f"""Success against that of the policy which PPO begins from, on the same starts:

{table([*BUDGET, "the world model learnt from", "method", "known scenes", "unseen scenes"], rows)}

One seed. The distilled planner has controls [with ACT](#value_act_controls). PPO in a world model of the
demonstrations alone is a [pilot](pilots.md#a-world-model-of-demonstrations-alone)."""


def controls(
    load: Load, cell: str, study: str = STUDY, controls_of: str = "value_controls"
) -> list[tuple[str, Cell]]:
    """Return what a cell's world models learnt from and the methods in them; none without a control."""
    found = [(title, published(load, controls_of, f"{cell}_{name}")) for name, title in CONTROLS.items()]
    changed = [(title, control["methods"]) for title, control in found if control]
    return changed and [(UNCHANGED, load(f"{study}/{cell}")["methods"]), *changed]

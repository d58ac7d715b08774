"""What imagination is worth to LeRobot's ACT: the section of docs/results.md."""

from typing import Final

from experiments.page.cells import Load
from experiments.page.controls import controls
from experiments.page.from_one_policy import changes, tables
from experiments.page.value_cells import SCENES, against, groups, published
from experiments.study import ROOT, read_cells
from lerobot_wmrl.common.files import markdown_table as table

STUDY: Final = "value_act"
CONTROLS_STUDY: Final = "value_act_controls"
BEFORE: Final = "filtered"
"""What all others begin from."""

RIVAL: Final = "longer_filtered"
"""The best use of the same recordings without a world model."""

TITLES: Final = {
    BEFORE: "filtered BC, 3,000 steps",
    "longer_filtered": "filtered BC, 6,000 steps",
    "imagined_ppo": "PPO in imagination, from the BC of 3,000 steps",
    "distilled": "planner distilled in imagination, from the BC of 3,000 steps",
}
"""Methods in the order of the table."""

LIMITS: Final = """\
ACT has a ResNet-18 that begins untrained (no weights are downloaded), a width of 256, and chunks of 16
actions of which it executes 8. The rollouts are those of a cnn
policy, and the world model is that of the cell of [value_push](#value_push). PPO's standard deviation and
size of minibatches were chosen by success in imagination in pilots of 14 to 24 iterations with seed 0;
`minutes` after PPO and distillation include the world model's. In those pilots the first step of the
optimizer, at a learning rate of 1e-5 and a standard deviation of 0.1, moved the policy by more than a nat a
decision, and PPO ended there: such steps are undone since. That lerobot-wmrl-improve distils ACT was
decided on the starts of seed 0, before PPO was measured."""


def section(load: Load) -> str:
    """Return the section: success after every method, and what each gains on BC, of both lengths."""
    cells = [cell for each in groups(load, STUDY, ()).values() for cell in each if RIVAL in cell["methods"]]
    stronger = {name: TITLES[name] for name in TITLES if name != BEFORE}
    against_it = f"{changes(cells, stronger, RIVAL)}\n\n" if cells else ""
    return f"{tables(load, STUDY, TITLES, BEFORE)}\n\n{against_it}{LIMITS}"


def controls_section(load: Load) -> str:
    """Return the section: success after distillation in every world model, against the policy before it."""
    names = [each.variables["cell"] for each in read_cells(ROOT / "experiments" / f"{STUDY}.yaml")]
    rows = [
        [cell["seed"], learnt, *(against(found["distilled"][d], cell["methods"][BEFORE][d]) for d in SCENES)]
        for name in names
        if (cell := published(load, STUDY, name))
        for learnt, found in controls(load, name, STUDY, CONTROLS_STUDY)
    ]
    return f"""Success of the planner distilled, against the BC that it begins from, on the same starts:

{table(["seed", "the world model learnt from", "known scenes", "unseen scenes"], rows)}

In the world model of other episodes' labels the planner succeeded in none of 64 imagined episodes. The
training stopped there, and the policy stayed as it was."""

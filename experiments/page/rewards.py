"""What PPO in imagination gains with each reward: the section of docs/results.md."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.stats import ttest_1samp

from experiments.page.cells import DOMAINS, Load
from experiments.page.from_one_policy import changes, tables
from experiments.page.value_cells import SCENES, Cell, gains, groups
from lerobot_wmrl.common.files import markdown_table as table

STUDY: Final = "value_rewards"
BEFORE: Final = "filtered"
"""What all others begin from."""

RIVAL: Final = "longer_filtered"
BEST: Final = ("success", "general", "grpo", "distilled")
"""The best use of the same recordings without a world model, and what is compared with it."""

TITLES: Final = {
    BEFORE: "filtered BC",
    "longer_filtered": "filtered BC, three times as many steps",
    "success": "PPO, reward: success (done alone)",
    "general": "PPO, reward: general, alpha 0.9, potential",
    "absolute": "PPO, reward: general, alpha 0.9, absolute, as in RoboScape-R",
    "similarity": "PPO, reward: similarity to the goal frame alone (alpha 0, potential)",
    "embedding": "PPO, reward: learnt from the world model's hidden state (embedding)",
    "proxy": "PPO, reward: learnt from frames (proxy)",
    "grpo": "GRPO, reward: success (done alone)",
    "distilled": "planner distilled after the PPO whose reward is success",
}
"""Methods in the order of the table."""

UNCORRECTED: Final = """\
They are not corrected for the number of gains: with Bonferroni's correction for four, PPO's in known scenes
includes 0. The methods had been chosen in value_push, on the same starts."""

LIMITS: Final = """\
Settings are those of [value_push](#value_push), where the reward is success. World models and policies were
trained again, so they corroborate it; the recordings were too, but with seeds 0 and 100000 as many episodes
succeed and filtered BC has the same outcomes, so that they appear to be the same (of seed 200000 154 episodes
succeed, there 153). The same baseline on other recordings, longer filtered BC, [differs](#value_longer) from
this one by −11, 1 and 6 points in known scenes. Minutes of PPO, GRPO and distillation leave out those of
filtered BC (6). Only the reward differs, or the algorithm. Imagined episodes
end with success under every reward. The learnt rewards have seen ManiSkill's
rule-based one in the recorded episodes, the others have not.

Under the absolute form PPO of seed 0 learns to delay success: imagined success rises from 55 to 81 % by
iteration 41 and falls to 66 % by iteration 80, while the reward goes on rising. Success ends an episode, and
with it the similarity that each step pays. The learnt rewards are paid at every step too: with seed 100000
imagined success falls from 77 to 20 % under the one of the hidden state, while the reward rises from 0.35 to
0.38 a step. The potential form pays for each step nearer to the goal, and nothing for staying."""


def section(load: Load) -> str:
    """Return the section: success with every reward, and what each gains on the policy before it."""
    cells = [cell for each in groups(load, STUDY, ()).values() for cell in each if RIVAL in cell["methods"]]
    parts = [tables(load, STUDY, TITLES, BEFORE)]
    if cells:
        parts.append(changes(cells, {name: TITLES[name] for name in (RIVAL, *BEST)}, RIVAL))
    if over_seeds := [row for method in BEST if (row := gains_over_seeds(cells, method))]:
        columns = ["method", *(f"{DOMAINS[domain]} scenes" for domain in SCENES)]
        parts.append(
            "Gains over it in points, with intervals of 95 % by Student's t over the seeds alone, whose "
            "starts are the same:\n\n" + table(columns, over_seeds) + f"\n\n{UNCORRECTED}"
        )
    return "\n\n".join([*parts, LIMITS])


def gains_over_seeds(cells: Sequence[Cell], method: str) -> list[str]:
    """Return the row of a method that ran with three seeds or more: its mean gain over RIVAL in SCENES."""
    row = [TITLES[method]]
    for domain in SCENES:
        each = 100 * np.array(gains(cells, method, RIVAL, domain))
        if len(each) < 3:
            return []
        interval = ttest_1samp(each, 0).confidence_interval()
        row.append(f"{each.mean():+.1f} ({interval.low:+.1f} to {interval.high:+.1f})")
    return row

"""What PPO in imagination gains with each reward: the section of docs/results.md."""

from typing import Final

from experiments.cells import Load
from experiments.from_one_policy import changes, tables
from experiments.value_cells import groups

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

LIMITS: Final = """\
Everything is as in [value_push](#value_push), where the reward is success; only the reward differs, or the
algorithm. Imagined episodes end with success under every reward. The learnt rewards have seen ManiSkill's
rule-based one in the recorded episodes, the others have not.

Under the absolute form PPO of seed 0 learns to delay success: imagined success rises from 55 to 81 % by
iteration 41 and falls to 66 % by iteration 80, while the reward goes on rising. Success ends an episode, and
with it the similarity that each step pays. The learnt rewards are paid at every step too: with seed 100000
imagined success falls from 77 to 20 % under the one of the hidden state, while the reward rises from 0.35 to
0.38 a step. The potential form pays for each step nearer to the goal, and nothing for staying."""


def section(load: Load) -> str:
    """Return the section: success with every reward, and what each gains on the policy before it."""
    cells = [cell for each in groups(load, STUDY, ()).values() for cell in each if RIVAL in cell["methods"]]
    over_rival = [changes(cells, {name: TITLES[name] for name in (RIVAL, *BEST)}, RIVAL)] if cells else []
    return "\n\n".join([tables(load, STUDY, TITLES, BEFORE), *over_rival, LIMITS])

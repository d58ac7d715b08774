"""Could similarity to the goal frame decide success in place of the success classifier?

    python -m experiments.steps.goal_distance outputs/rollouts known=outputs/known unseen=outputs/unseen \\
        --model.path=outputs/action_world_model --text_model.path=outputs/text_world_model \\
        --output=outputs/goal_distance.json

Recorded episodes are imagined from their first frame with their own actions. An episode counts as a success
if the success probability, or the similarity to the goal frame of its start, reaches a threshold for two
frames in a row. Each measure has its own threshold: the lowest with at most 5 % false positives in the first
dataset, whose episodes the world model may have learnt from. The others are judged at it.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from experiments.steps.reward_curves import recorded, with_recorded_actions
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.evaluation.gate import gate_at
from lerobot_wmrl.evaluation.outcomes import Outcomes
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig

MEASURES: Final = {"classifier": "done_probability", "goal": "similarity"}
"""What decides success, and its name among the parts of the general reward."""

FRAMES: Final = 2
"""Consecutive frames that make a success, as in the value studies."""

MOST_FALSE: Final = 0.05
"""Share of the failures that may count as successes in the first dataset."""


def imagined(given: argparse.Namespace, root: str) -> dict[str, Outcomes]:
    """Imagine the episodes of a dataset with their own actions. → what each measure says of every frame"""
    table, episodes, env, actions = with_recorded_actions(given, root, GeneralConfig(device="cpu"))
    env.reset(seed=list(range(env.num_envs)))
    with torch.no_grad():
        parts = [env.step(action)[-1]["reward_parts"] for action in actions.unbind(1)]
    done = recorded(table, episodes, table.done, actions.shape[1])
    ended, found = np.isnan(done), {}
    for measure, name in MEASURES.items():
        values = torch.stack([part[name] for part in parts], 1).cpu().numpy()
        found[measure] = Outcomes(episodes, np.where(ended, np.nan, values), done == 1)
    return found


def lowest_threshold(outcomes: Outcomes) -> float:
    """Return the lowest threshold with at most `MOST_FALSE` of the failures above or at it.

    Raises:
        ValueError: no episode fails, so any threshold would do.
    """
    failures = np.sort(outcomes.scores(FRAMES)[~outcomes.success])
    if not len(failures):
        raise ValueError("episodes: none fails; false positives need failures, so record a weaker policy")
    allowed = int(MOST_FALSE * len(failures))
    return float(np.nextafter(failures[-1 - allowed], np.inf))


def compare(first: Mapping[str, Outcomes], others: Mapping[str, Mapping[str, Outcomes]]) -> dict[str, Any]:
    """Return each measure's gate in the first dataset, where its threshold is chosen, and in the others."""
    found: dict[str, Any] = {}
    for measure, chosen in first.items():
        criterion = SuccessCriterion(lowest_threshold(chosen), FRAMES)
        found[measure] = {
            "chosen": gate_at(chosen, criterion).as_json(),
            **{name: gate_at(each[measure], criterion).as_json() for name, each in others.items()},
        }
    return found


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("chosen", help="rollouts by which the thresholds are chosen")
    parser.add_argument("judged", nargs="+", help="name=root of rollouts that are judged at them")
    parser.add_argument("--model.path", dest="model_path", required=True, help="action world model")
    parser.add_argument("--text_model.path", dest="text_model_path", required=True)
    parser.add_argument("--max_episodes", type=int, default=300, help="of each dataset, evenly spread")
    parser.add_argument("--output", type=Path, required=True, help="JSON file")
    return parser


def main() -> None:
    """Entry point."""
    given = make_parser().parse_args()
    others = {name: imagined(given, root) for name, _, root in (each.partition("=") for each in given.judged)}
    write_json(given.output, compare(imagined(given, given.chosen), others))


if __name__ == "__main__":
    main()

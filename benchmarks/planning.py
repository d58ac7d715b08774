"""How fast the planner plans, against imagining its sequences frame by frame and what the machine allows.

    python benchmarks/planning.py --sizes=demo
    python benchmarks/planning.py --world_model=outputs/demo/improve/world_model --searches 1 64

At each number of searches at once, measured in turns: plans of three settings (those of `wm_mpc` by default,
those of `distillation`, and a few changes of a policy's actions), what the policy would do (the frames that
it is shown, without the policy itself), and the last setting's sequences in one pass and frame by frame, as
one would without `open_loop`. The floor of a predicted frame is its arithmetic at the measured rate of matrix
products. Episodes a second are those of the last setting, with `PLANS_AN_EPISODE`. Beyond a clip's length
everything is frame by frame. Writes docs/results/planning_speed.json.
"""

import argparse
import json
from functools import partial
from pathlib import Path
from typing import Any, Final

import torch
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.precision import imagination_dtype, keep_freed_memory
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW
from lerobot_wmrl.rl.configuration_distillation import FastPlanner
from lerobot_wmrl.world_models.configuration_planner import PlannerSettings
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from lerobot_wmrl.world_models.planning import Planner
from machine import matmul_rate, rates
from workloads import Work, start_frames
from world_model import add_model, flop, make_model

RESULTS: Final = Path(__file__).parents[1] / "docs" / "results" / "planning_speed.json"
SEARCHES: Final = (1, 16, 64)
PLANS_AN_EPISODE: Final = 4
"""An episode of about thirty frames, planned anew after eight."""

SETTINGS: Final = {
    "wm_mpc": PlannerSettings(),
    "distillation": FastPlanner(),
    "near_a_policy": PlannerSettings(horizon=28, samples=16, elites=4, iterations=2, spread=0.5),
}


def measure(model: ActionWorldModelRewardModel, searches: int, matmul: float) -> dict[str, Any]:
    """Return all rates at one number of searches at once."""
    device = model.device
    frames, tasks = start_frames(model, searches, device), [""] * searches
    low, high = (torch.tensor(bound, device=device) for bound in (ACTION_LOW, ACTION_HIGH))
    near = SETTINGS["near_a_policy"]
    action = model.action_mean.expand(searches, -1)
    sequences = model.action_mean.expand(searches * near.samples, near.horizon, -1)
    each = frames[torch.arange(searches, device=device).repeat_interleave(near.samples)]
    works: dict[str, tuple[float, Work]] = {
        "open_loop": (
            len(sequences) * near.horizon,
            lambda: model.open_loop(frames, sequences, with_tokens=False),
        ),
        "frame_by_frame": (len(sequences) * near.horizon, lambda: model.imagine(each, sequences)),
        "policy_actions": (
            searches,
            lambda: model.policy_actions(frames, lambda *seen: action, near.horizon),
        ),
    }
    for name, settings in SETTINGS.items():
        planner = Planner(model, None, settings, 2, averaged=False, low=low, high=high, seed=0)
        proposed = None if name == "wm_mpc" else action[:, None].expand(-1, settings.horizon, -1)
        works[name] = (searches, partial(planner.plan, frames, tasks, proposed))
    found = rates(works, device)
    arithmetic = flop(works["open_loop"][1]) / works["open_loop"][0]
    plans = {name: found[name] for name in (*SETTINGS, "policy_actions")}
    both = 1 / (1 / plans["near_a_policy"] + 1 / plans["policy_actions"])
    return {
        "searches": searches,
        "frames_per_s": {name: round(found[name], 1) for name in ("open_loop", "frame_by_frame")},
        "times_faster_than_frame_by_frame": round(found["open_loop"] / found["frame_by_frame"], 2),
        "mflop_per_frame": round(arithmetic / 1e6, 2),
        "share_of_floor": round(found["open_loop"] * arithmetic / matmul, 3),
        "plans_per_s": {name: round(rate, 2) for name, rate in plans.items()},
        "episodes_per_s": round(both / PLANS_AN_EPISODE, 2),
    }


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_model(parser)
    parser.add_argument("--searches", type=int, nargs="+", default=SEARCHES, help="searches at once")
    parser.add_argument("--output", type=Path, default=RESULTS, help="JSON file")
    return parser


def main() -> None:
    """Measure everything, print it, write it."""
    keep_freed_memory()
    register_third_party_plugins()
    given = make_parser().parse_args()
    model = make_model(given, ())
    device = model.device
    dtype = imagination_dtype(device)
    matmul = matmul_rate(dtype, device)
    figures = {
        "threads": torch.get_num_threads(),
        "dtype": str(dtype).removeprefix("torch."),
        "matmul_gflop_per_s": round(matmul / 1e9, 1),
        "by_searches": [measure(model, searches, matmul) for searches in given.searches],
    }
    print(json.dumps(figures, indent=2))
    write_json(given.output, figures)


if __name__ == "__main__":
    main()

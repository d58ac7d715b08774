"""What the person does: a plan in the world model, by keys."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from tqdm import tqdm

from experiments import person
from lerobot_wmrl.common.files import write_json, write_text
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.envs.configuration_world_model import DrivenEnv
from lerobot_wmrl.play.drive import Drive
from lerobot_wmrl.play.drivers import PlannerDriver
from lerobot_wmrl.play.world import World, load_world
from lerobot_wmrl.world_models.configuration_planner import PlannerSettings

SEARCH: Final = PlannerSettings(horizon=28, samples=16, elites=4, iterations=2, spread=0.5)
"""How the planner searches for changes of what the policy would do, as in value_push.yaml."""

SPEED: Final = 0.6
"""Share of half an axis's range at which a key moves it."""

Axes = Sequence[dict[str, Any]]
"""Components of an action as `World.axes` describes them."""


class Hands:
    """Turns wanted actions into those that keys can give, and makes up for the difference later.

    Args:
        axes: components of an action.
    """

    def __init__(self, axes: Axes) -> None:
        self.rest, low, high = (np.array([axis[name] for axis in axes]) for name in ("rest", "low", "high"))
        self.held = np.array([not axis["springs"] for axis in axes])
        self.low, self.high, self.step = low, high, SPEED * (high - low) / 2
        self.owed = np.zeros(len(axes))
        self.now = self.rest.copy()

    def press(self, wanted: np.ndarray) -> np.ndarray:
        """Return the action of the keys that come closest to a wanted one. (A,) → (A,)"""
        base = np.where(self.held, self.now, self.rest)
        missing = wanted + np.where(self.held, 0.0, self.owed) - base
        keys = np.clip(np.round(missing / self.step), -1, 1)
        self.owed = np.clip(missing - keys * self.step, -self.step, self.step)
        self.now = np.clip(base + keys * self.step, self.low, self.high)
        return self.now


def drive_by_keys(world: World, episode: int, frames: int) -> tuple[list[list[float]], Drive]:
    """Drive from an episode's first frame until success, at most so many frames. Return the actions."""
    drive = world.begin({"episode": episode, "frame": 0}, None)
    hands, planner = Hands(world.axes()), PlannerDriver(SEARCH, world.criterion.frames, world.policy)
    actions: list[list[float]] = []
    while not drive.ended and len(actions) < frames:
        wanted = planner.act(drive)[0].numpy()
        actions.append(hands.press(wanted).tolist())
        drive.step(torch.tensor([actions[-1]], dtype=torch.float32), "you")
    return actions, drive


def write_script(given: argparse.Namespace) -> None:
    """Drive until there are enough successes; write the actions, and the episodes in which they begin."""
    env = DrivenEnv(
        world_model_path=given.world_model,
        episode_length=given.frames,
        done_threshold=given.done_threshold,
        done_frames=given.done_frames,
        device="cpu",
    )
    policy = read_policy_config(given.policy, ["--device=cpu"])
    world = load_world(env, ChosenEpisodes(given.root), policy, None)
    assert world.table is not None
    order = np.random.default_rng(given.seed).permutation(len(world.table.start)).tolist()
    driven: dict[int, list[list[float]]] = {}
    with tqdm(total=given.episodes, unit="episode") as progress:
        for count, episode in enumerate(order, 1):
            actions, drive = drive_by_keys(world, episode, given.frames)
            if drive.ended == "success":
                driven[episode] = actions
                progress.update()
            progress.set_postfix(success=f"{len(driven)}/{count}")
            if len(driven) == given.episodes:
                break
    if len(driven) < given.episodes:
        raise SystemExit(
            f"error: --episodes={given.episodes}: {len(driven)} of {len(order)} drives succeed; ask for "
            "fewer, or give a dataset with more episodes or a better world model"
        )
    chosen = sorted(driven)
    names = world.model.embodiment.action_names
    write_json(given.output_dir / "script.json", {"names": names, "actions": [driven[row] for row in chosen]})
    write_text(given.output_dir / "episodes.txt", ",".join(map(str, chosen)))


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=person.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--world_model", required=True, help="an action world model")
    parser.add_argument("--policy", required=True, help="whose actions the planner changes")
    parser.add_argument("--dataset.root", dest="root", required=True, help="in whose first frames it begins")
    parser.add_argument("--episodes", type=int, required=True, help="successful drives to write")
    parser.add_argument("--frames", type=int, required=True, help="of an episode at most")
    parser.add_argument("--done_threshold", type=float, default=0.95, help="as in lerobot-wmrl-play")
    parser.add_argument("--done_frames", type=int, default=2, help="as in lerobot-wmrl-play")
    parser.add_argument("--seed", type=int, default=0, help="of the order of the episodes")
    parser.add_argument("--output_dir", type=Path, required=True, help="of script.json and episodes.txt")
    return parser


if __name__ == "__main__":
    write_script(make_parser().parse_args())

"""Which reward knows success from failure? The curves of the paper's Fig. 3, for every kind of reward.

    python -m experiments.steps.reward_curves known=outputs/known unseen=outputs/unseen \\
        --model.path=outputs/action_world_model --text_model.path=outputs/text_world_model \\
        --proxy=outputs/proxy --embedding=outputs/embedding --output=outputs/reward_curves.json

Real episodes are imagined
from their first frame with their own actions, as a policy would meet them, and every reward says what each
frame is worth: `rule_based` (recorded in the simulator, the yardstick), `general` (alpha on success, the rest
on similarity to the goal, absolute), its two parts, `embedding` and `proxy`. Of each: the mean curve of
successes and of failures with its band, Spearman's correlation with the rule-based reward within an episode,
and the AUC of its highest run of three frames, success against failure. The same starts are also given to
hands that move at random, not at all, and to one corner: they should earn less than the planner's actions.
Does uncertainty warn? Of the episodes that the world model calls successes, how often is the
greatest uncertainty until then in a false one above that in a true one. Writes a
JSON file and a picture beside it.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.import_utils import register_third_party_plugins
from matplotlib.figure import Figure
from scipy.stats import spearmanr
from torch import Tensor

from experiments.figures import COLOURS, tidy
from lerobot_wmrl.common.files import markdown_table, write_json
from lerobot_wmrl.common.statistics import Estimate
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.envs.start_frames import chosen_episodes
from lerobot_wmrl.envs.world_model_env import WorldModelVectorEnv, make_world_model_env
from lerobot_wmrl.evaluation.outcomes import Outcomes
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.world_models.checkpoint import load_model

FRAMES = 3
"""Consecutive done frames that make a success, as in the environment."""

THRESHOLD = 0.5
"""Done probability from which a frame counts as success."""

FEWEST = 5
"""Episodes that a mean needs to be drawn."""

NEVER = 10**6
"""No episode ends while it is judged."""

HANDS: Final = ("random", "frozen", "saturated")

SIGNALS: Final = ("token_entropy", "done_entropy")
"""How uncertain the world model says that it is."""


class RewardProbe:
    """A reward for an environment that pays nothing and keeps what every learned reward pays."""

    def __init__(self, rewards: Mapping[str, PreTrainedRewardModel]) -> None:
        self.rewards = rewards
        self.paid: dict[str, list[Tensor]] = {}

    @torch.no_grad()
    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Ask every learned reward. → (B,) zeros"""
        for name, reward in self.rewards.items():
            self.paid.setdefault(name, []).append(reward.compute_reward(batch))
        return torch.zeros_like(batch["success"])


def judged(
    env: WorldModelVectorEnv, probe: RewardProbe, actions: Tensor, config: GeneralConfig
) -> dict[str, np.ndarray]:
    """Imagine actions (B, T, A) from the first B starts.

    Returns:
        The reward of every frame by every reward, and both signals of uncertainty, each (B, T).
    """
    probe.paid.clear()
    env.reset(seed=list(range(env.num_envs)))
    parts = [env.step(action)[-1]["reward_parts"] for action in actions.unbind(1)]
    success = torch.stack([part["done_probability"] for part in parts], 1)
    similarity = torch.stack([part["similarity"] for part in parts], 1)
    level = config.success_weight * (success >= THRESHOLD).float() + (1 - config.success_weight) * similarity
    learned = {name: torch.stack(values, 1) for name, values in probe.paid.items()}
    uncertainty = {signal: torch.stack([part[signal] for part in parts], 1) for signal in SIGNALS}
    every = {"general": level, "success": success, "similarity": similarity, **learned, **uncertainty}
    return {name: values.cpu().numpy() for name, values in every.items()}


def recorded(table: EpisodeTable, episodes: np.ndarray, column: np.ndarray, steps: int) -> np.ndarray:
    """Return a column of the dataset by episode, NaN after its end. (rows,) → (E, steps)"""
    values = np.full((len(episodes), steps), np.nan)
    for row, rows in enumerate(table.rows(episodes)):
        kept = column[rows][:steps]
        values[row, : len(kept)] = kept
    return values


def within_episodes(reward: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return Spearman's correlation over each episode's frames; NaN where one is constant. (E, T) → (E,)"""
    correlation = np.full(len(reward), np.nan)
    for row, (own, real) in enumerate(zip(reward, truth, strict=True)):
        known = np.isfinite(real)
        if np.ptp(own[known]) > 0 and np.ptp(real[known]) > 0:
            correlation[row] = spearmanr(own[known], real[known]).statistic
    return correlation


def curve(values: np.ndarray) -> dict[str, list[float]]:
    """Return the mean of (E, T) over episodes with its 95 % band, as long as `FEWEST` episodes last."""
    lasting = np.isfinite(values).sum(0)
    each = [Estimate.mean(column) for column in values[:, lasting >= FEWEST].T]
    return {
        "mean": [estimate.value for estimate in each],
        "low": [estimate.low for estimate in each],
        "high": [estimate.high for estimate in each],
    }


def measure(
    curves: Mapping[str, np.ndarray], done: np.ndarray, alone: Mapping[str, Mapping[str, np.ndarray]]
) -> dict[str, Any]:
    """Return the numbers of every reward.

    Args:
        curves: rewards (E, T) by name, `rule_based` among them.
        done: success in ManiSkill (E, T).
        alone: rewards of hands that attempt nothing, by hand and name.
    """
    truth, success = curves["rule_based"], done.any(1)
    lasted = {name: np.where(np.isfinite(truth), values, np.nan) for name, values in curves.items()}
    uncertainty = {signal: lasted.pop(signal) for signal in SIGNALS}
    by_reward = {}
    for name, cut in lasted.items():
        outcomes = Outcomes(np.arange(len(cut)), cut, done)
        earned = np.nanmean(cut[success], 1)
        by_reward[name] = {
            "auc": outcomes.auc(FRAMES),
            "spearman": Estimate.mean(within_episodes(cut, truth)).as_json(),
            "curve_of_successes": curve(cut[success]),
            "curve_of_failures": curve(cut[~success]),
            "earned_by_successes": float(earned.mean()),
            "earned_by": {hand: float(paid[name].mean()) for hand, paid in alone.items() if name in paid},
        }
    return {
        "successes": int(success.sum()),
        "failures": int((~success).sum()),
        "rewards": by_reward,
        "uncertainty": warnings(uncertainty, Outcomes(np.arange(len(done)), lasted["success"], done)),
    }


def warnings(uncertainty: Mapping[str, np.ndarray], outcomes: Outcomes) -> dict[str, Any]:
    """Return how well the maximum of a signal tells false positives among predicted successes.

    The maximum is taken up to the frame of the prediction, as the environment's guard would see it.
    """
    first = outcomes.first_predicted_success(SuccessCriterion(THRESHOLD, FRAMES))
    called, end = outcomes.where(first >= 0), first[first >= 0] + FRAMES
    seen = np.arange(called.done.shape[1]) < end[:, None]
    false = np.repeat(~called.success[:, None], called.done.shape[1], 1)
    auc = {
        signal: Outcomes(called.episodes, np.where(seen, values[called.episodes], np.nan), false).auc(1)
        for signal, values in uncertainty.items()
    }
    return {"predicted_successes": len(false), "false": int((~called.success).sum()), "auc": auc}


def other_hands(shape: tuple[int, int]) -> dict[str, Tensor]:
    """Return actions (B, T, A) of hands that attempt nothing."""
    low, high = torch.tensor(ACTION_LOW), torch.tensor(ACTION_HIGH)
    drawn = torch.rand(*shape, len(low), generator=torch.Generator().manual_seed(0))
    return {
        "random": low + drawn * (high - low),
        "frozen": torch.zeros_like(drawn),
        "saturated": high.expand_as(drawn),
    }


def with_recorded_actions(
    given: argparse.Namespace, root: str, reward: GeneralConfig
) -> tuple[EpisodeTable, np.ndarray, WorldModelVectorEnv, Tensor]:
    """Return a dataset, its chosen episodes (E,), an environment in which each is imagined and none ends, and
    their own actions (E, T, A)."""
    table, source = read_episodes(open_dataset(root)), StartFrames(root=root, max_starts=given.max_episodes)
    episodes = chosen_episodes(table, source)
    env = make_world_model_env(
        WorldModelEnv(
            world_model_path=given.model_path,
            text_world_model_path=given.text_model_path,
            dataset=source,
            reward=reward,
            done_frames=NEVER,
            episode_length=NEVER,
        ),
        len(episodes),
        "cpu",
    )
    steps = int(table.length[episodes].max())
    actions = Recording.read(table, env.model).actions(episodes, steps, torch.device("cpu"))
    return table, episodes, env, actions


def curves_of(given: argparse.Namespace, root: str, rewards: Mapping[str, Any]) -> dict[str, Any]:
    """Return all numbers of one dataset of recorded episodes."""
    config = GeneralConfig(device="cpu")
    table, episodes, env, actions = with_recorded_actions(given, root, config)
    probe = RewardProbe(rewards)
    env.reward, steps = probe, actions.shape[1]
    column = np.asarray(table.dataset.hf_dataset.with_format("numpy")["next.reward"][:]).reshape(-1)
    curves = {
        "rule_based": recorded(table, episodes, column, steps),
        **judged(env, probe, actions, config),
    }
    done = recorded(table, episodes, table.done, steps) == 1
    hands = {
        name: judged(env, probe, moves, config) for name, moves in other_hands((len(episodes), steps)).items()
    }
    return measure(curves, done, hands)


def results_table(measured: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a table with a line for every dataset and reward."""
    lines = []
    for dataset, numbers in measured.items():
        for name, row in numbers["rewards"].items():
            earned = [f"{row['earned_by'][hand]:.2f}" if hand in row["earned_by"] else "–" for hand in HANDS]
            lines.append(
                [
                    dataset,
                    name,
                    f"{row['auc']:.3f}",
                    f"{row['spearman']['value']:.2f}",
                    f"{row['earned_by_successes']:.2f}",
                    *earned,
                ]
            )
    return markdown_table(["episodes", "reward", "AUC", "Spearman", "successes earn", *HANDS], lines)


def draw(measured: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Draw the mean curves of successes and failures: a row a dataset, a column a reward."""
    names = list(next(iter(measured.values()))["rewards"])
    figure = Figure(figsize=(2.2 * len(names), 2.2 * len(measured)), layout="constrained")
    grid = figure.subplots(len(measured), len(names), squeeze=False, sharex=True)
    for row, (dataset, numbers) in zip(grid, measured.items(), strict=True):
        for axes, name in zip(row, names, strict=True):
            for colour, kind in zip(COLOURS, ("successes", "failures"), strict=False):
                shown = numbers["rewards"][name][f"curve_of_{kind}"]
                axes.plot(shown["mean"], color=colour, label=kind if axes is grid[0, 0] else None)
                frames = range(len(shown["mean"]))
                axes.fill_between(frames, shown["low"], shown["high"], color=colour, alpha=0.25)
            axes.set_title(f"{name}, {dataset}", fontsize=9)
            axes.set_xlabel("frame" if dataset == list(measured)[-1] else "")
    tidy(figure).savefig(path, dpi=130)


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("datasets", nargs="+", help="name=root of real episodes")
    parser.add_argument("--model.path", dest="model_path", required=True, help="action world model")
    parser.add_argument("--text_model.path", dest="text_model_path", required=True)
    for kind in ("proxy", "embedding"):
        parser.add_argument(f"--{kind}", help=f"trained {kind} reward; left out by default")
    parser.add_argument("--max_episodes", type=int, default=300, help="of each dataset, evenly spread")
    parser.add_argument("--output", type=Path, required=True, help="JSON file")
    return parser


def main() -> None:
    """Entry point."""
    given = make_parser().parse_args()
    register_third_party_plugins()
    paths = {kind: getattr(given, kind) for kind in ("proxy", "embedding") if getattr(given, kind)}
    rewards = {kind: load_model(path, kind) for kind, path in paths.items()}
    measured = {
        name: curves_of(given, root, rewards) for name, _, root in (d.partition("=") for d in given.datasets)
    }
    write_json(given.output, measured)
    draw(measured, given.output.with_suffix(".png"))
    print(results_table(measured))
    print(*(f"{name}: {numbers['uncertainty']}" for name, numbers in measured.items()), sep="\n")


if __name__ == "__main__":
    main()

"""The world model as an evaluator of policies: success in imagination beside success in an environment."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import torch
from lerobot.envs import make_env, make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.scripts.lerobot_eval import eval_policy, eval_policy_all
from lerobot.utils.constants import CHECKPOINTS_DIR
from scipy.stats import pearsonr

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policies import load_policy, load_processors, read_policy_config
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.envs.evaluation_adapter import EvaluationAdapter, StepCounter
from lerobot_wmrl.envs.lerobot_env import runs_in_processes

MIN_POLICIES = 3
"""Policies that a correlation needs."""


class Evaluated(NamedTuple):
    """Success of each episode, in the order of their seeds, and the steps of all of them together."""

    successes: list[bool]
    steps: int


def policy_checkpoints(paths: Sequence[str]) -> list[Path]:
    """List the checkpoints among `paths`, and every checkpoint of the trainings among them in order of steps.

    Raises:
        FieldError: there is none.
    """
    found = []
    for path in map(Path, paths):
        steps = [each for each in (path / CHECKPOINTS_DIR).glob("*") if each.name.isdigit()]
        found += sorted(steps, key=lambda each: int(each.name)) or [path]
    if not found:
        raise FieldError("policies", list(paths), "none", "give checkpoints, or output folders of trainings")
    return found


def policy_outcomes(env: EnvConfig, path: Path, episodes: int, seed: int, num_envs: int) -> list[bool]:
    """Evaluate a policy's checkpoint; return the success of each episode in the order of their seeds."""
    config = read_policy_config(str(path), [])
    processors = load_processors(config)
    return evaluate_policy(env, load_policy(config), processors, episodes, seed, num_envs).successes


@torch.no_grad()
def evaluate_policy(
    env: EnvConfig, policy: PreTrainedPolicy, processors: tuple[Any, Any], episodes: int, seed: int,
    num_envs: int,
) -> Evaluated:  # fmt: skip
    """Run LeRobot's evaluation of a policy in `num_envs` environments made for it.

    Args:
        processors: the policy's pre- and postprocessor.
        seed: seed of the first episode; each further one adds one.
    """
    made: Any = make_env(env, min(num_envs, episodes), use_async_envs=runs_in_processes(env))
    envs = {suite: {task: StepCounter(one) for task, one in tasks.items()} for suite, tasks in made.items()}
    info = eval_policy_all(
        envs, policy, *make_env_pre_post_processors(env, policy.config), *processors,
        n_episodes=episodes, start_seed=seed,
    )  # fmt: skip
    successes = [bool(success) for task in info["per_task"] for success in task["metrics"]["successes"]]
    return Evaluated(successes, sum(one.steps for tasks in envs.values() for one in tasks.values()))


@torch.no_grad()
def evaluate_within(
    env: gym.vector.VectorEnv, config: EnvConfig, policy: PreTrainedPolicy, processors: tuple[Any, Any],
    episodes: int, seed: int,
) -> Evaluated:  # fmt: skip
    """Run LeRobot's evaluation in an existing tensor environment of this configuration, which stays open."""
    counted: Any = StepCounter(EvaluationAdapter(env))
    info = eval_policy(
        counted, policy, *make_env_pre_post_processors(config, policy.config), *processors,
        n_episodes=episodes, start_seed=seed,
    )  # fmt: skip
    return Evaluated([bool(episode["success"]) for episode in info["per_episode"]], counted.steps)


@dataclass(frozen=True)
class Agreement:
    """Success of each policy by name: in the world model, and in the environment `real_env`."""

    policies: Mapping[str, tuple[Proportion, Proportion]]

    @classmethod
    def of_outcomes(cls, outcomes: Mapping[str, tuple[Sequence[bool], Sequence[bool]]]) -> "Agreement":
        """Count successes from the outcomes of each policy's episodes in both environments."""

        def share(successes: Sequence[bool]) -> Proportion:
            return Proportion(sum(successes), len(successes))

        return cls({name: (share(imagined), share(real)) for name, (imagined, real) in outcomes.items()})

    def correlation(self) -> tuple[float, float, float]:
        """Return Pearson's r over policies with its 95 % interval (Fisher's); NaN where it is not defined."""
        imagined, real = ([pair[side].share for pair in self.policies.values()] for side in (0, 1))
        if len(self.policies) < MIN_POLICIES or len(set(imagined)) == 1 or len(set(real)) == 1:
            return (math.nan,) * 3
        found = pearsonr(imagined, real)
        interval = found.confidence_interval(0.95)
        return float(found.statistic), float(interval.low), float(interval.high)

    def as_json(self) -> dict[str, Any]:
        """R² is the square of Pearson's r: the share of the variance that a straight line explains."""
        r, low, high = (None if math.isnan(value) else value for value in self.correlation())
        return {
            "policies": {
                name: {"imagined": imagined.as_json(), "real": real.as_json()}
                for name, (imagined, real) in self.policies.items()
            },
            "pearson": {"value": r, "fisher_95": [low, high]},
            "r_squared": None if r is None else r * r,
        }

"""How often a policy succeeds in an environment, by LeRobot's own evaluation."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import torch
from lerobot.envs import make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.scripts.lerobot_eval import eval_policy, eval_policy_all
from lerobot.utils.constants import CHECKPOINTS_DIR

from lerobot_wmrl.common.policy_checkpoints import load_policy, load_processors, read_policy_config
from lerobot_wmrl.envs.evaluation_adapter import EvaluationAdapter, StepCounter


class Evaluated(NamedTuple):
    """Whether each episode succeeded, in the order of their seeds, and the steps that all of them took."""

    successes: list[bool]
    steps: int


def policy_checkpoints(paths: Sequence[str]) -> list[Path]:
    """All checkpoints of the trainings among `paths`, in order of their steps, and what is one itself.

    ValueError if there is none.
    """
    found = []
    for path in map(Path, paths):
        steps = [each for each in (path / CHECKPOINTS_DIR).glob("*") if each.name.isdigit()]
        found += sorted(steps, key=lambda each: int(each.name)) or [path]
    if not found:
        raise ValueError(f"--policies={list(paths)}: give checkpoints, or output folders of trainings")
    return found


def policy_outcomes(env: EnvConfig, path: Path, episodes: int, seed: int, num_envs: int) -> list[bool]:
    """Whether each of `episodes` succeeded, in the order of their seeds, `seed` the first."""
    config = read_policy_config(str(path), [])
    processors = load_processors(config)
    return evaluate_policy(env, load_policy(config), processors, episodes, seed, num_envs).successes


@torch.no_grad()
def evaluate_policy(
    env: EnvConfig, policy: Any, processors: tuple[Any, Any], episodes: int, seed: int, num_envs: int
) -> Evaluated:
    """The same of a policy in memory: `num_envs` episodes at once, in environments made for it."""
    made: Any = env.create_envs(min(num_envs, episodes), use_async_envs=True)
    envs = {suite: {task: StepCounter(one) for task, one in tasks.items()} for suite, tasks in made.items()}
    info = eval_policy_all(
        envs, policy, *make_env_pre_post_processors(env, policy.config), *processors,
        n_episodes=episodes, start_seed=seed,
    )  # fmt: skip
    successes = [bool(success) for task in info["per_task"] for success in task["metrics"]["successes"]]
    return Evaluated(successes, sum(one.steps for tasks in envs.values() for one in tasks.values()))


@torch.no_grad()
def evaluate_within(
    env: gym.vector.VectorEnv, config: EnvConfig, policy: Any, processors: tuple[Any, Any],
    episodes: int, seed: int,
) -> Evaluated:  # fmt: skip
    """The same in a tensor environment that is there already, of this configuration; it stays open."""
    counted: Any = StepCounter(EvaluationAdapter(env))
    info = eval_policy(
        counted, policy, *make_env_pre_post_processors(config, policy.config), *processors,
        n_episodes=episodes, start_seed=seed,
    )  # fmt: skip
    return Evaluated([bool(episode["success"]) for episode in info["per_episode"]], counted.steps)

"""How often a policy succeeds in an environment, by LeRobot's own evaluation."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lerobot.envs import make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.scripts.lerobot_eval import eval_policy_all
from lerobot.utils.constants import CHECKPOINTS_DIR

from lerobot_wmrl.policy_checkpoints import load_policy, load_processors, read_policy_config


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


@torch.no_grad()
def policy_outcomes(env: EnvConfig, path: Path, episodes: int, seed: int, num_envs: int) -> list[bool]:
    """Whether each of `episodes` succeeded, in the order of their seeds, `seed` the first."""
    config = read_policy_config(str(path), [])
    policy, (preprocessor, postprocessor) = load_policy(config), load_processors(config)
    env_processors = make_env_pre_post_processors(env_cfg=env, policy_cfg=config)
    envs: Any = env.create_envs(min(num_envs, episodes), use_async_envs=True)
    info = eval_policy_all(
        envs, policy, *env_processors, preprocessor, postprocessor, n_episodes=episodes, start_seed=seed
    )
    return [bool(success) for task in info["per_task"] for success in task["metrics"]["successes"]]

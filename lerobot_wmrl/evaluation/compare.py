"""Policies run from the same starts of an environment, block by block, until it is decided who is better."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import ceil
from typing import Any

import gymnasium as gym
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, env_to_policy_features
from lerobot.scripts.lerobot_eval import eval_policy
from lerobot.utils.constants import ACTION
from lerobot.utils.random_utils import set_seed

from lerobot_wmrl.common.checkpoints import resolved_name
from lerobot_wmrl.common.errors import FieldError, first_line
from lerobot_wmrl.common.policies import (
    LoadedPolicy,
    check_weights,
    fit_to_environment,
    load_processors,
    read_policy_config,
)
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.envs.lerobot_env import counts_resets, freeze_finished, is_own, runs_in_processes
from lerobot_wmrl.evaluation.comparison import Comparison, Episode
from lerobot_wmrl.world_models.checkpoint import load_model

type Envs = dict[str, dict[int, gym.vector.VectorEnv]]
"""Suite → task → vector environment, as LeRobot's make_env returns them."""


def read_policies(paths: Sequence[str], env: EnvConfig) -> dict[str, PreTrainedConfig]:
    """Read the configurations of policies, by the names of their checkpoints.

    Raises:
        FieldError: there is no checkpoint, it is given twice, or it does not fit the environment.
    """
    configs: dict[str, PreTrainedConfig] = {}
    imagined = isinstance(env, WorldModelEnv)
    model = load_model(env.world_model_path, "action_world_model") if imagined else None
    for path in paths:
        name = resolved_name(path)
        if name in configs:
            raise FieldError("policies", path, "is given twice", "give every checkpoint once")
        with about_policy(path):
            configs[name] = config = read_policy_config(name, [])
            check_weights(config)
            _check_environment(config, env)
            if model is not None:
                model.check_units(config, load_processors(config)[1])
    return configs


@contextmanager
def about_policy(path: str) -> Iterator[None]:
    """Let an error that leaves the block be a FieldError about the policy at `path`."""
    try:
        yield
    except FieldError as error:
        field = "" if error.field == "policy.path" else f"{error.field}={error.value}: "
        raise FieldError("policies", path, f"{field}{error.problem}", error.remedy) from error
    except ValueError as error:
        raise FieldError("policies", path, first_line(error)) from error


def _check_environment(config: PreTrainedConfig, env: EnvConfig) -> None:
    """Raise FieldError unless policy and environment fit; a policy without features takes the environment's.

    Only this project's environments are checked: LeRobot's own may show a policy more than they declare.
    """
    if not is_own(env):
        return
    features = env_to_policy_features(env)
    action = features.pop(ACTION)
    shown = {name: tuple(feature.shape) for name, feature in features.items()}
    fit_to_environment(config, shown, action.shape[0])


def load_policies(configs: Mapping[str, PreTrainedConfig]) -> list[LoadedPolicy]:
    """Load the policies with their processors. FieldError if one cannot be loaded."""
    loaded = []
    for name, config in configs.items():
        with about_policy(name):
            loaded.append(LoadedPolicy.load(config))
    return loaded


@contextmanager
def opened(config: EnvConfig, n_envs: int, trust_remote_code: bool, policies: int) -> Iterator[list[Envs]]:
    """Make the environments of that many policies, for `n_envs` episodes at once; close them in the end.

    This project's own are shared. LeRobot's are not: see `counts_resets`. Those of several tasks stay in this
    process: all of them are open at the same time.
    """
    own, parallel = is_own(config), runs_in_processes(config)

    def make() -> Envs:
        envs: Envs = make_env(config, n_envs, parallel, trust_remote_code=trust_remote_code)
        for env in _flat(envs):
            freeze_finished(env)
        return envs

    made = [make()]
    if parallel and not own and len(_flat(made[0])) > 1:
        close_envs(made.pop())
        parallel = False
    made += [make() for _ in range(len(made), 1 if own else policies)]
    try:
        yield made * policies if own else made
    finally:
        for envs in made:
            for adapter in _flat(envs):
                env = getattr(adapter, "env", adapter)
                if hasattr(env, "results"):
                    env.results.episodes.clear()  # the table by scene counts a seed for one policy
            close_envs(envs)


def _flat(envs: Envs) -> list[Any]:
    return [env for tasks in envs.values() for env in tasks.values()]


def require_new_starts(envs: Envs, config: EnvConfig, n_episodes: int) -> None:
    """Raise FieldError if a world model or LIBERO has too few starts: some would count twice."""
    if isinstance(config, WorldModelEnv):
        fewest = min(len(env.env.starts) for env in _flat(envs))
        said, more = "the world model has {} start frames", ", or give more with `env.dataset.max_starts`"
    elif counts_resets(config):
        fewest = min(len(states) for env in _flat(envs) for states in env.call("_init_states"))
        said, more = f"{config.type} has {{}} starts", ", or set `env.init_states` to false"
    else:
        return
    if n_episodes > fewest:
        raise FieldError(
            "n_episodes", n_episodes,
            f"{said.format(fewest)} for a task, and an episode that is repeated says nothing new",
            f"set it to at most {fewest}{more}",
        )  # fmt: skip


def run_comparison(
    comparison: Comparison, envs: Sequence[Envs], config: EnvConfig, policies: Sequence[LoadedPolicy],
    batch_size: int, seed: int, save: Callable[[], None],
) -> None:  # fmt: skip
    """Add blocks of `batch_size` starts of each task until the comparison is finished.

    Args:
        envs: those of each policy.
        seed: seed of the first start of each task; each further one adds one.
        save: called after every block.

    Raises:
        FieldError: LIBERO has skipped starts, since an earlier call ended within a batch.
    """
    if counts_resets(config) and not comparison.finished:
        if comparison.starts_per_task % batch_size:
            raise FieldError(
                "n_episodes", comparison.n_episodes,
                f"the {comparison.starts_per_task} starts so far end within a batch of {batch_size}, after "
                f"which {config.type} skips some", "choose a new `output_dir`",
            )  # fmt: skip
        for env in (each for own in envs for each in _flat(own)):
            for _ in range(ceil(comparison.starts_per_task / batch_size)):
                env.reset(options={NEW_ROLLOUT_OPTION: True})
    while not comparison.finished:
        done = comparison.starts_per_task
        count = min(batch_size, comparison.n_episodes - done)
        comparison.episodes.extend(run_block(envs, config, policies, count, seed + done))
        save()
        shares = (f"{name} {rate.share:.0%}" for name, rate in comparison.rates().items())
        logging.info("%d starts: %s", len(comparison.episodes), ", ".join(shares))


@torch.no_grad()
def run_block(
    envs: Sequence[Envs], config: EnvConfig, policies: Sequence[LoadedPolicy], count: int, seed: int
) -> list[Episode]:
    """Run every policy from the same `count` starts of each task."""
    outcomes: list[dict[tuple[str, int, int], bool]] = []
    for loaded, own_envs in zip(policies, envs, strict=True):
        set_seed(seed)  # a comparison that is continued draws the same random actions
        processors = *make_env_pre_post_processors(config, loaded.config), *loaded.processors
        outcomes.append({
            (suite, task, episode["seed"]): bool(episode["success"])
            for suite, tasks in own_envs.items()
            for task, env in tasks.items()
            for episode in eval_policy(
                env, loaded.policy, *processors, n_episodes=count, start_seed=seed
            )["per_episode"]
        })  # fmt: skip
    return [Episode(*start, [own[start] for own in outcomes]) for start in outcomes[0]]

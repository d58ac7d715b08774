"""Policies run in environments by LeRobot's evaluation: from the same starts, with the same dice, until it is
decided who is better."""

import logging
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from math import ceil
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.scripts.lerobot_eval import eval_policy
from lerobot.utils.random_utils import seeded_context

from lerobot_wmrl.common.checkpoints import resolved_name
from lerobot_wmrl.common.errors import FieldError, first_line
from lerobot_wmrl.common.policies import LoadedPolicy, check_weights, load_processors, read_policy_config
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.envs.evaluation_adapter import EvaluationAdapter
from lerobot_wmrl.envs.lerobot_env import (
    check_fit_to,
    counts_resets,
    freeze_finished,
    is_own,
    runs_in_processes,
)
from lerobot_wmrl.evaluation.comparison import Comparison, Episode
from lerobot_wmrl.world_models.checkpoint import load_model

type Envs = dict[str, dict[int, gym.vector.VectorEnv]]
"""Suite → task → vector environment, as LeRobot's make_env returns them."""


type SuccessByStart = dict[tuple[str, int, int], bool]
"""Success of each episode by its suite, task and seed."""


class PolicyEvaluation(NamedTuple):
    """Success of each episode, and the steps of all of them together."""

    outcomes: SuccessByStart
    steps: int

    @property
    def successes(self) -> list[bool]:
        """Success of each episode, task by task in the order of their seeds."""
        return list(self.outcomes.values())


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
            check_fit_to(env, config)
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
    shared, parallel = is_own(config), runs_in_processes(config)
    if parallel and not shared:  # each process would import it anew
        multiprocessing.get_context("forkserver").set_forkserver_preload(["lerobot.envs.utils"])

    def make() -> Envs:
        envs: Envs = make_env(config, n_envs, parallel, trust_remote_code=trust_remote_code)
        for env in flat(envs):
            freeze_finished(env)
        return envs

    made = [make()]
    if parallel and not shared and len(flat(made[0])) > 1:
        close_envs(made.pop())
        parallel = False
    made += [make() for _ in range(len(made), 1 if shared else policies)]
    try:
        yield made * policies if shared else made
    finally:
        for envs in made:
            for adapter in flat(envs):
                env = getattr(adapter, "env", adapter)
                if hasattr(env, "results"):
                    env.results.episodes.clear()  # the table by scene counts a seed for one policy
            close_envs(envs)


def flat(envs: Envs) -> list[Any]:
    """Return the vector environments of all tasks."""
    return [env for tasks in envs.values() for env in tasks.values()]


@torch.no_grad()
def run_policy(
    envs: Envs, config: EnvConfig, policy: LoadedPolicy, episodes: int, seed: int
) -> PolicyEvaluation:
    """Run LeRobot's evaluation of a policy in every task of open environments.

    Args:
        envs: environments of this configuration.
        seed: seed of the first episode of each task, each further one adds one; and of the random numbers of
            a policy that draws its actions.
    """
    processors = *make_env_pre_post_processors(config, policy.config), *policy.processors
    outcomes: SuccessByStart = {}
    steps = 0
    with seeded_context(seed):
        for suite, tasks in envs.items():
            for task, env in tasks.items():
                counted = StepCounter(env)
                results = eval_policy(
                    counted, policy.policy, *processors, n_episodes=episodes, start_seed=seed
                )["per_episode"]
                outcomes |= {(suite, task, each["seed"]): bool(each["success"]) for each in results}
                steps += counted.steps
    return PolicyEvaluation(outcomes, steps)


def run_block(
    envs: Sequence[Envs], config: EnvConfig, policies: Sequence[LoadedPolicy], count: int, seed: int
) -> list[Episode]:
    """Run every policy, in environments of its own, from the same `count` starts of each task."""
    outcomes = [
        run_policy(policy_envs, config, policy, count, seed).outcomes
        for policy, policy_envs in zip(policies, envs, strict=True)
    ]
    return [Episode(*start, [by_start[start] for by_start in outcomes]) for start in outcomes[0]]


def evaluate_policy(
    config: EnvConfig, policy: LoadedPolicy, episodes: int, seed: int, num_envs: int
) -> PolicyEvaluation:
    """Run a policy in `num_envs` environments of each task, which are closed before those of the next."""
    envs: Envs = make_env(config, min(num_envs, episodes), runs_in_processes(config))
    outcomes: SuccessByStart = {}
    steps = 0
    for suite, tasks in envs.items():
        for task, env in tasks.items():
            freeze_finished(env)
            with closing(env):
                evaluated = run_policy({suite: {task: env}}, config, policy, episodes, seed)
            outcomes |= evaluated.outcomes
            steps += evaluated.steps
    return PolicyEvaluation(outcomes, steps)


def evaluate_within(
    env: gym.vector.VectorEnv, config: EnvConfig, policy: LoadedPolicy, episodes: int, seed: int
) -> PolicyEvaluation:
    """Run a policy in an existing tensor environment of this configuration, which stays open."""
    return run_policy({config.type: {0: EvaluationAdapter(env)}}, config, policy, episodes, seed)


class StepCounter:
    """A vector environment that counts the steps of unfinished episodes in `steps`.

    In ManiSkill and on a robot, these are what an evaluation costs.
    """

    def __init__(self, env: gym.vector.VectorEnv) -> None:
        self.env, self.steps = env, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every sub-environment."""
        self._running = np.ones(self.env.num_envs, bool)
        return self.env.reset(**kwargs)

    def step(self, actions: Any) -> tuple[Any, ...]:
        """Step all, and count those whose first episode since the reset goes on."""
        self.steps += int(self._running.sum())
        result: tuple[Any, ...] = self.env.step(actions)
        self._running &= ~(result[2] | result[3])
        return result


def require_new_starts(envs: Envs, config: EnvConfig, n_episodes: int) -> None:
    """Raise FieldError if a world model or LIBERO has too few starts: some would count twice."""
    if isinstance(config, WorldModelEnv):
        starts = [len(env.env.starts) for env in flat(envs)]
        fewest, limited = min(starts), sum(starts) >= config.dataset.max_starts
        more = ", or give more with `env.dataset.max_starts`" if limited else ", or give more of them"
        problem = "the world model has {} start frames"
    elif counts_resets(config):
        fewest = min(len(states) for env in flat(envs) for states in env.call("_init_states"))
        problem, more = f"{config.type} has {{}} starts", ", or set `env.init_states` to false"
    else:
        return
    if n_episodes > fewest:
        raise FieldError(
            "n_episodes",
            n_episodes,
            f"{problem.format(fewest)} for a task, and an episode that is repeated says nothing new",
            f"set it to at most {fewest}{more}",
        )


def run_comparison(
    comparison: Comparison,
    envs: Sequence[Envs],
    config: EnvConfig,
    policies: Sequence[LoadedPolicy],
    batch_size: int,
    seed: int,
    save: Callable[[], None],
) -> None:
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
                "n_episodes",
                comparison.n_episodes,
                f"the {comparison.starts_per_task} starts so far end within a batch of {batch_size}, after "
                f"which {config.type} skips some",
                "choose a new `output_dir`",
            )
        for env in (each for policy_envs in envs for each in flat(policy_envs)):
            for _ in range(ceil(comparison.starts_per_task / batch_size)):
                env.reset(options={NEW_ROLLOUT_OPTION: True})
    while not comparison.finished:
        done = comparison.starts_per_task
        count = min(batch_size, comparison.n_episodes - done)
        comparison.episodes.extend(run_block(envs, config, policies, count, seed + done))
        save()
        shares = (f"{name} {rate.share:.0%}" for name, rate in comparison.rates().items())
        logging.info("%d starts: %s", len(comparison.episodes), ", ".join(shares))

"""Policies run from the same starts of an environment, block by block, until it is decided who is better."""

import logging
from collections.abc import Callable, Sequence
from math import ceil

from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import NEW_ROLLOUT_OPTION

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.envs.lerobot_env import counts_resets
from lerobot_wmrl.evaluation.comparison import Comparison
from lerobot_wmrl.evaluation.policy_rollouts import Envs, flat, run_block


def require_new_starts(envs: Envs, config: EnvConfig, n_episodes: int) -> None:
    """Raise FieldError if a world model or LIBERO has too few starts: some would count twice."""
    if isinstance(config, WorldModelEnv):
        fewest = min(len(env.env.starts) for env in flat(envs))
        problem, more = "the world model has {} start frames", ", or give more with `env.dataset.max_starts`"
    elif counts_resets(config):
        fewest = min(len(states) for env in flat(envs) for states in env.call("_init_states"))
        problem, more = f"{config.type} has {{}} starts", ", or set `env.init_states` to false"
    else:
        return
    if n_episodes > fewest:
        raise FieldError(
            "n_episodes", n_episodes,
            f"{problem.format(fewest)} for a task, and an episode that is repeated says nothing new",
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

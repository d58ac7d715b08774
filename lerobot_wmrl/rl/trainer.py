"""The training loop: collect, update, log, save, and run callbacks. It resumes bit for bit on a CPU."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
from lerobot.rl.algorithms.configs import RLAlgorithmConfig
from lerobot.utils.constants import ALGORITHM_DIR, PRETRAINED_MODEL_DIR
from lerobot.utils.logging_utils import MetricsTracker
from tqdm import tqdm

from lerobot_wmrl.common.checkpoints import (
    checkpoint_dir,
    newest_checkpoint,
    read_weights,
    should_save_checkpoint,
)
from lerobot_wmrl.common.distributed import is_first_process, rank_and_size, wait_for_all
from lerobot_wmrl.common.errors import TrainingStopped
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.common.tracking import Tracker
from lerobot_wmrl.common.training_state import load_training_state, save_checkpoint
from lerobot_wmrl.envs.tensor_env import TensorEnv
from lerobot_wmrl.rl.algorithm import Algorithm
from lerobot_wmrl.rl.callbacks import Callback, Callbacks
from lerobot_wmrl.rl.configuration_distillation import DistillationConfig
from lerobot_wmrl.rl.configuration_grpo import GRPOConfig
from lerobot_wmrl.rl.distillation import Distillation
from lerobot_wmrl.rl.grpo import GRPO
from lerobot_wmrl.rl.policy_gradient import PolicyGradient
from lerobot_wmrl.rl.ppo import PPO
from lerobot_wmrl.rl.rollout import RolloutBuffer
from lerobot_wmrl.rl.seeds import first_seed

SHOWN = (
    "success_rate",
    "reward",
    "groups_with_signal",
    "policy_loss",
    "value_loss",
    "explained_variance",
    "kl",
    "reference_kl",
    "clip_fraction",
    "entropy",
    "rollout_s",
    "update_s",
)
"""Metrics that a line in the terminal shows; metrics.jsonl has all."""

IN_PROGRESS_BAR = ("success_rate", "reference_kl")


@dataclass(frozen=True)
class Schedule:
    """How long to train.

    Args:
        iterations: rollouts, each followed by an update.
        save_freq: iterations between checkpoints.
        seed: the training's, from which `first_seed` makes those of its episodes.
        log_freq: iterations between lines in the terminal.
    """

    iterations: int
    save_freq: int
    seed: int
    log_freq: int = 1


def make_algorithm(policy: Any, config: RLAlgorithmConfig, output_dir: Path) -> Algorithm:
    """Return the algorithm that `config` describes, to train `policy` in `output_dir`."""
    if isinstance(config, DistillationConfig):
        return Distillation(policy, config, output_dir)
    algorithm: type[PolicyGradient] = GRPO if isinstance(config, GRPOConfig) else PPO
    return algorithm(policy, config)


def train(
    env: gym.vector.VectorEnv,
    algorithm: Algorithm,
    pipeline: Pipeline,
    rollout: RolloutBuffer,
    schedule: Schedule,
    output_dir: Path,
    save_pretrained: Callable[[Path], None],
    callbacks: Sequence[Callback] = (),
    wandb: Any = None,
) -> None:
    """Train until the end of the schedule, from the latest checkpoint in `output_dir` if there is one.

    Every iteration starts new episodes, so one that was killed can be repeated. Callbacks that are due run
    before the first iteration and after each one, always with a checkpoint of that moment. A training that
    an algorithm stops before it has changed the policy leaves a checkpoint of the iteration before.

    Args:
        env: vectorised environment on the device.
        algorithm: trains its `policy`.
        pipeline: the policy's processors.
        rollout: buffer that each iteration fills.
        schedule: how long to train.
        output_dir: where checkpoints, metrics and records go.
        save_pretrained: writes a checkpoint's `pretrained_model`.
        callbacks: run between iterations, in this order.
        wandb: LeRobot's WandBLogger.

    Raises:
        TrainingStopped: the algorithm or a callback ends the training.
    """
    checkpoint, total = resume(algorithm, output_dir), schedule.iterations
    write = partial(save, algorithm, output_dir, total, save_pretrained)
    tracker = make_tracker(output_dir, rollout, schedule, algorithm.iteration, wandb)
    runner = Callbacks(callbacks, output_dir, total, tracker)
    with progress_bar(algorithm, total) as progress:
        runner.resume(algorithm.iteration)
        wait_for_all()  # else a slow process would read records that the first one writes below
        if runner.due(algorithm.iteration):
            runner.run(algorithm.iteration, checkpoint or write())
        while algorithm.iteration < total:
            with saving_at_a_stop(output_dir, total, algorithm.iteration, write):
                metrics = iterate(env, algorithm, pipeline, rollout, schedule)
            step = algorithm.iteration
            tracker.log_step(step, {**metrics, **runner.real_steps()})
            advance(progress, metrics)
            if should_save_checkpoint(step, schedule.save_freq, total) or runner.due(step):
                checkpoint = write()
                tracker.log_policy(checkpoint)
                runner.run(step, checkpoint)


def progress_bar(algorithm: Algorithm, total: int) -> tqdm:
    """Return a progress bar over the iterations; of several processes the first shows it."""
    name, begun = algorithm.name.upper(), algorithm.iteration
    return tqdm(total=total, initial=begun, desc=name, unit="iteration", disable=not is_first_process())


def advance(progress: tqdm, metrics: Mapping[str, float]) -> None:
    """Show an iteration's metrics beside the progress bar."""
    progress.set_postfix({name: f"{metrics[name]:.2f}" for name in IN_PROGRESS_BAR if name in metrics})
    progress.update()


@contextmanager
def saving_at_a_stop(
    output_dir: Path, total: int, iteration: int, write: Callable[[], Path]
) -> Iterator[None]:
    """Let the algorithm's TrainingStopped say how to go on, since the same settings would stop again.

    A policy that is still that of `iteration`, the last finished one, is written unless it is there.
    """
    try:
        yield
    except TrainingStopped as stop:
        if stop.before_update and iteration and not checkpoint_dir(output_dir, total, iteration).is_dir():
            write()
        begun = newest_checkpoint(output_dir) is not None
        further = f", and go on from here with `policy.path`={output_dir}" if begun else ""
        raise TrainingStopped(f"{stop}. Other settings need another `output_dir`{further}") from stop


def iterate(
    env: TensorEnv,
    algorithm: Algorithm,
    pipeline: Pipeline,
    rollout: RolloutBuffer,
    schedule: Schedule,
) -> dict[str, float]:
    """Run one iteration of the algorithm on seeds of its own, and return metrics."""
    rank, processes = rank_and_size()
    num_envs = rollout.num_envs * processes
    seed = first_seed(schedule.seed, algorithm.iteration, num_envs) + rank * rollout.num_envs
    last = algorithm.iteration + 1 == schedule.iterations
    metrics = algorithm.iterate(env, pipeline, rollout, seed, last)
    return {**metrics, "env_steps": algorithm.iteration * rollout.steps * num_envs}


def make_tracker(
    output_dir: Path, rollout: RolloutBuffer, schedule: Schedule, iteration: int, wandb: Any
) -> Tracker:
    """Return a tracker in LeRobot's units: an environment step is a sample, an environment's rollout an
    episode, and the whole schedule an epoch."""
    num_envs, total = rollout.num_envs * rank_and_size()[1], schedule.iterations
    samples = rollout.steps * num_envs
    meters = MetricsTracker(samples, samples * total, num_envs * total, {}, initial_step=iteration)
    return Tracker(output_dir, meters, SHOWN, schedule.log_freq, wandb)


def save(algorithm: Algorithm, output_dir: Path, total: int, save_pretrained: Callable[[Path], None]) -> Path:
    """Write a checkpoint of policy and algorithm, and return its folder."""

    def write_models(folder: Path) -> None:
        save_pretrained(folder / PRETRAINED_MODEL_DIR)
        algorithm.save_pretrained(folder / ALGORITHM_DIR)

    return save_checkpoint(output_dir, total, algorithm.iteration, write_models, algorithm.optimizer)


def resume(algorithm: Algorithm, output_dir: Path) -> Path | None:
    """Load the latest checkpoint in `output_dir`, if there is one, and return it."""
    checkpoint = newest_checkpoint(output_dir)
    if checkpoint is None:
        return None
    algorithm.iteration = load_training_state(checkpoint, algorithm.optimizer)
    algorithm.load_weights(read_weights(checkpoint))
    algorithm.load_state_dict(read_weights(checkpoint, ALGORITHM_DIR))
    return checkpoint

"""The loop around an algorithm: collect, improve, log, keep, pause. Resumes bit by bit on a CPU."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from lerobot.common.train_utils import (
    get_step_checkpoint_dir,
    load_training_num_processes,
    load_training_state,
    save_training_state,
    should_save_checkpoint,
)
from lerobot.utils.constants import ALGORITHM_DIR, PRETRAINED_MODEL_DIR
from lerobot.utils.logging_utils import MetricsTracker
from tqdm import tqdm

from lerobot_wmrl.common.checkpoints import latest_checkpoint, read_weights, write_checkpoint
from lerobot_wmrl.common.constants import EVALUATION_SEED
from lerobot_wmrl.common.distributed import rank_and_size, wait_for_all
from lerobot_wmrl.common.tracking import Tracker
from lerobot_wmrl.rl.callbacks import Callback, Callbacks
from lerobot_wmrl.rl.policy_gradient import PolicyGradient
from lerobot_wmrl.rl.protocol import Pipeline
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect

SHOWN = (
    "success_rate", "reward", "policy_loss", "value_loss", "explained_variance", "kl", "reference_kl",
    "clip_fraction", "entropy", "rollout_s", "update_s",
)  # fmt: skip
"""What a line in the terminal has of an iteration's metrics; metrics.jsonl has all."""


@dataclass(frozen=True)
class Schedule:
    """How long to train: `iterations` rollouts from `seed` on, a checkpoint every `save_freq` of them, a line
    in the terminal every `log_freq`."""

    iterations: int
    save_freq: int
    seed: int
    log_freq: int = 1


def rollout_seed(seed: int, iteration: int, num_envs: int) -> int:
    """First of the `num_envs` environment seeds of an iteration, all of them below EVALUATION_SEED."""
    return (seed + iteration * num_envs) % (EVALUATION_SEED - num_envs)


def train(
    env: gym.vector.VectorEnv, algorithm: PolicyGradient, pipeline: Pipeline, buffer: RolloutBuffer,
    schedule: Schedule, output_dir: Path, save_pretrained: Callable[[Path], None],
    callbacks: Sequence[Callback] = (), wandb: Any = None,
) -> None:  # fmt: skip
    """Run what is left of the schedule. An iteration begins with fresh episodes, so that it can be repeated.

    `save_pretrained` writes a checkpoint's `pretrained_model`. Callbacks run where they are due, before the
    first iteration or after one, and find a checkpoint there. `wandb`: LeRobot's WandBLogger.
    """
    checkpoint, total = resume(algorithm, output_dir), schedule.iterations
    tracker = make_tracker(output_dir, buffer, schedule, algorithm.iteration, wandb)
    pauses = Callbacks(callbacks, output_dir, total, tracker)
    with progress_bar(algorithm, total) as progress:
        pauses.resume(algorithm.iteration)
        wait_for_all()  # else a slow process would find what the first one has written since
        if pauses.due(algorithm.iteration):
            pauses.run(algorithm.iteration, checkpoint or save(algorithm, output_dir, total, save_pretrained))
        while algorithm.iteration < total:
            metrics = iterate(env, algorithm, pipeline, buffer, schedule.seed)
            step = algorithm.iteration
            tracker.log_step(step, {**metrics, **pauses.real_steps()})
            progress.set_postfix(
                success=f"{metrics['success_rate']:.2f}", kl=f"{metrics['reference_kl']:.2f}"
            )
            progress.update()
            if should_save_checkpoint(step, schedule.save_freq, total) or pauses.due(step):
                checkpoint = save(algorithm, output_dir, total, save_pretrained)
                tracker.log_policy(checkpoint)
                pauses.run(step, checkpoint)


def iterate(
    env: gym.vector.VectorEnv, algorithm: PolicyGradient, pipeline: Pipeline, buffer: RolloutBuffer, seed: int
) -> dict[str, float]:
    """A rollout and what is learnt from it. → numbers to log"""
    started = time.perf_counter()
    first = rollout_seed(seed, algorithm.iteration, buffer.total_envs)
    rollout = collect(env, algorithm.policy, pipeline, buffer, first, algorithm.group_size)
    collected = time.perf_counter()
    stats = algorithm.improve(buffer, pipeline).to_log_dict()
    seconds = {"rollout_s": collected - started, "update_s": time.perf_counter() - collected}
    return {
        **rollout,
        **stats,
        **seconds,
        "env_steps": algorithm.iteration * buffer.steps * buffer.total_envs,
    }


def make_tracker(
    output_dir: Path, buffer: RolloutBuffer, schedule: Schedule, iteration: int, wandb: Any
) -> Tracker:
    """LeRobot's lines with steps as samples, rollouts as episodes, and the whole schedule as one epoch."""
    samples, total = buffer.steps * buffer.total_envs, schedule.iterations
    meters = MetricsTracker(samples, samples * total, buffer.total_envs * total, {}, initial_step=iteration)
    return Tracker(output_dir, meters, SHOWN, schedule.log_freq, wandb)


def progress_bar(algorithm: PolicyGradient, total: int) -> tqdm:
    """Iterations, and the time left."""
    return tqdm(
        total=total, initial=algorithm.iteration, desc=algorithm.name.upper(), unit="iteration",
        disable=rank_and_size()[0] > 0,
    )  # fmt: skip


def save(
    algorithm: PolicyGradient, output_dir: Path, total: int, save_pretrained: Callable[[Path], None]
) -> Path:
    """A whole checkpoint or none: policy, algorithm, optimiser, random states, iteration."""

    def write(folder: Path) -> None:
        save_pretrained(folder / PRETRAINED_MODEL_DIR)
        algorithm.save_pretrained(folder / ALGORITHM_DIR)
        save_training_state(
            folder, algorithm.iteration, algorithm.optimizer, num_processes=rank_and_size()[1]
        )

    if rank_and_size()[0] == 0:
        write_checkpoint(output_dir, total, algorithm.iteration, write)
    wait_for_all()
    return get_step_checkpoint_dir(output_dir, total, algorithm.iteration)


def resume(algorithm: PolicyGradient, output_dir: Path) -> Path | None:
    """Continue from the latest checkpoint in `output_dir`, if there is one."""
    checkpoint = latest_checkpoint(output_dir)
    if checkpoint is None:
        return None
    began_with, size = load_training_num_processes(checkpoint) or 1, rank_and_size()[1]
    if began_with != size:
        raise ValueError(
            f"--output_dir={output_dir}: this run began with {began_with} processes, here are {size}; "
            f"continue it with torchrun --nproc_per_node={began_with}"
        )
    algorithm.load_weights(read_weights(checkpoint))
    algorithm.load_state_dict(read_weights(checkpoint, ALGORITHM_DIR))
    algorithm.iteration, _, _ = load_training_state(checkpoint, algorithm.optimizer, None)
    return checkpoint

"""The loop around an algorithm: collect, improve, log, keep. Resumes bit by bit on a CPU."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
from lerobot.common.train_utils import load_training_state, save_training_state, should_save_checkpoint
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from tqdm import tqdm

from lerobot_wmrl.checkpoints import latest_checkpoint, read_weights, write_checkpoint
from lerobot_wmrl.constants import EVALUATION_SEED
from lerobot_wmrl.rl.ppo import PPO
from lerobot_wmrl.rl.protocol import Pipeline
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect
from lerobot_wmrl.tracking import append_metrics


@dataclass(frozen=True)
class Schedule:
    """How long to train: `iterations` rollouts from `seed` on, a checkpoint every `save_freq` of them."""

    iterations: int
    save_freq: int
    seed: int


def rollout_seed(seed: int, iteration: int, num_envs: int) -> int:
    """First of the `num_envs` environment seeds of an iteration, all of them below EVALUATION_SEED."""
    return (seed + iteration * num_envs) % (EVALUATION_SEED - num_envs)


def train(
    env: gym.vector.VectorEnv, algorithm: PPO, pipeline: Pipeline, buffer: RolloutBuffer,
    schedule: Schedule, output_dir: Path, save_pretrained: Callable[[Path], None],
) -> None:  # fmt: skip
    """Run what is left of the schedule. An iteration begins with fresh episodes, so that it can be repeated.

    `save_pretrained` writes a checkpoint's `pretrained_model`.
    """
    resume(algorithm, output_dir)
    total = schedule.iterations
    progress = tqdm(total=total, initial=algorithm.iteration, desc="PPO", unit="iteration")
    while algorithm.iteration < total:
        started = time.perf_counter()
        seed = rollout_seed(schedule.seed, algorithm.iteration, buffer.num_envs)
        rollout = collect(env, algorithm.policy, pipeline, buffer, seed)
        collected = time.perf_counter()
        stats = algorithm.improve(buffer, pipeline).to_log_dict()
        seconds = {"rollout_s": collected - started, "update_s": time.perf_counter() - collected}
        step = algorithm.iteration
        append_metrics(output_dir, step, {**rollout, **stats, **seconds})
        if should_save_checkpoint(step, schedule.save_freq, total):
            save(algorithm, output_dir, total, save_pretrained)
        progress.set_postfix(success=f"{rollout['success_rate']:.2f}", kl=f"{stats['reference_kl']:.2f}")
        progress.update()
    progress.close()


def save(algorithm: PPO, output_dir: Path, total: int, save_pretrained: Callable[[Path], None]) -> None:
    """A whole checkpoint or none: the policy, the optimiser, the random states, the iteration."""

    def write(folder: Path) -> None:
        save_pretrained(folder / PRETRAINED_MODEL_DIR)
        save_training_state(folder, algorithm.iteration, algorithm.optimizer)

    write_checkpoint(output_dir, total, algorithm.iteration, write)


def resume(algorithm: PPO, output_dir: Path) -> None:
    """Continue from the latest checkpoint in `output_dir`, if there is one."""
    checkpoint = latest_checkpoint(output_dir)
    if checkpoint is None:
        return
    algorithm.load_weights(read_weights(checkpoint))
    algorithm.iteration, _, _ = load_training_state(checkpoint, algorithm.optimizer, None)

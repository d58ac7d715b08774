"""The training loop of tokenizer and world models: seeded, resumable, logged, on one or more devices.

Under `torchrun` every process draws batches of `batch_size` from a seed of its own, DistributedDataParallel
averages the gradients, and the first process alone writes.
"""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from accelerate import PartialState
from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.factory import make_reward_model
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from lerobot.utils.random_utils import set_seed
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel
from torch.optim import Optimizer
from tqdm import tqdm

from lerobot_wmrl.common.checkpoints import newest_checkpoint, should_save_checkpoint
from lerobot_wmrl.common.cuda_graphs import cuda_graphs
from lerobot_wmrl.common.distributed import is_first_process, mean_over_processes, process_seed
from lerobot_wmrl.common.precision import compute_in, training_dtype
from lerobot_wmrl.common.tracking import log_metrics
from lerobot_wmrl.common.training_state import load_training_state, save_checkpoint
from lerobot_wmrl.data.episodes import EpisodeTable
from lerobot_wmrl.world_models.checkpoint import check_dataset, load_model, load_model_to_continue
from lerobot_wmrl.world_models.configuration_frame_tokenizer import cosine_schedule
from lerobot_wmrl.world_models.configuration_world_model import TextWorldModelConfig
from lerobot_wmrl.world_models.training_data import golden_episodes, make_clip_sampler

HELD_OUT_BATCHES = 8
"""Held-out batches on which a trained world model is measured, which takes a few seconds."""


class TrainingSettings(Protocol):
    """Settings of a command that the training loop reads."""

    output_dir: Path
    steps: int
    save_freq: int
    log_freq: int
    seed: int
    precision: str


def build_model(config: RewardModelConfig, table: EpisodeTable, output_dir: Path) -> PreTrainedRewardModel:
    """Return a fresh model with the dataset's statistics, or the latest checkpoint of this run."""
    checkpoint, meta = newest_checkpoint(output_dir), table.dataset.meta
    if checkpoint is not None:
        model: PreTrainedRewardModel = load_model(checkpoint, config.type, config.device or "cpu")
        check_dataset(model.config, meta)
        model.config.pretrained_path = config.pretrained_path  # as of a run that was never interrupted
        return model
    if not config.pretrained_path:
        return make_reward_model(config, dataset_stats=meta.stats, dataset_meta=meta)
    return load_model_to_continue(config, meta)


def train(
    model: PreTrainedRewardModel,
    sampler: Callable[[int], Any],
    settings: TrainingSettings,
    save_config: Callable[[Path], None],
    wandb: Any = None,
) -> None:
    """Train from the last checkpoint in `output_dir` to `steps`.

    Args:
        model: is trained in place.
        sampler: step → batch.
        settings: steps, folder, seed and precision.
        save_config: writes the command's configuration into a checkpoint.
        wandb: LeRobot's WandBLogger, None without.

    Raises:
        ValueError: the loss or its gradient is not finite; no new checkpoint is written.
    """
    device = model.config.device
    processes = PartialState(cpu=torch.device(device).type == "cpu")
    set_seed(process_seed(settings.seed))
    preset: Any = model.config.get_optimizer_preset()
    optimizer = preset.build([p for p in model.parameters() if p.requires_grad])
    scheduler = cosine_schedule(preset.lr, settings.steps).build(optimizer, settings.steps)
    checkpoint = newest_checkpoint(settings.output_dir)
    first = 0 if checkpoint is None else load_training_state(checkpoint, optimizer, scheduler)
    network = DistributedDataParallel(model) if processes.num_processes > 1 else model

    def write_models(folder: Path) -> None:
        model.save_pretrained(folder / PRETRAINED_MODEL_DIR)
        save_config(folder / PRETRAINED_MODEL_DIR)

    model.train()
    began, dtype = time.monotonic(), training_dtype(settings.precision, device)
    progress = progress_bar(model.name, first, settings.steps)
    for step in range(first + 1, settings.steps + 1):
        with cuda_graphs(), compute_in(dtype, device):
            loss, metrics = network(sampler(step - 1), (step - 1) / settings.steps)
        metrics |= optimizer_step(model, loss, optimizer, preset.grad_clip_norm)
        scheduler.step()
        if step % settings.log_freq == 0 or step == settings.steps:
            metrics = mean_over_processes(metrics, device)
            metrics["steps_per_s"] = (step - first) / (time.monotonic() - began)
            progress.set_postfix(loss=f"{metrics['loss']:.3f}")
            log_metrics(settings.output_dir, step, metrics, wandb)
        if should_save_checkpoint(step, settings.save_freq, settings.steps):
            save_checkpoint(settings.output_dir, settings.steps, step, write_models, optimizer, scheduler)
        progress.update()
    progress.close()


def progress_bar(name: str, first: int, steps: int) -> tqdm:
    """Show steps done and the time left, in the first process."""
    quiet = not is_first_process()
    return tqdm(total=steps, initial=first, desc=f"Training {name}", unit="step", disable=quiet)


def optimizer_step(
    model: torch.nn.Module, loss: Tensor, optimizer: Optimizer, grad_clip_norm: float
) -> dict[str, float]:
    """Take one optimizer step and return the loss and the norm of its gradient.

    Raises:
        ValueError: one of them is not finite. The weights are left as they are.
    """
    value = mean_over_processes({"loss": loss.item()}, loss.device)["loss"]
    require_finite("loss", value)
    optimizer.zero_grad()
    loss.backward()
    grad_norm = torch.nn.utils.clip_grad_norm_(model.parameters(), grad_clip_norm).item()
    require_finite("gradient's norm", grad_norm)
    optimizer.step()
    return {"loss": value, "grad_norm": grad_norm}


def require_finite(name: str, value: float) -> None:
    """Raise ValueError on a NaN or infinity."""
    if not math.isfinite(value):
        raise ValueError(f"the {name} is {value}; the last checkpoint is kept: lower the learning rate")


@torch.no_grad()
def held_out_metrics(
    model: Any, table: EpisodeTable, batch_size: int, chosen: Sequence[int] | None = None
) -> dict[str, float]:
    """Average a world model's losses over clips of episodes that are held out; empty if there are none.

    chosen: the episodes that were learnt from and held out, all by default.
    """
    episodes = table.validation & table.among(chosen)
    if isinstance(model.config, TextWorldModelConfig):
        episodes &= golden_episodes(table)
    if not episodes.any():
        return {}
    sampler = make_clip_sampler(model, table, episodes.nonzero()[0], batch_size, seed=0)
    sampler.done_pos_weight = 1.0
    model.eval()
    every = []
    with torch.random.fork_rng():
        torch.manual_seed(0)  # the frames of a clip that are compared
        for batch in range(HELD_OUT_BATCHES):
            loss, metrics = model(sampler(batch), 0.0)
            every.append({"loss": loss.item(), **metrics})
    return {name: float(np.mean([metrics[name] for metrics in every])) for name in every[0]}

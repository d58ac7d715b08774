"""The one training loop of tokenizer and world models: seeded, resumable, logged, on one or more devices.

Under `torchrun` every process draws batches of `batch_size` from a seed of its own, DistributedDataParallel
averages the gradients, and the first process alone writes.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

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

from lerobot_wmrl.common.checkpoints import latest_checkpoint, write_checkpoint
from lerobot_wmrl.common.constants import KINDS, START_KIND
from lerobot_wmrl.common.distributed import mean_over_processes
from lerobot_wmrl.common.lerobot_compat import (
    gather_random_states,
    load_training_state,
    save_training_state,
    should_save_checkpoint,
)
from lerobot_wmrl.common.precision import compute_in, training_dtype
from lerobot_wmrl.common.tracking import append_metrics
from lerobot_wmrl.data.clips import ClipSampler, FrameSampler, InTurn
from lerobot_wmrl.data.episodes import (
    EpisodeTable,
    TrainingData,
    check_dataset,
    open_dataset,
    read_episodes,
)
from lerobot_wmrl.data.frame_cache import cached_context, cached_depth, cached_frames, cached_tokens
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.configuration_frame_tokenizer import cosine_schedule
from lerobot_wmrl.world_models.configuration_world_model import TextWorldModelConfig


def build_model(config: RewardModelConfig, table: EpisodeTable, output_dir: Path) -> PreTrainedRewardModel:
    """A fresh model with the dataset's statistics, or the latest checkpoint of this run."""
    checkpoint, meta = latest_checkpoint(output_dir), table.dataset.meta
    if checkpoint is not None:
        model = load_model(checkpoint, config.type, config.device or "cpu")
        check_dataset(model.config, meta.features)
        return model
    return make_reward_model(config, dataset_stats=meta.stats, dataset_meta=meta)


def golden_episodes(table: EpisodeTable) -> np.ndarray:
    """Mark the episodes that the text world model learns from. (E,)

    They are successes of an optimal planner, or all successes of a dataset that does not say who acted.
    """
    kind = table.column(START_KIND)
    return table.success & ((kind == KINDS.index("optimal")) | (kind == -1))


def make_sampler(
    model: PreTrainedRewardModel,
    table: EpisodeTable,
    chosen: Sequence[int] | None,
    batch_size: int,
    seed: int,
    done_known: bool = True,
) -> ClipSampler | FrameSampler:
    """Batches for this kind of model from the episodes that are not held out, and `chosen` if some are.

    `done_known`: as in `ClipSampler`.
    """
    config: Any = model.config
    episodes = ~table.validation & table.among(chosen)
    if not episodes.any():
        raise ValueError(
            f"dataset.root={table.dataset.root}: has no episode to train on; record some first, or choose "
            "others with --dataset.episodes: every twentieth is held out"
        )
    if model.name == "frame_tokenizer":
        frames = cached_frames(table.dataset, config.tokenizer.camera_keys)
        return FrameSampler(
            table, frames, episodes.nonzero()[0], config.tokenizer.cameras, batch_size, seed, config.device
        )
    if isinstance(config, TextWorldModelConfig):
        episodes = episodes & golden_episodes(table)
        if not episodes.any():
            raise ValueError(
                "the text world model learns from successful optimal episodes; the dataset has none"
            )
    elif not table.done_known:
        logging.warning(
            "dataset.root=%s: has neither next.success nor next.done: the model cannot learn from it what "
            "success is, and from it alone learns that nothing succeeds",
            table.dataset.root,
        )
    tokenizer: Any = model.tokenizer
    cameras = config.tokenizer.camera_keys
    tokens = cached_tokens(table.dataset, cameras, tokenizer)
    depth = cached_depth(table.dataset, cameras, tokenizer.grid) if config.depth else None
    context = None
    if config.context_channels:
        context = cached_context(table.dataset, cameras, tokenizer)
    return ClipSampler(
        table, tokens, episodes.nonzero()[0], config.clip_length, config.from_start, batch_size, seed,
        config.device, depth, context, done_known,
    )  # fmt: skip


def make_joint_sampler(
    model: PreTrainedRewardModel, table: EpisodeTable, data: TrainingData, batch_size: int, seed: int
) -> ClipSampler | FrameSampler | InTurn:
    """Batches from the episodes of `data`, which are in `table`, and from its further datasets.

    Where some of them say what success is, those that do not leave done alone.
    """
    more = [read_episodes(open_dataset(root)) for root in data.more]
    for other in more:
        check_dataset(model.config, other.dataset.features)
    unlabelled = not any(each.done_known for each in (table, *more))
    first, *others = (
        make_sampler(model, each, chosen, batch_size, seed, unlabelled or each.done_known)
        for each, chosen in zip((table, *more), (data.episodes, *[None] * len(more)), strict=True)
    )
    return InTurn(first, others) if others else first


def train(
    model: PreTrainedRewardModel,
    sampler: ClipSampler | FrameSampler | InTurn,
    cfg: Any,
    save_config: Callable[[Path], None],
) -> None:
    """Optimise from the last checkpoint to `cfg.steps`. ValueError (and no new checkpoint) on a NaN loss."""
    processes = PartialState()
    set_seed(cfg.seed + processes.process_index)
    preset: Any = model.config.get_optimizer_preset()
    optimizer = preset.build([p for p in model.parameters() if p.requires_grad])
    scheduler = cosine_schedule(preset.lr, cfg.steps).build(optimizer, cfg.steps)
    checkpoint = latest_checkpoint(cfg.output_dir)
    first = 0 if checkpoint is None else load_training_state(checkpoint, optimizer, scheduler)
    network = DistributedDataParallel(model) if processes.num_processes > 1 else model
    device: str = model.config.device
    dtype = training_dtype(cfg.precision, device)

    def save(folder: Path) -> None:
        model.save_pretrained(folder / PRETRAINED_MODEL_DIR)
        save_config(folder / PRETRAINED_MODEL_DIR)
        save_training_state(folder, step, random_states, optimizer, scheduler)

    model.train()
    began = time.monotonic()
    progress = tqdm(total=cfg.steps, initial=first, desc=f"Training {model.name}", unit="step",
                    disable=not processes.is_main_process)  # fmt: skip
    for step in range(first + 1, cfg.steps + 1):
        model.training_progress = (step - 1) / cfg.steps
        with compute_in(dtype, device):
            loss, metrics = network(sampler(step - 1))
        metrics |= descend(model, loss, optimizer, preset.grad_clip_norm)
        scheduler.step()
        if step % cfg.log_freq == 0 or step == cfg.steps:
            metrics = mean_over_processes(metrics, device)
            metrics["steps_per_s"] = (step - first) / (time.monotonic() - began)
            log(cfg.output_dir, step, metrics, progress)
        if should_save_checkpoint(step, cfg.save_freq, cfg.steps):
            random_states = gather_random_states()
            if processes.is_main_process:
                write_checkpoint(cfg.output_dir, cfg.steps, step, save)
        progress.update()
    progress.close()


def log(output_dir: Path, step: int, metrics: dict[str, float], progress: tqdm) -> None:
    """Show the loss, and let the first process write a line of metrics."""
    progress.set_postfix(loss=f"{metrics['loss']:.3f}")
    if PartialState().is_main_process:
        append_metrics(output_dir, step, metrics)


def descend(
    model: torch.nn.Module, loss: Tensor, optimizer: Optimizer, grad_clip_norm: float
) -> dict[str, float]:
    """One optimiser step. → the loss and the norm of its gradient. ValueError, and no step, if one is NaN."""
    value = mean_over_processes({"loss": loss.item()}, loss.device)["loss"]
    require_finite("loss", value)
    optimizer.zero_grad()
    loss.backward()
    grad_norm = torch.nn.utils.clip_grad_norm_(model.parameters(), grad_clip_norm).item()
    require_finite("gradient's norm", grad_norm)
    optimizer.step()
    return {"loss": value, "grad_norm": grad_norm}


def require_finite(name: str, value: float) -> None:
    """ValueError on a NaN or infinity."""
    if not math.isfinite(value):
        raise ValueError(f"the {name} is {value}; the last checkpoint is kept: lower --model.learning_rate")

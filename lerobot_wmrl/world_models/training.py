"""The one training loop of tokenizer and world models: seeded, resumable, logged."""

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from lerobot.common.train_utils import (
    load_training_state,
    save_training_state,
    should_save_checkpoint,
)
from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.factory import make_reward_model
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from lerobot.utils.random_utils import set_seed
from torch import Tensor
from tqdm import tqdm

from lerobot_wmrl.checkpoints import latest_checkpoint, write_checkpoint
from lerobot_wmrl.tracking import append_metrics
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.clips import ClipSampler, FrameSampler
from lerobot_wmrl.world_models.configuration_frame_tokenizer import cosine_schedule
from lerobot_wmrl.world_models.configuration_world_model import TextWorldModelConfig
from lerobot_wmrl.world_models.episode_table import EpisodeTable, golden_episodes
from lerobot_wmrl.world_models.frame_cache import cached_frames, cached_tokens

LossFunction = Callable[[Any], tuple[Tensor, dict[str, float]]]


def build_model(config: RewardModelConfig, table: EpisodeTable, output_dir: Path) -> PreTrainedRewardModel:
    """A fresh model with the dataset's statistics, or the latest checkpoint of this run."""
    checkpoint = latest_checkpoint(output_dir)
    if checkpoint is not None:
        return load_model(checkpoint, config.type, config.device or "cpu")
    meta = table.dataset.meta
    return make_reward_model(config, dataset_stats=meta.stats, dataset_meta=meta)


def make_sampler(
    model: PreTrainedRewardModel, table: EpisodeTable, batch_size: int, seed: int
) -> ClipSampler | FrameSampler:
    """Batches for this kind of model from the episodes that are not held out."""
    config: Any = model.config
    episodes = ~table.validation
    if model.name == "frame_tokenizer":
        frames = cached_frames(table.dataset, config.camera_keys)
        return FrameSampler(
            table, frames, episodes.nonzero()[0], config.cameras, batch_size, seed, config.device
        )
    if isinstance(config, TextWorldModelConfig):
        episodes = episodes & golden_episodes(table)
        if not episodes.any():
            raise ValueError(
                "the text world model learns from successful optimal episodes; the dataset has none"
            )
    elif "next.done" not in table.dataset.features:
        logging.warning(
            "the dataset has no next.done: the model cannot learn what success is, and nothing that is "
            "imagined in it will succeed"
        )
    tokenizer: Any = model.tokenizer
    tokens = cached_tokens(table.dataset, config.camera_keys, tokenizer)
    return ClipSampler(
        table, tokens, episodes.nonzero()[0], config.clip_length, batch_size, seed, config.device
    )


def train(
    model: PreTrainedRewardModel,
    sampler: ClipSampler | FrameSampler,
    cfg: Any,
    save_config: Callable[[Path], None],
) -> None:
    """Optimise from the last checkpoint to `cfg.steps`. ValueError (and no new checkpoint) on a NaN loss."""
    set_seed(cfg.seed)
    preset: Any = model.config.get_optimizer_preset()
    optimizer = preset.build([p for p in model.parameters() if p.requires_grad])
    scheduler = cosine_schedule(preset.lr, cfg.steps).build(optimizer, cfg.steps)
    checkpoint = latest_checkpoint(cfg.output_dir)
    step = load_training_state(checkpoint, optimizer, scheduler)[0] if checkpoint else 0
    loss_function: LossFunction = model.loss if isinstance(sampler, ClipSampler) else model

    def save(folder: Path) -> None:
        model.save_pretrained(folder / PRETRAINED_MODEL_DIR)
        save_config(folder / PRETRAINED_MODEL_DIR)
        save_training_state(folder, step, optimizer, scheduler, batch_size=cfg.batch_size)

    model.train()
    began, first = time.monotonic(), step
    progress = tqdm(
        range(step, cfg.steps), initial=step, total=cfg.steps, desc=f"Training {model.name}", unit="step"
    )
    for _ in progress:
        model.training_progress = step / cfg.steps
        loss, metrics = loss_function(sampler(step))
        metrics |= descend(model, loss, optimizer, preset.grad_clip_norm)
        scheduler.step()
        step += 1
        if step % cfg.log_freq == 0 or step == cfg.steps:
            metrics["steps_per_s"] = (step - first) / (time.monotonic() - began)
            append_metrics(cfg.output_dir, step, metrics)
            progress.set_postfix(loss=f"{metrics['loss']:.3f}")
        if should_save_checkpoint(step, cfg.save_freq, cfg.steps):
            write_checkpoint(cfg.output_dir, cfg.steps, step, save)


def descend(
    model: torch.nn.Module, loss: Tensor, optimizer: torch.optim.Optimizer, grad_clip_norm: float
) -> dict[str, float]:
    """One optimiser step. → the loss and the norm of its gradient. ValueError, and no step, on a NaN."""
    if not torch.isfinite(loss):
        raise ValueError(
            f"the loss is {loss.item()}; the last checkpoint is kept: lower --model.learning_rate"
        )
    optimizer.zero_grad()
    loss.backward()
    grad_norm = torch.nn.utils.clip_grad_norm_(model.parameters(), grad_clip_norm)
    optimizer.step()
    return {"loss": loss.item(), "grad_norm": grad_norm.item()}

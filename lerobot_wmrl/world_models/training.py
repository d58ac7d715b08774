"""The training loop of tokenizer and world models: seeded, resumable, logged, on one or more devices.

Under `torchrun` every process draws batches of `batch_size` from a seed of its own, DistributedDataParallel
averages the gradients, and the first process alone writes.
"""

import logging
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol

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
from lerobot_wmrl.common.constants import HUMAN_LIKE, KINDS, START_KIND
from lerobot_wmrl.common.cuda_graphs import cuda_graphs
from lerobot_wmrl.common.distributed import is_first_process, mean_over_processes, process_seed
from lerobot_wmrl.common.errors import FieldError, renamed
from lerobot_wmrl.common.precision import compute_in, training_dtype
from lerobot_wmrl.common.tracking import log_metrics
from lerobot_wmrl.common.training_state import load_training_state, save_checkpoint
from lerobot_wmrl.data.checks import require_shown, solved_from_the_start
from lerobot_wmrl.data.clips import ClipSampler, FrameSampler, InTurn
from lerobot_wmrl.data.dataset import TrainingData
from lerobot_wmrl.data.episodes import EpisodeTable, count_tasks
from lerobot_wmrl.data.frame_cache import (
    FAR,
    cached_context,
    cached_depth,
    cached_features,
    cached_frames,
    cached_tokens,
)
from lerobot_wmrl.world_models.checkpoint import check_dataset, load_model, load_model_to_continue
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig, cosine_schedule
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig, TextWorldModelConfig
from lerobot_wmrl.world_models.text import instruction_problem

FAR_SHARE: Final = 0.05
"""Share of the depth that may be beyond `FAR` without a warning."""

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


def decide_on_instructions(config: RewardModelConfig, table: EpisodeTable, data: TrainingData) -> None:
    """Say in a new tokenizer's configuration whether success depends on the instruction, unless it says so.

    It does where the episodes that are learnt from are of several tasks, and all instructions can be read.

    Raises:
        FieldError: it is asked for, and an instruction cannot be read.
    """
    if not isinstance(config, FrameTokenizerConfig) or not config.tokenizer.success or config.pretrained_path:
        return
    asked = config.tokenizer.instructions
    tables = [table.subset(table.training(data.episodes))]
    tables += [each.subset(each.training(None)) for each in data.read_more()]
    reads = count_tasks(tables) > 1 if asked is None else asked
    problem = reads and instruction_problem(text for each in tables for text in each.instructions)
    if problem and asked:
        raise FieldError(
            "tokenizer.instructions", True, problem,
            "or set it to false: success then depends on pictures alone",
        )  # fmt: skip
    if problem:
        logging.warning("success is told without the instructions, one of which cannot be read: %s", problem)
    config.tokenizer = replace(config.tokenizer, instructions=reads and not problem)


def require_golden(table: EpisodeTable, episodes: np.ndarray) -> np.ndarray:
    """Return the episodes (E,) that a text world model learns from. FieldError if there is none."""
    if episodes.any():
        return episodes
    raise FieldError(
        "dataset.root", table.dataset.root, "has no successful demonstration",
        "the text world model needs some: record them, or add labels (lerobot-wmrl-label)",
    )  # fmt: skip


def golden_episodes(table: EpisodeTable) -> np.ndarray:
    """Mark the episodes that the text world model learns from. (E,)

    They are successful demonstrations, or all successes of a dataset that does not say who acted.
    """
    kind = table.column(START_KIND)
    return table.success & np.isin(kind, (-1, KINDS.index("optimal"), KINDS.index(HUMAN_LIKE)))


def make_sampler(
    model: PreTrainedRewardModel,
    table: EpisodeTable,
    chosen: Sequence[int] | None,
    batch_size: int,
    seed: int,
) -> ClipSampler | FrameSampler:
    """Make the sampler of training batches for this kind of model.

    Args:
        model: a frame tokenizer or a world model.
        table: the dataset.
        chosen: indices of episodes to learn from, all by default; held-out episodes are left out.
        batch_size: frames (tokenizer) or clips (world models) a batch.
        seed: seed of the draws.

    Raises:
        FieldError: there is no episode to learn from.
    """
    episodes = table.training(chosen)
    if not episodes.any():
        raise FieldError(
            "dataset.root", table.dataset.root, "has no episode to train on",
            "record some first, or choose others with `dataset.episodes`: every twentieth is held out",
        )  # fmt: skip
    config: Any = model.config
    if model.name == "frame_tokenizer":
        if config.tokenizer.success and not table.has_labels:
            raise FieldError(
                "tokenizer.success", True,
                f"{table.dataset.root} has neither next.success nor next.done, so its frames cannot be told "
                "apart", "label its episodes, or leave `tokenizer.success` out",
            )  # fmt: skip
        if config.tokenizer.success and table.success[episodes].any():
            require_shown(table, episodes.nonzero()[0])
        tokenizer_config = config.tokenizer
        frames, cameras = (
            cached_frames(table.dataset, tokenizer_config.camera_keys, tokenizer_config.image_size),
            tokenizer_config.cameras,
        )
        return FrameSampler(table, frames, episodes.nonzero()[0], cameras, batch_size, seed, config.device)
    if isinstance(config, TextWorldModelConfig):
        episodes = require_golden(table, episodes & golden_episodes(table))
    elif not table.has_labels:
        logging.warning(
            "dataset.root=%s: has neither next.success nor next.done: the model cannot learn from it what "
            "success is. Check it afterwards (lerobot-wmrl-eval-world-model)",
            table.dataset.root,
        )
    return make_clip_sampler(model, table, episodes.nonzero()[0], batch_size, seed)


def make_clip_sampler(
    model: Any, table: EpisodeTable, episodes: np.ndarray, batch_size: int, seed: int
) -> ClipSampler:
    """Make a sampler of clips from these episodes, with what else the model looks at or predicts."""
    config, tokenizer, dataset = model.config, model.tokenizer, table.dataset
    chosen = table.subset(episodes)
    if config.reads_instructions and (problem := instruction_problem(chosen.instructions)):
        raise FieldError(
            "dataset.root", dataset.root, problem,
            "or train a tokenizer with `tokenizer.instructions`=false, and the world model on it",
        )  # fmt: skip
    if config.predicts_success and not config.reads_instructions and count_tasks([chosen]) > 1:
        logging.warning(
            "%s: has several tasks, and success is told without the instruction: what one task asks for "
            "counts in another too. A tokenizer with --model.tokenizer.instructions=true reads it",
            dataset.root,
        )
    longer, longest = table.length[episodes] > config.clip_length, int(table.length[episodes].max())
    if 2 * longer.sum() > len(episodes) and not config.context_channels:
        logging.warning(
            "%s: %d of %d episodes are longer than the clips that are learnt from, clip_length=%d frames "
            "(%.1f s): success is learnt up to there alone. --model.clip_length=%d holds the longest",
            dataset.root, longer.sum(), len(episodes), config.clip_length, config.clip_length / dataset.fps,
            longest,
        )  # fmt: skip
    cameras = config.tokenizer.camera_keys
    depth = cached_depth(dataset, cameras, tokenizer.grid) if config.depth else None
    if depth is not None and (beyond := float((depth > FAR).mean())) > FAR_SHARE:
        logging.warning(
            "%s: %.0f %% of the depth is beyond %.1f m, and is learnt as if it were there",
            dataset.root, 100 * beyond, FAR,
        )  # fmt: skip
    return ClipSampler(
        table,
        cached_tokens(dataset, cameras, tokenizer),
        episodes,
        config.clip_length,
        config.from_start,
        batch_size,
        seed,
        config.device,
        depth=depth,
        context=cached_context(dataset, cameras, tokenizer) if config.context_channels else None,
        features=cached_features(dataset, cameras, tokenizer) if config.predicts_success else None,
    )


def make_joint_sampler(
    model: PreTrainedRewardModel, table: EpisodeTable, data: TrainingData, batch_size: int, seed: int
) -> ClipSampler | FrameSampler | InTurn:
    """Make the sampler for the episodes of `data`, which are in `table`, and for its further datasets."""
    more = data.read_more()
    with renamed("dataset.root", "dataset.more"):
        for other in more:
            check_dataset(model.config, other.dataset.meta)
            check_instructions(model, other)
    if isinstance(model.config, ActionWorldModelConfig):
        note_outcomes(model.config, [(table, data.episodes), *((each, None) for each in more)])
    first = make_sampler(model, table, data.episodes, batch_size, seed)
    with renamed("dataset.root", "dataset.more"):
        samplers = [make_sampler(model, each, None, batch_size, seed) for each in more]
    return InTurn(first, samplers) if samplers else first


def check_instructions(model: Any, table: EpisodeTable) -> None:
    """Raise FieldError if a text world model cannot read an instruction of a dataset."""
    if not isinstance(model.config, TextWorldModelConfig):
        return
    try:
        model.text_encoder.check(table.dataset.meta.tasks.index)
    except ValueError as error:
        raise FieldError(
            "dataset.root", table.dataset.root, str(error), "leave it out, or record other instructions"
        ) from error


def note_outcomes(
    config: ActionWorldModelConfig, sources: Iterable[tuple[EpisodeTable, Sequence[int] | None]]
) -> None:
    """Write into a world model's configuration how many successes and failures it learns from.

    A model that is trained further keeps what it has learnt from before, if that was more.
    """
    labelled = [(table, chosen) for table, chosen in sources if table.has_labels]
    learnt = [table.success[table.training(chosen)] for table, chosen in labelled]
    if not learnt and config.pretrained_path and config.learnt_successes is None:
        return  # what it has learnt before is not known
    for table, _ in labelled:
        if warning := solved_from_the_start(table):
            logging.warning("%s: %s", table.dataset.root, warning)
    successes, failures = config.learnt_successes or 0, config.learnt_failures or 0
    config.learnt_successes = max(successes, sum(int(each.sum()) for each in learnt))
    config.learnt_failures = max(failures, sum(int((~each).sum()) for each in learnt))
    if not config.learnt_successes:
        logging.warning(
            "no episode is known to succeed: the world model never rewards. RL in it needs labels "
            "(lerobot-wmrl-label) or a reward of another kind"
        )
    elif not config.learnt_failures:
        logging.warning(
            "no episode is known to fail: the world model has not seen how one does, and a policy will learn "
            "what it takes for success. No gate on such episodes can tell; record rollouts with failures"
        )


def train(
    model: PreTrainedRewardModel, sampler: Callable[[int], Any], settings: TrainingSettings,
    save_config: Callable[[Path], None], wandb: Any = None,
) -> None:  # fmt: skip
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
def held_out_metrics(model: Any, table: EpisodeTable, batch_size: int) -> dict[str, float]:
    """Average a world model's losses over clips of episodes that are held out; empty if there are none."""
    episodes = table.validation & (
        golden_episodes(table) if isinstance(model.config, TextWorldModelConfig) else True
    )
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

"""What a training needs beside its weights in order to continue: `training_state` of a checkpoint.

The file is ours, so that LeRobot 0.6.1 and 0.6.2 read and write the same.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import torch
from lerobot.utils.constants import TRAINING_STATE_DIR
from lerobot.utils.random_utils import deserialize_rng_state, serialize_rng_state
from torch import distributed as dist
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from lerobot_wmrl.common.checkpoints import checkpoint_dir, write_checkpoint
from lerobot_wmrl.common.distributed import is_first_process, rank_and_size, wait_for_all
from lerobot_wmrl.common.errors import FieldError

TRAINING_STATE_FILE: Final = "training_state.pt"


def gather_random_states() -> list[dict[str, Any]]:
    """Return the random state of every process, by rank. All processes must call it."""
    rank, size = rank_and_size()
    states: list[dict[str, Any]] = [{} for _ in range(size)]
    states[rank] = serialize_rng_state()
    if size > 1:
        dist.all_gather_object(states, states[rank])
    return states


def save_checkpoint(
    output_dir: Path,
    total: int,
    step: int,
    write_models: Callable[[Path], None],
    optimizer: Optimizer,
    scheduler: LRScheduler | None = None,
) -> Path:
    """Write a whole checkpoint or none, from the first process, and return its folder. All must call it.

    Args:
        output_dir: the training's folder.
        total: steps or iterations of the whole training.
        step: those that are done.
        write_models: writes everything but the training's state into the folder that it is given.
        optimizer: its state is saved.
        scheduler: its state is saved, if there is one.
    """
    random_states = gather_random_states()

    def write(folder: Path) -> None:
        write_models(folder)
        save_training_state(folder, step, random_states, optimizer, scheduler)

    if is_first_process():
        write_checkpoint(output_dir, total, step, write)
    wait_for_all()
    return checkpoint_dir(output_dir, total, step)


def save_training_state(
    checkpoint: Path,
    step: int,
    random_states: list[dict[str, Any]],
    optimizer: Optimizer,
    scheduler: LRScheduler | None = None,
) -> None:
    """Write what a training needs beside its weights in order to continue bit for bit.

    Args:
        checkpoint: the folder to which `training_state` is added.
        step: optimizer steps or iterations done.
        random_states: what `gather_random_states` returned.
        optimizer: its state is saved.
        scheduler: its state is saved, if there is one.
    """
    folder = checkpoint / TRAINING_STATE_DIR
    folder.mkdir(parents=True, exist_ok=True)
    state = {
        "step": step,
        "random_states": random_states,
        "optimizer": optimizer.state_dict(),
        "scheduler": scheduler.state_dict() if scheduler is not None else None,
    }
    torch.save(state, folder / TRAINING_STATE_FILE)


def load_training_state(checkpoint: Path, optimizer: Optimizer, scheduler: LRScheduler | None = None) -> int:
    """Restore optimizer, scheduler and this process's random state.

    Returns:
        The step at which the checkpoint was written.

    Raises:
        FieldError: the run began with another number of processes.
        ValueError: the file is missing or torn.
    """
    path = checkpoint / TRAINING_STATE_DIR / TRAINING_STATE_FILE
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError) as error:
        raise ValueError(
            f"{path}: cannot be read ({error}); remove {checkpoint} to continue from the one before. A run "
            "of an earlier version of this package has no such file and must be trained again"
        ) from error
    (rank, size), began_with = rank_and_size(), len(state["random_states"])
    if began_with != size:
        raise FieldError(
            "output_dir",
            checkpoint.parent.parent,
            f"this run began with {began_with} processes, here are {size}",
            f"continue it with torchrun --nproc_per_node={began_with}",
        )
    optimizer.load_state_dict(state["optimizer"])
    if scheduler is not None:
        scheduler.load_state_dict(state["scheduler"])
    deserialize_rng_state(state["random_states"][rank])
    step: int = state["step"]
    return step

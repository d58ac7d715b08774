"""Trainings that continue."""

from pathlib import Path

import pytest
import torch
from lerobot.utils.random_utils import set_seed

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.training_state import gather_random_states, load_training_state, save_training_state


def learn(
    model: torch.nn.Module, optimizer: torch.optim.Optimizer, scheduler: torch.optim.lr_scheduler.LRScheduler
) -> None:
    optimizer.zero_grad()
    model(torch.randn(4, 3)).square().sum().backward()
    optimizer.step()
    scheduler.step()


def make() -> tuple[torch.nn.Module, torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
    set_seed(0)
    model = torch.nn.Linear(3, 2)
    optimizer = torch.optim.AdamW(model.parameters(), lr=0.1)
    return model, optimizer, torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 0.9**step)


def test_a_training_continues_bit_for_bit(tmp_path: Path) -> None:
    model, optimizer, scheduler = make()
    for _ in range(3):
        learn(model, optimizer, scheduler)
    save_training_state(tmp_path, 3, gather_random_states(), optimizer, scheduler)
    weights = {name: value.clone() for name, value in model.state_dict().items()}
    learn(model, optimizer, scheduler)
    again, optimizer_again, scheduler_again = make()
    again.load_state_dict(weights)
    set_seed(5)
    assert load_training_state(tmp_path, optimizer_again, scheduler_again) == 3
    learn(again, optimizer_again, scheduler_again)
    assert torch.equal(again.weight, model.weight)
    assert scheduler_again.get_last_lr() == scheduler.get_last_lr()


def test_another_number_of_processes_and_a_missing_state_are_named(tmp_path: Path) -> None:
    _, optimizer, _ = make()
    folder = tmp_path / "checkpoints" / "000001"
    with pytest.raises(ValueError, match=r"training_state\.pt: cannot be read .*an earlier version"):
        load_training_state(folder, optimizer)
    save_training_state(folder, 1, 2 * gather_random_states(), optimizer)
    with pytest.raises(FieldError, match=r"began with 2 processes, here are 1; .*--nproc_per_node=2"):
        load_training_state(folder, optimizer)

"""Observations labelled with actions to imitate, on the CPU and on disk. N labels, n steps of a chunk."""

import json
from pathlib import Path
from typing import Any

import torch
from lerobot.utils.constants import ACTION
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from lerobot_wmrl.rl.observations import TASK, decoded
from lerobot_wmrl.rl.policy_adapters import ACTION_IS_PAD


class Labels:
    """Labels of all iterations, one file each, so that a resumed training has them too.

    Args:
        folder: of the files.
        process: number of this process, which has files of its own.
    """

    def __init__(self, folder: Path, process: int) -> None:
        self.folder, self.process = folder, process
        self.parts: list[dict[str, Tensor]] = []
        self.instructions: list[list[str]] = []

    def __len__(self) -> int:
        return sum(len(part[ACTION]) for part in self.parts)

    def path(self, iteration: int) -> Path:
        """Return the file of an iteration."""
        return self.folder / f"{iteration:06d}-{self.process}.safetensors"

    def add(self, iteration: int, part: dict[str, Tensor], instructions: list[str]) -> None:
        """Add an iteration's labels, on disk first.

        Args:
            iteration: that made them.
            part: observations with images as bytes, `task` as an index into the instructions, `action`, and
                for chunks `action_is_pad`; (N, …) each.
            instructions: of the tasks.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        partial = self.path(iteration).with_suffix(".partial")
        part = {name: value.cpu().contiguous() for name, value in part.items()}
        save_file(part, partial, {"instructions": json.dumps(instructions)})
        partial.replace(self.path(iteration))
        self._append(part, instructions)

    def load(self, iterations: int) -> None:
        """Read the labels of the iterations before `iterations`, in place of those in memory.

        Raises:
            FileNotFoundError: a file is missing.
        """
        self.parts, self.instructions = [], []
        for iteration in range(iterations):
            with safe_open(self.path(iteration), framework="pt") as file:
                part = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
                self._append(part, json.loads(file.metadata()["instructions"]))

    def draw(self, count: int) -> dict[str, Any]:
        """Draw a batch of labels at random, as LeRobot's datasets would give them: images in [0, 1]."""
        ends = torch.tensor([len(part[ACTION]) for part in self.parts]).cumsum(0)
        drawn = torch.randint(int(ends[-1]), (count,))
        part_of = torch.searchsorted(ends, drawn, right=True)
        taken: list[dict[str, Any]] = []
        for index in part_of.unique().tolist():
            part, begin = self.parts[index], int(ends[index - 1]) if index else 0
            rows = drawn[part_of == index] - begin
            chosen = {name: value[rows] for name, value in part.items()}
            taken.append(decoded(chosen, self.instructions[index]))
        return {
            name: [text for batch in taken for text in batch[name]] if name == TASK
            else torch.cat([batch[name] for batch in taken])
            for name in taken[0]
        }  # fmt: skip

    def _append(self, part: dict[str, Tensor], instructions: list[str]) -> None:
        if len(part[ACTION]):
            self.parts.append(part)
            self.instructions.append(instructions)


def action_chunks(actions: Tensor, labelled: Tensor, length: int) -> dict[str, Tensor]:
    """Return the labels of every labelled step: its action, or the chunk that begins with it.

    A chunk ends with its labelled run; beyond, the last action is repeated and marked as padding.

    Args:
        actions: (T, B, A).
        labelled: (T, B) bool; a run of steps in each environment.
        length: actions of a chunk, n; 0 for policies without chunks.

    Returns:
        `action` (N, A) in the order of `labelled.nonzero()`, or (N, n, A) with `action_is_pad` (N, n).
    """
    step, env = labelled.nonzero(as_tuple=True)
    if not length:
        return {ACTION: actions[step, env]}
    last = len(labelled) - 1 - labelled.flip(0).long().argmax(0)  # (B,), of the environments with labels
    wanted = step[:, None] + torch.arange(length, device=step.device)  # (N, n)
    end = last[env][:, None]
    return {ACTION: actions[wanted.minimum(end), env[:, None]], ACTION_IS_PAD: wanted > end}

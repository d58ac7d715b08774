"""Imagination with a trained world model, in the dataset's units: start, step, open-loop prediction."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_wmrl.common.precision import compute_in, imagination_dtype
from lerobot_wmrl.data.frame_cache import FAR, cached_depth
from lerobot_wmrl.data.frames import NO_CONTEXT, Context, Frames
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.dynamics import (
    Dynamics,
    Imagination,
    Imagined,
    OpenLoopPrediction,
    repeated_rows,
)
from lerobot_wmrl.world_models.frame_tokenizer import Decoded, FrameTokenizer


class ImaginationMixin:
    """Imagination for models with a tokenizer, dynamics and statistics of the states."""

    name: str
    config: Any
    tokenizer: FrameTokenizer
    dynamics: Dynamics
    state_mean: Tensor
    state_std: Tensor

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return self.state_mean.device

    def recorded_depth(self, dataset: LeRobotDataset, rows: Any) -> Tensor | None:
        """Return the depth (…, S) in metres of rows of a dataset, at most `FAR`; None for a model without."""
        if not self.config.depth:
            return None
        depth = cached_depth(dataset, self.config.tokenizer.camera_keys, self.tokenizer.grid)[rows]
        return torch.from_numpy(np.array(depth)).clamp_max(FAR).to(self.device)

    @torch.no_grad()
    def start(
        self, frames: Frames, instructions: Sequence[str] | None = None, dtype: torch.dtype | None = None
    ) -> Imagination:
        """Begin to imagine at B frames.

        Args:
            frames: where the imaginations begin. ValueError if depth that the model looks at is missing, or
                the instruction that it reads; a missing context raises it in the first step.
            instructions: one an imagination, of a model that is conditioned on text.
            dtype: what the network computes in, by default the fastest format; what is returned is float32.
        """
        if instructions is None:
            self._require_instruction_weights(frames)
        imagination = self.dynamics.start(self._normalized(frames), dtype)
        if instructions is not None:
            imagination.condition = self.encode_instructions(instructions, len(frames))
        return imagination

    @torch.no_grad()
    def restart(self, imagination: Imagination, mask: Tensor, frames: Frames) -> None:
        """Begin anew at frames (as in `start`, of all B) in the environments in `mask` (B,)."""
        if imagination.condition is not None:
            raise ValueError(
                "restart: its instructions are those of the start; start a new imagination instead"
            )
        self._require_instruction_weights(frames)
        self.dynamics.restart(imagination, mask, self._normalized(frames))

    @torch.no_grad()
    def step(self, imagination: Imagination, action: Tensor | None = None) -> Imagined:
        """Imagine the next frame of every environment: action (B, A) in the dataset's units."""
        condition = imagination.condition
        if action is not None:
            condition = self.encode_actions(action[:, None], imagination.instruction_weights)
        if condition is None:
            raise ValueError("this imagination needs an action each step, or an instruction at the start")
        imagined = self.dynamics.step(imagination, condition)
        return imagined._replace(state=self.denormalize_state(imagined.state))

    def newest(self, imagination: Imagination) -> Frames:
        """Return the newest frames, from which another imagination can begin."""
        frames = self.dynamics.newest(imagination)
        return replace(frames, state=self.denormalize_state(frames.state))

    @torch.no_grad()
    def imagine(self, frames: Frames, actions: Tensor) -> list[Imagined]:
        """Imagine the frame after each of the actions (B, T, A)."""
        imagination = self.start(frames)
        return [self.step(imagination, action) for action in actions.unbind(1)]

    @torch.no_grad()
    def policy_actions(
        self,
        frames: Frames,
        act: Callable[[Tensor, Tensor], Tensor],
        steps: int,
        images: Tensor | None = None,
    ) -> Tensor:
        """Return what a policy would do from these frames on, shown the frames that its actions lead to.

        Args:
            frames: B of them.
            act: images (B, N, 3, H, W) of N cameras, states (B, P) → actions (B, A), in the dataset's units.
            steps: T.
            images: images of the B frames; by default they are decoded.

        Returns:
            (B, T, A)
        """
        imagination, tokens, state, actions = self.start(frames), frames.tokens, frames.state, []
        for step in range(steps):
            if step or images is None:
                images = self.decode(tokens, frames.context).images
            actions.append(act(images, state))
            imagined = self.step(imagination, actions[-1])
            tokens, state = imagined.tokens, imagined.state
        return torch.stack(actions, 1)

    @torch.no_grad()
    def open_loop(self, frames: Frames, actions: Tensor, with_tokens: bool = True) -> OpenLoopPrediction:
        """Predict what follows actions (B·J, T, A): J sequences for each of B frames, frame by frame.

        Anchored dynamics encode each frame once for its J sequences and render no frame but the last, and
        without `with_tokens` none, so it is much faster than `imagine`.
        """
        self._require_instruction_weights(frames)
        weights = frames.instruction_weights
        if weights is not None:
            weights = weights[repeated_rows(len(frames), len(actions), actions.device)]
        encode = partial(self.encode_actions, instruction_weights=weights)
        prediction = self.dynamics.open_loop(self._normalized(frames), actions, encode, with_tokens)
        return prediction._replace(state=self.denormalize_state(prediction.state))

    @torch.no_grad()
    def decode(self, tokens: Tensor, context: Context = NO_CONTEXT) -> Decoded:
        """Tokens (B, S) → images and features in float32, computed in imagination's number format."""
        with compute_in(imagination_dtype(tokens.device), tokens.device):
            images, features = self.tokenizer.decode_with_features(tokens, context)
        return Decoded(images.float(), [feature.float() for feature in features])

    def encode_actions(self, actions: Tensor, instruction_weights: Tensor | None = None) -> Condition:
        """Actions (B, T, A) in dataset units, and the weights of the instructions (B, E) → condition."""
        raise NotImplementedError(f"{self.name} is not conditioned on actions")

    def encode_instructions(self, instructions: Sequence[str], batch: int) -> Condition:
        """One instruction for each of `batch` episodes → condition."""
        raise NotImplementedError(f"{self.name} is not conditioned on text")

    def instruction_weights(self, instructions: Sequence[str], batch: int) -> Tensor | None:
        """Return what each instruction of `batch` episodes adds to the weights by which success is read.

        Returns:
            (B, E), or None if success is read from pictures alone.

        Raises:
            ValueError: there is not one for each, or one is empty or too long.
        """
        raise NotImplementedError

    def _require_instruction_weights(self, frames: Frames) -> None:
        """Raise ValueError if success depends on the instruction, and the frames lack its weights."""
        if self.config.reads_instructions and frames.instruction_weights is None:
            raise ValueError(
                "task: this world model tells success by the instruction, and the frames have none; give one "
                "for each episode"
            )

    def normalize_state(self, state: Tensor) -> Tensor:
        """Scale states from dataset units to zero mean and unit variance. (…, P) → (…, P)"""
        raise NotImplementedError

    def denormalize_state(self, state: Tensor) -> Tensor:
        """Scale normalised states back to dataset units. (…, P) → (…, P)"""
        return state * self.state_std + self.state_mean

    def _normalized(self, frames: Frames) -> Frames:
        return replace(frames, state=self.normalize_state(frames.state))

"""Interface of the dynamics (eq. 1), which both kinds implement, and the state of imaginations."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lerobot_wmrl.common.precision import imagination_dtype
from lerobot_wmrl.data.clips import Clip
from lerobot_wmrl.data.frames import NO_CONTEXT, Context, Frames
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.kv_cache import KVCache
from lerobot_wmrl.world_models.layers import FrameNetwork, Prediction


class Imagined(NamedTuple):
    """One imagined frame of every environment.

    tokens (B, S); done_logit (B,); state (B, P), which the dynamics return normalised and the model
    in the dataset's units; hidden (B, D); entropy (B,), the mean over code factors of the predictive entropy
    in nats; depth (B, S), metres of each token, None unless the dynamics predict it.
    """

    tokens: Tensor
    done_logit: Tensor
    state: Tensor
    hidden: Tensor
    entropy: Tensor
    depth: Tensor | None = None


class OpenLoopPrediction(NamedTuple):
    """Outcome of T actions in each of B imaginations.

    done_logit (B, T) and state (B, T, P) after each action, units as in `Imagined`; tokens (B, S) of the last
    frame, None if they were not asked for.
    """

    done_logit: Tensor
    state: Tensor
    tokens: Tensor | None


@dataclass
class Imagination:
    """State of B imaginations: their newest frames, and the keys and values of the frames before.

    codes (B, 1, S, C) and state (B, 1, P), normalised, are of the newest frames; the context is that
    of the frames where the imaginations began; instruction_weights (B, E) are those of their instructions,
    for models that read them; the condition is set if it is the same at every step.
    A step advances its tensors in place; that of autoregressive dynamics can be captured in a CUDA graph.
    """

    codes: Tensor
    state: Tensor
    cache: KVCache
    context: Context = NO_CONTEXT
    instruction_weights: Tensor | None = None
    condition: Condition | None = None

    @property
    def dtype(self) -> torch.dtype:
        """Number format in which the network computes."""
        return self.cache.dtype

    def restart(self, mask: Tensor) -> None:
        """Begin anew in the environments in `mask` (B,): their past is masked, not moved."""
        self.cache.restart(mask)


def repeated_rows(frames: int, sequences: int, device: torch.device) -> Tensor:
    """Return the frame of each action sequence, 0, …, 0, 1, …, for as many a frame. → (sequences,)"""
    return torch.arange(frames, device=device).repeat_interleave(sequences // frames)


class Dynamics(nn.Module):
    """A network that predicts frames, its loss, and imagination with it.

    States are normalised throughout; the model that owns the dynamics knows the dataset's units.
    """

    network: FrameNetwork

    def loss(self, clip: Clip, condition: Condition, progress: float) -> tuple[Tensor, dict[str, float]]:
        """Compute the loss of eqs. 2-4.

        Args:
            clip: recorded frames, with normalised states.
            condition: that of every row of the clip.
            progress: share of the training that is over.

        Returns:
            The loss (), and its parts by name.
        """
        raise NotImplementedError

    def predict(self, clip: Clip, condition: Condition, with_tokens: bool) -> Prediction:
        """Predict the frame after every row of a clip.

        Without `with_tokens`, logits may be empty, (B, 0, S, V).
        """
        raise NotImplementedError

    def start(self, frames: Frames, dtype: torch.dtype | None = None) -> Imagination:
        """Begin B imaginations. The network computes in `dtype`, by default the fastest format."""
        raise NotImplementedError

    def show(self, imagination: Imagination, mask: Tensor, frames: Frames) -> None:
        """Replace the newest frames of the environments in `mask` (B,); their past is kept."""
        codes = self.network.codebook.codes(frames.tokens)[:, None]
        state = frames.state[:, None]
        imagination.codes.copy_(torch.where(mask[:, None, None, None], codes, imagination.codes))
        imagination.state.copy_(torch.where(mask[:, None, None], state, imagination.state))

    def newest(self, imagination: Imagination) -> Frames:
        """Return the newest frames."""
        tokens = self.network.codebook.tokens(imagination.codes[:, 0])
        state = imagination.state[:, 0].clone()
        return Frames(tokens, state, imagination.context, instruction_weights=imagination.instruction_weights)

    def restart(self, imagination: Imagination, mask: Tensor, frames: Frames) -> None:
        """Begin anew in the environments in `mask` (B,); frames are of all B."""
        self.show(imagination, mask, frames)
        imagination.context = imagination.context.replaced(mask, frames.context)
        if imagination.instruction_weights is not None:
            assert frames.instruction_weights is not None, "as where the imaginations began"
            imagination.instruction_weights = torch.where(
                mask[:, None], frames.instruction_weights, imagination.instruction_weights
            )
        imagination.restart(mask)

    def step(self, imagination: Imagination, condition: Condition) -> Imagined:
        """Imagine the next frame of every environment, with the most likely codes. condition (B, 1, M, D)."""
        raise NotImplementedError

    def open_loop(
        self, frames: Frames, actions: Tensor, encode: Callable[[Tensor], Condition], with_tokens: bool
    ) -> OpenLoopPrediction:
        """Predict what follows action sequences.

        Args:
            frames: B of them.
            actions: (B·J, T, A), J sequences for each frame, one frame's after another's.
            encode: turns actions into conditions.
            with_tokens: whether the tokens of the last frame are needed.
        """
        used = replace(frames, context=Context(frames.context.maps[:1]))  # the others are the tokenizer's
        imagination = self.start(used[repeated_rows(len(frames), len(actions), actions.device)])
        steps = [self.step(imagination, encode(action[:, None])) for action in actions.unbind(1)]
        return OpenLoopPrediction(
            torch.stack([step.done_logit for step in steps], 1),
            torch.stack([step.state for step in steps], 1),
            steps[-1].tokens if with_tokens else None,
        )

    def _first(self, frames: Frames, dtype: torch.dtype | None) -> tuple[Tensor, Tensor, torch.dtype]:
        """Return codes (B, 1, S, C) and states (B, 1, P) of the frames, and the number format."""
        dtype = dtype or imagination_dtype(frames.tokens.device, len(frames))
        # a copy: imagination advances its tensors in place
        return (
            self.network.codebook.codes(frames.tokens)[:, None],
            frames.state[:, None].clone(),
            dtype,
        )

    def _advance(self, imagination: Imagination, prediction: Prediction, codes: Tensor) -> Imagined:
        """Make the predicted frame, of codes (B, 1, S, C), the newest one."""
        imagination.codes.copy_(codes)
        imagination.state.copy_(prediction.state)
        return Imagined(
            self.network.codebook.tokens(imagination.codes[:, 0]),
            prediction.done_logit[:, 0],
            prediction.state[:, 0],
            prediction.hidden[:, 0],
            self.network.codebook.entropy(prediction.logits[:, 0]),
        )

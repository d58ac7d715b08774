"""Unrolling a world model frame by frame: `start`, `restart` and `step` advance a preallocated state."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lerobot_wmrl.common.precision import compute_in, imagination_dtype
from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.world_models.decoding import Condition, FramesSeen, ShiftedDecoding
from lerobot_wmrl.world_models.frame_network import FrameNetwork, Prediction
from lerobot_wmrl.world_models.frame_tokenizer import Decoded, FrameTokenizer
from lerobot_wmrl.world_models.temporal_memory import FrameCache


class Imagined(NamedTuple):
    """One imagined frame of every environment.

    tokens (B, S); done_logit (B,); proprioception (B, P) in the dataset's units; hidden (B, D);
    entropy (B,), the mean over code factors of the predictive entropy in nats; depth (B, S), metres of each
    token, (B, 0) if the model does not predict it.
    """

    tokens: Tensor
    done_logit: Tensor
    proprioception: Tensor
    hidden: Tensor
    entropy: Tensor
    depth: Tensor


@dataclass
class ImaginationState:
    """Where B imaginations stand: digits (B, 1, S, C), normalised state (B, 1, P), depth (B, 1, S) as the
    network has it or (B, 1, 0), what is remembered of the past, the tokenizer's context of where they began.

    Its tensors are allocated once and advanced in place. The network computes in the cache's dtype.
    """

    digits: Tensor
    proprioception: Tensor
    depth: Tensor
    cache: FrameCache
    condition: Condition | None = None
    context: Context = NO_CONTEXT


class Imagination:
    """What a world model does with its parts once they are trained."""

    name: str
    config: Any
    tokenizer: FrameTokenizer
    network: FrameNetwork
    decoding: ShiftedDecoding
    state_mean: Tensor
    state_std: Tensor

    def normalize_state(self, state: Tensor) -> Tensor:
        """Dataset units to the network's. (…, P) → (…, P)"""
        raise NotImplementedError

    def start(
        self,
        tokens: Tensor,
        proprioception: Tensor,
        instructions: Sequence[str] | None = None,
        dtype: torch.dtype | None = None,
        depth: Tensor | None = None,
        context: Context = NO_CONTEXT,
    ) -> ImaginationState:
        """Imagination from one frame: tokens (B, S), proprioception (B, P) in dataset units, and if the model
        looks at it the depth (B, S), metres of each token; ValueError without.

        The context is that of B first frames, where the tokenizer has the option; dynamics that look at it
        raise ValueError in the first step without.

        The network computes in `dtype`, by default the fastest; samples, done, state and entropy are float32.
        """
        batch, device = tokens.shape[0], tokens.device
        dtype = dtype or imagination_dtype(device, batch)
        cache = self.network.make_cache(batch, device, dtype)
        condition = self.encode_instructions(instructions, batch) if instructions is not None else None
        digits = self.network.codebook.codes(tokens)[:, None]
        first, depth = self.normalize_state(proprioception), self.network.depth.normalize(depth, tokens)
        return ImaginationState(digits, first[:, None], depth[:, None], cache, condition, context)

    def restart(
        self, state: ImaginationState, mask: Tensor, tokens: Tensor, proprioception: Tensor,
        depth: Tensor | None = None, context: Context = NO_CONTEXT,
    ) -> None:  # fmt: skip
        """Put the environments in `mask` (B,) back to a first frame; their past is masked, not moved."""
        self.see(state, mask, tokens, proprioception, depth)
        state.context = state.context.replaced(mask, context)
        state.cache.restart(mask)

    def see(
        self, state: ImaginationState, mask: Tensor, tokens: Tensor, proprioception: Tensor,
        depth: Tensor | None = None,
    ) -> None:  # fmt: skip
        """Let the environments in `mask` (B,) go on from frames (as in `start`) instead of imagined ones."""
        digits = self.network.codebook.codes(tokens)[:, None]
        first = self.normalize_state(proprioception)[:, None]
        state.digits.copy_(torch.where(mask[:, None, None, None], digits, state.digits))
        state.proprioception.copy_(torch.where(mask[:, None, None], first, state.proprioception))
        depth = self.network.depth.normalize(depth, tokens)[:, None]
        state.depth.copy_(torch.where(mask[:, None, None], depth, state.depth))

    @torch.no_grad()
    def step(
        self, state: ImaginationState, action: Tensor | None = None, generator: torch.Generator | None = None
    ) -> Imagined:
        """Imagine the next frame of every environment: action (B, A) in the dataset's units."""
        condition = state.condition if action is None else self.encode_actions(action[:, None])
        if condition is None:
            raise ValueError("this imagination needs an action each step, or an instruction at the start")
        codebook = self.network.codebook
        prediction = self._advance(state, condition, self.config.temperature, generator)
        return Imagined(
            codebook.tokens(state.digits[:, 0]),
            prediction.done_logit[:, 0],
            prediction.proprioception[:, 0] * self.state_std + self.state_mean,
            prediction.hidden[:, 0],
            codebook.entropy(prediction.logits[:, 0]),
            self.network.depth.metres(prediction.depth[:, 0]),
        )

    @torch.no_grad()
    def roll_out(
        self,
        tokens: Tensor,
        proprioception: Tensor,
        condition: Condition,
        steps: int,
        dtype: torch.dtype | None = None,
        depth: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Frames 0 … `steps` of imaginations with the most likely codes, as the network sees them.

        tokens (B, S), proprioception (B, P) and depth of frame 0 and `dtype` as in `start`; condition tokens
        float32, (B, `steps` or more, M, D) or (B, 1, M, D). → digits (B, 1 + steps, S, C), normalised state
        (B, 1 + steps, P), normalised depth (B, 1 + steps, S or 0). Draws no global random number.
        """
        state = self.start(tokens, proprioception, dtype=dtype, depth=depth)
        unused = torch.Generator(tokens.device)
        given, mask = condition
        digits, states, depths = [state.digits.clone()], [state.proprioception.clone()], [state.depth.clone()]
        for step in range(steps):
            now = given[:, step : step + 1] if given.shape[1] > 1 else given
            self._advance(state, (now, mask), 0.0, unused)
            digits.append(state.digits.clone())
            states.append(state.proprioception.clone())
            depths.append(state.depth.clone())
        return torch.cat(digits, 1), torch.cat(states, 1), torch.cat(depths, 1)

    def _advance(
        self,
        state: ImaginationState,
        condition: Condition,
        temperature: float,
        generator: torch.Generator | None,
    ) -> Prediction:
        """Put `state` one frame further. → what was predicted"""
        with compute_in(state.cache.dtype, state.digits.device):
            prediction = self.network.step(
                state.digits, state.proprioception, *condition, state.cache, state.depth, state.context
            )
            seen = FramesSeen(state.digits, condition, prediction, state.cache)
            digits = self.decoding.decode(self.network, seen, temperature, generator)
        state.digits.copy_(digits)
        state.proprioception.copy_(prediction.proprioception)
        state.depth.copy_(prediction.depth)
        return prediction

    @torch.no_grad()
    def decode(self, tokens: Tensor, context: Context = NO_CONTEXT) -> Decoded:
        """Tokens (B, S) → images and features of the frames, computed as fast as imagination, as float32."""
        with compute_in(imagination_dtype(tokens.device), tokens.device):
            images, features = self.tokenizer.decode_with_features(tokens, context)
        return Decoded(images.float(), [feature.float() for feature in features])

    def encode_actions(self, actions: Tensor) -> Condition:
        """Actions (B, T, A) in dataset units → condition tokens."""
        raise NotImplementedError(f"{self.name} is not conditioned on actions")

    def encode_instructions(self, instructions: Sequence[str], batch: int) -> Condition:
        """One instruction for each of `batch` episodes → condition tokens."""
        raise NotImplementedError(f"{self.name} is not conditioned on text")

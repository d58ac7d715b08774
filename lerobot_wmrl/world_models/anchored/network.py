"""The anchored network: a clip's first frame and the actions since give its frame t + 1 (eq. 1).

Four parts. The scene encoder encodes the first frame, once. The state rollout follows the robot's state,
action by action. The trajectory, one token a frame, attends to its own past and to the scene; done is read
from it. The renderer predicts the tokens of any frame, from the scene and the trajectory's token.

Within `clip_length` frames no imagined frame is an input: errors in pictures do not add up, and a training
step need not render every frame that it learns from. A longer imagination takes its last frame as a new first
frame (`AnchoredImagination`), which training never shows.
"""

from collections.abc import Iterable
from typing import Final, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_wmrl.common.cuda_graphs import GraphedInTraining
from lerobot_wmrl.common.precision import compute_in
from lerobot_wmrl.data.clips import take_steps
from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.configuration_world_model import AnchoredConfig
from lerobot_wmrl.world_models.layers import (
    STATE_STEP,
    ClipMemory,
    CrossAttention,
    FrameNetwork,
    FrameSizes,
    Prediction,
    SelfAttention,
    TemporalMemory,
    attention,
    make_mlp,
)

SUMMARY_CHANNELS: Final = 16
"""Channels that each token of the scene contributes to its summary."""


class EncodedScene(NamedTuple):
    """First frames of B clips, encoded once.

    codes (B, 1, S, C); tokens (B, 1, M, D), M = 1 + S' of the transformer; keys_values (B, 1, L, 2, h, M, d)
    for each of the trajectory's L layers; summary (B, 1, D); local features (B, N, code_width, g, g).
    """

    codes: Tensor
    tokens: Tensor
    keys_values: Tensor
    summary: Tensor
    local: Tensor


class StateRollout(NamedTuple):
    """The robot's states after each of T actions.

    state (B, T, P), normalised; change (B, T, P) of the last step in `STATE_STEP`s; hidden (B, T, D).
    """

    state: Tensor
    change: Tensor
    hidden: Tensor

    def last(self) -> "StateRollout":
        """Return the last step, T = 1, from which the rollout goes on."""
        return StateRollout(*(tensor[:, -1:] for tensor in self))


def repeat_rows(tensor: Tensor, rows: int) -> Tensor:
    """Repeat what B first frames gave for each of their J clips: (B, …) → (`rows` = B·J, …)."""
    return tensor if len(tensor) == rows else tensor.repeat_interleave(rows // len(tensor), 0)


class ContextEmbedding(nn.Module):
    """The tokenizer's features of an episode's first frame, as transformer tokens.

    They are continuous, and locate objects twice as precisely as the first frame's codes.
    """

    def __init__(self, channels: int, patch: int, width: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(1, channels)
        self.patches = nn.Conv2d(channels, width, patch, stride=patch)

    def forward(self, features: Tensor) -> Tensor:
        """Coarsest features (B, N, C, g, g) of N cameras → tokens (B, N·(g/patch)², D)."""
        tokens = self.patches(self.norm(features.flatten(0, 1))).flatten(2).transpose(1, 2)
        return tokens.unflatten(0, features.shape[:2]).flatten(1, 2)


class SceneSummary(nn.Module):
    """A scene's M tokens as one vector. Each token has weights of its own, so that positions are kept."""

    def __init__(self, tokens: int, width: int) -> None:
        super().__init__()
        self.channels = nn.Linear(width, SUMMARY_CHANNELS)
        self.mix = nn.Linear(tokens * SUMMARY_CHANNELS, width)
        self.out = nn.Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, T, M, D) → (B, T, D)"""
        flat = F.silu(self.channels(tokens)).flatten(2)
        return self.out(F.silu(self.mix(flat)))


class StateRolloutNetwork(nn.Module):
    """A recurrent network that predicts changes of the robot's state and sums them up. Computes in float32.

    Contact deflects the robot, and changes that are predicted from actions alone never make up for it. So
    each step is given the state that the rollout itself has reached, and the scene's summary. Training
    unrolls all steps, as imagination does.
    """

    def __init__(self, state_size: int, width: int) -> None:
        super().__init__()
        self.start = nn.Linear(state_size, width)
        self.condition_in = nn.Linear(2 * width, width)
        self.state_in = nn.Linear(2 * state_size, width)
        self.mix = nn.Linear(width, width)
        self.cell = nn.GRUCell(width, width)
        self.condition_change = nn.Linear(width, state_size)
        self.momentum = nn.Linear(state_size, state_size, bias=False)
        nn.init.zeros_(self.momentum.weight)
        self.hidden_change = nn.Linear(width, state_size)

    def begin(self, state: Tensor) -> StateRollout:
        """Begin in a clip's first state (B, 1, P)."""
        with compute_in(torch.float32, state.device):
            return StateRollout(state, torch.zeros_like(state), self.start(state).tanh())

    def forward(self, begin: StateRollout, summary: Tensor, mean: Tensor) -> StateRollout:
        """Go T steps further under the conditions' means (B, T, D), in a scene of this summary (B, 1, D)."""
        with compute_in(torch.float32, mean.device):
            mean = mean.float()
            joined = self.condition_in(torch.cat([mean, summary.float().expand_as(mean)], -1))
            steps, now = [], StateRollout(*(tensor[:, 0] for tensor in begin))
            for known, change in zip(joined.unbind(1), self.condition_change(mean).unbind(1), strict=True):
                now = self._step(now, known, change)
                steps.append(now)
            return StateRollout(*(torch.stack(tensors, 1) for tensors in zip(*steps, strict=True)))

    def _step(self, now: StateRollout, condition: Tensor, given_change: Tensor) -> StateRollout:
        """Go one action further; no tensor has a time dimension."""
        inputs = F.silu(condition + self.state_in(torch.cat([now.state, now.change], -1)))
        hidden = self.cell(F.silu(self.mix(inputs)), now.hidden)
        change = given_change + self.momentum(now.change) + self.hidden_change(hidden)
        return StateRollout(now.state + STATE_STEP * change, change, hidden)


class SpatialBlock(nn.Module):
    """Attention within a frame, then an MLP; between them a projected vector of the frame, if any."""

    def __init__(self, width: int, heads: int, project: nn.Linear | None = None) -> None:
        super().__init__()
        self.space = SelfAttention(width, heads)
        self.project = project
        self.mlp = make_mlp(width)

    def forward(self, x: Tensor, frame: Tensor | None = None) -> Tensor:
        """x (B, T, M, D), vectors of the frames (B, T, D) → like x."""
        x = x + self.space.merge_heads(attention(*self.space.split_heads(self.space.norm(x))))
        if self.project is not None:
            x = x + self.project(frame)[:, :, None]
        return x + self.mlp(x)


class Dropout(nn.Module):
    """Dropout (Srivastava et al. 2014) with float32 noise, so that every number format drops the same."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share

    def forward(self, x: Tensor) -> Tensor:
        """Drop a share of the elements, in training. (B, …) → same shape."""
        if not self.training or not self.share:
            return x
        kept = torch.rand(x.shape, device=x.device) >= self.share
        return x * kept / (1 - self.share)


class TrajectoryBlock(nn.Module):
    """Attention along time, cross-attention to the scene, MLP, for one token a frame."""

    def __init__(self, width: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.dropout = Dropout(dropout)
        self.time = SelfAttention(width, heads)
        self.scene = CrossAttention(width, heads)
        self.mlp = make_mlp(width)

    def forward(self, x: Tensor, keys_values: Tensor, layer: int, memory: TemporalMemory) -> Tensor:
        """x (B·J, 1, T, D) → same; keys_values (B, 1, 2, h, M, d), this block's projections of the scenes."""
        heads = self.time.split_heads(self.time.norm(x))
        x = x + self.dropout(self.time.merge_heads(memory.attend(layer, *heads)))
        by_scene = x.reshape(len(keys_values), 1, -1, x.shape[-1])  # (B, 1, J·T, D)
        x = x + self.dropout(self.scene.cross_attend(by_scene, keys_values).reshape(x.shape))
        return x + self.dropout(self.mlp(x))


class AnchoredNetwork(FrameNetwork):
    """Scene encoder, state rollout, trajectory and renderer.

    Trajectory and renderer have `config.layers` layers, the scene encoder half as many.
    """

    def __init__(self, config: AnchoredConfig, sizes: FrameSizes) -> None:
        super().__init__(sizes, patch=config.patch, width=config.width, code_width=config.code_width)
        width, heads = config.width, config.heads
        self.window, self.heads, self.head_width = sizes.clip_length, heads, width // heads
        self.state_rollout = StateRolloutNetwork(sizes.state_size, width)
        self._unroll = GraphedInTraining(self.state_rollout)
        channels = sizes.context_channels
        self.context = ContextEmbedding(channels, config.patch, width) if channels else None
        self.scene = nn.ModuleList(SpatialBlock(width, heads) for _ in range(max(1, config.layers // 2)))
        self.trajectory = nn.ModuleList(
            TrajectoryBlock(width, heads, config.dropout) for _ in range(config.layers)
        )
        self.motion = nn.Linear(width, width)
        self.renderer = nn.ModuleList(
            SpatialBlock(width, heads, nn.Linear(width, width)) for _ in range(config.layers)
        )
        self.summary = SceneSummary(self.tokens_per_frame, width)
        self.scene_norm, self.norm, self.drawn_norm = (nn.LayerNorm(width) for _ in range(3))

    def forward(
        self,
        codes: Tensor,
        state: Tensor,
        condition: Condition,
        length: int,
        steps: Tensor | None = None,
        context: Context = NO_CONTEXT,
    ) -> Prediction:
        """Predict the frames after each of T = `length` steps at once, from the first frame.

        There may be J conditions for each first frame, one frame's after another's: the prediction is then of
        B·J clips, and each frame is encoded once.

        Args:
            codes: codes of the first frame, (B, 1, S, C).
            state: state of the first frame, (B, 1, P), normalised.
            condition: condition of every step, tokens (B·J, T or 1, M, D).
            length: steps, T.
            steps: (B·J, K), those whose next frame is rendered; by default all.
            context: context of the first frame.
        """
        memory = ClipMemory(length, self.window, self.head_width, codes.device)
        mean = condition.mean().expand(-1, length, -1)  # (B·J, T, D)
        scene, begin = self.encode(codes, state, context)
        begin = StateRollout(*(repeat_rows(tensor, len(mean)) for tensor in begin))
        return self.follow(scene, begin, mean, memory, steps, condition.instruction_weights)[0]

    def encode(self, codes: Tensor, state: Tensor, context: Context) -> tuple[EncodedScene, StateRollout]:
        """Encode first frames: codes (B, 1, S, C), states (B, 1, P) and their episodes' context.

        ValueError if the network needs a context and has none.
        """
        x, local = self.embed(codes, state, 0.0)  # (B, 1, M, D)
        if self.context is not None:
            if len(context) != len(codes):
                raise ValueError(
                    f"the context of {len(context)} first frames for {len(codes)} imaginations: this world "
                    "model needs one each; give what its tokenizer's `context` returns"
                )
            x = torch.cat([x[:, :, :1], x[:, :, 1:] + self.context(context.features)[:, None]], 2)
        for block in self.scene:
            x = block(x)
        tokens = self.scene_norm(x)
        blocks = cast(Iterable[TrajectoryBlock], self.trajectory)
        keys_values = torch.stack([block.scene.project_kv(tokens) for block in blocks], 2)
        local = local.unflatten(0, (len(codes), -1))  # (B, N, code_width, g, g)
        scene = EncodedScene(codes, tokens, keys_values, self.summary(tokens), local)
        return scene, self.state_rollout.begin(state)

    def follow(
        self,
        scene: EncodedScene,
        begin: StateRollout,
        mean: Tensor,
        memory: TemporalMemory,
        steps: Tensor | None,
        instruction_weights: Tensor | None,
    ) -> tuple[Prediction, StateRollout]:
        """Predict T frames of a scene under the conditions' means (B, T, D), from a state rollout (T = 1) on.

        Success is read by the weights of the instruction (B, 1, E), if there are any.

        Returns:
            The prediction, with logits of the frames after `steps` (B, K) alone, and the state rollout.
        """
        rollout: StateRollout = self._unroll(begin, repeat_rows(scene.summary, len(mean)), mean)
        x = self.register + mean + self.motion(rollout.hidden) + self.state_in(rollout.state)  # (B, T, D)
        x = x[:, None]  # (B, 1, T, D): space before time
        for layer, block in enumerate(self.trajectory):
            x = block(x, scene.keys_values[:, :, layer], layer, memory)
        hidden = self.norm(x)[:, 0]  # (B, T, D)
        logits = self._render(scene, hidden if steps is None else take_steps(hidden, steps))
        with compute_in(torch.float32, x.device):
            hidden = hidden.float()
            read = () if instruction_weights is None else (instruction_weights,)
            return Prediction(logits, self.done(hidden, *read).squeeze(-1), rollout.state, hidden), rollout

    def _render(self, scene: EncodedScene, hidden: Tensor) -> Tensor:
        """Predict the codes of frames from the trajectory's tokens (B, K, D). → logits (B, K, S, V)"""
        count = hidden.shape[1]
        if not count:  # convolutions refuse an empty batch
            sizes = scene.codes.shape[2], len(self.codebook.factor_of_logit)
            return hidden.new_zeros(len(hidden), 0, *sizes)
        scene = EncodedScene(*(repeat_rows(tensor, len(hidden)) for tensor in scene))
        x = scene.tokens.expand(-1, count, -1, -1)
        for block in self.renderer:
            x = block(x, hidden)
        local = scene.local[:, None].expand(-1, count, *(-1,) * 4).flatten(0, 2)
        return self.token_logits(self.drawn_norm(x), local, scene.codes.expand(-1, count, -1, -1))

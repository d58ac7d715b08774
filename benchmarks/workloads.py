"""What `world_model.py` measures: a world model that imagines, and one that learns."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lerobot_wmrl.precision import compute_in
from lerobot_wmrl.world_models.imagination import ImaginationState
from lerobot_wmrl.world_models.losses import Clip
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel

STEPS = 8
"""Frames imagined at a turn."""

Work = Callable[[], object]


@dataclass
class Imagination:
    """B imaginations whose ring is full, as it is in the long run."""

    model: ActionWorldModelRewardModel
    batch: int
    dtype: torch.dtype
    device: torch.device

    def __post_init__(self) -> None:
        self.action = self.model.action_mean.expand(self.batch, -1).clone()
        self.state = self._full_ring()
        tokenizer = self.model.tokenizer
        size, cameras = tokenizer.image_size, tokenizer.num_cameras
        first = torch.zeros(self.batch, cameras, 3, size, size, device=self.device)
        self.context = tokenizer.context(first)

    def _full_ring(self) -> ImaginationState:
        tokens = torch.zeros(
            self.batch, self.model.tokenizer.tokens_per_frame, dtype=torch.long, device=self.device
        )
        state = self.model.start(
            tokens, self.model.state_mean.expand(self.batch, -1), dtype=self.dtype,
            depth=torch.ones(tokens.shape, device=self.device),
        )  # fmt: skip
        state.cache.visible = state.cache.window
        state.cache.position.fill_(state.cache.window)
        return state

    def step(self) -> Tensor:
        """Tokens of one more frame, (B, S)."""
        return self.model.step(self.state, self.action).tokens

    def step_and_decode(self) -> Tensor:
        """Its pictures, (B, N, 3, H, W)."""
        return self.model.decode(self.step(), self.context).images

    @torch.no_grad()
    def step_without_ring(self) -> Tensor:
        """The same frame from the whole window's digits and actions, all layers computed anew."""
        window, model = self.state.cache.window, self.model
        condition = model.encode_actions(self.action[:, None].expand(-1, window, -1))
        digits = self.state.digits.expand(-1, window, -1, -1)
        with compute_in(self.dtype, self.device):
            prediction = model.network(
                digits, self.state.proprioception.expand(-1, window, -1), *condition,
                depth=self.state.depth.expand(-1, window, -1),
            )  # fmt: skip
        return model.network.codebook.sample(prediction.logits[:, -1], 0.0, None)

    def bytes_a_frame(self) -> float:
        """Weights, shared by the batch, and the ring of one imagination, each read once."""
        weights = sum(parameter.numel() for parameter in self.model.network.parameters())
        ring = 2 * self.state.cache.keys.numel() / self.batch
        return (weights / self.batch + ring) * self.dtype.itemsize


def repeated(work: Work, device: torch.device) -> Work:
    """`STEPS` times `work`; on CUDA as replays of one graph, captured after a warm-up on a side stream."""
    replay = work
    if device.type == "cuda":
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(3):
                work()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            work()
        replay = graph.replay

    def repeat() -> None:
        for _ in range(STEPS):
            replay()

    return repeat


def random_clip(model: ActionWorldModelRewardModel, batch: int, device: torch.device) -> Clip:
    """A batch of clips of the length the model is trained on."""
    config, shape = model.config, (batch, model.config.clip_length)
    tokens = torch.randint(0, 2, (*shape, model.tokenizer.tokens_per_frame), device=device)
    state, action = (
        torch.randn(*shape, size, device=device) for size in (config.state_size, config.action_size)
    )
    yes = torch.ones(shape, dtype=torch.bool, device=device)
    done, depth = torch.zeros(shape, device=device), torch.ones(tokens.shape, device=device)
    return Clip(tokens, state, action, done, yes, yes, [""] * batch, depth)


def training_step(model: ActionWorldModelRewardModel, clip: Clip, dtype: torch.dtype) -> Work:
    """Loss, gradient and optimiser step on one batch, self-forcing included."""
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    optimizer: Any = model.config.get_optimizer_preset().build(parameters)

    def descend() -> None:
        with compute_in(dtype, clip.tokens.device):
            loss, _ = model.loss(clip)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return descend

"""What `world_model.py` and `training_memory.py` measure: world models that imagine, and that learn."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import draccus
import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from torch import Tensor

from lerobot_wmrl.common.cuda_graphs import cuda_graphs
from lerobot_wmrl.common.flags import format_flags
from lerobot_wmrl.common.precision import compute_in
from lerobot_wmrl.common.presets import preset_settings
from lerobot_wmrl.data.clips import Clip
from lerobot_wmrl.data.frames import Context, Frames
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig
from lerobot_wmrl.world_models.anchored.imagination import AnchoredImagination
from lerobot_wmrl.world_models.autoregressive.dynamics import AutoregressiveImagination
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig
from lerobot_wmrl.world_models.dynamics import Imagination as RunningImagination
from lerobot_wmrl.world_models.modeling_frame_tokenizer import FrameTokenizerRewardModel
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel, WorldModelRewardModel
from lerobot_wmrl.world_models.success import num_features

STEPS = 8
"""Frames imagined at a turn."""

Work = Callable[[], object]


@dataclass
class Imagination:
    """B imaginations that remember as much as they do in the long run."""

    model: ActionWorldModelRewardModel
    batch: int
    dtype: torch.dtype
    device: torch.device

    def __post_init__(self) -> None:
        self.action = self.model.action_mean.expand(self.batch, -1).clone()
        self.state = self._running()

    def _running(self) -> RunningImagination:
        state = self.model.start(start_frames(self.model, self.batch, self.device), dtype=self.dtype)
        for _ in range(self.frames):
            self.model.step(state, self.action)
        return state

    @property
    def frames(self) -> int:
        """Frames that are remembered in the long run: the window, or half of what an anchor is kept for."""
        config = self.model.config
        return config.clip_length // 2 if config.dynamics.type == "anchored" else config.dynamics.window

    def step(self) -> Tensor:
        """Tokens of one more frame, (B, S)."""
        return self.model.step(self.state, self.action).tokens

    def step_and_decode(self) -> Tensor:
        """Imagine a frame and return its pictures. (B, N, 3, H, W)"""
        return self.model.decode(self.step(), self.state.context).images

    @torch.no_grad()
    def step_without_memory(self) -> Tensor:
        """The same frame from all tokens and actions that are remembered, all layers computed anew."""
        model, state, frames = self.model, self.state, self.frames
        condition = model.encode_actions(self.action[:, None].expand(-1, frames, -1))
        with compute_in(self.dtype, self.device):
            if isinstance(state, AutoregressiveImagination):
                seen = (x.expand(-1, frames, *x.shape[2:]) for x in (state.codes, state.state))
                depth = state.depth.expand(-1, frames, -1)
                prediction, _ = model.dynamics.network(*seen, condition, depth=depth)
            else:
                last = torch.full((self.batch, 1), frames - 1, device=self.device)
                prediction = model.dynamics.network(
                    state.codes, state.state, condition, frames, last, state.context
                )
        return model.dynamics.network.codebook.most_likely(prediction.logits[:, -1])

    def bytes_a_frame(self) -> float:
        """Weights, shared by the batch, and what one imagination remembers, each read once."""
        weights = sum(parameter.numel() for parameter in self.model.dynamics.network.parameters())
        state = self.state
        parts = [state.cache.keys, state.cache.values]
        if isinstance(state, AnchoredImagination):
            parts += [*(state.scene or ()), *(state.rollout or ())]
        remembered = sum(part.numel() for part in parts)
        return (weights / self.batch + remembered / self.batch) * self.dtype.itemsize


def repeated(work: Work, graphed: bool) -> Work:
    """`STEPS` times `work`; if `graphed`, which needs CUDA, as replays of one graph, captured after a warm-up
    on a side stream."""
    replay = work
    if graphed:
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


def start_frames(model: ActionWorldModelRewardModel, batch: int, device: torch.device) -> Frames:
    """Return black first frames, (B,): what they show does not matter to the speed."""
    tokens = torch.zeros(batch, model.tokenizer.tokens_per_frame, dtype=torch.long, device=device)
    state = model.state_mean.expand(batch, -1)
    return Frames(tokens, state, black_context(model, batch, device), torch.ones(tokens.shape, device=device))


def black_context(model: ActionWorldModelRewardModel, batch: int, device: torch.device) -> Context:
    """Imaginations that begin in black frames."""
    size, cameras = model.tokenizer.image_size, model.tokenizer.num_cameras
    return model.tokenizer.context(torch.zeros(batch, cameras, 3, size, size, device=device))


def random_frames(model: FrameTokenizerRewardModel, batch: int, device: torch.device) -> dict[str, Tensor]:
    """A batch of pictures of noise, each with its episode's first one."""
    sizes = model.config.tokenizer
    shape = (batch, 3, sizes.image_size, sizes.image_size)
    names = [*sizes.camera_keys, *(f"reference.{camera}" for camera in sizes.cameras)]
    return {**{name: torch.rand(shape, device=device) for name in names}, "success": torch.arange(batch) == 0}


def random_clip(model: WorldModelRewardModel, batch: int, device: torch.device) -> Clip:
    """A batch of clips of the length the model is trained on."""
    config, shape = model.config, (batch, model.config.clip_length)
    tokens = torch.randint(0, 2, (*shape, model.tokenizer.tokens_per_frame), device=device)
    components = config.action_size if isinstance(config, ActionWorldModelConfig) else 0
    state, action = (torch.randn(*shape, size, device=device) for size in (config.state_size, components))
    yes = torch.ones(shape, dtype=torch.bool, device=device)
    done, depth = torch.zeros(shape, device=device), torch.ones(tokens.shape, device=device)
    features = None
    if model.config.predicts_success:
        features = torch.zeros(*shape, num_features(model.tokenizer.num_cameras), device=device)
    return Clip(
        tokens,
        state,
        action,
        done,
        yes,
        yes,
        ["push the cube"] * batch,
        depth,
        black_context(model, batch, device),
        features,
    )


def preset_config(preset: str, kind: str, flags: Sequence[str] = ()) -> TrainWorldModelConfig:
    """The configuration that the training command has with `--preset` and `flags`."""
    sizes = format_flags(preset_settings(preset, "train-world-model", [kind]))
    return draccus.parse(
        TrainWorldModelConfig, args=[*sizes, f"--model.type={kind}", "--model.device=cpu", *flags]
    )


def training_step(
    model: PreTrainedRewardModel, batch: Clip | dict[str, Tensor], dtype: torch.dtype
) -> Callable[[], Tensor]:
    """Loss, gradient and optimiser step on one batch, self-forcing included. Returns the loss."""
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    optimizer: Any = model.config.get_optimizer_preset().build(parameters)

    def descend() -> Tensor:
        with cuda_graphs(), compute_in(dtype, parameters[0].device):
            loss, _ = model(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        return loss.detach()

    return descend

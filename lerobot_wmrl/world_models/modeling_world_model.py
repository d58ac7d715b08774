"""The two world models (eq. 1) as LeRobot reward models: one architecture, two conditions.

Trained from token clips (`loss`) or from a LeRobotDataset's batches (`forward`); unrolled by `start`,
`restart` and `step`, which advance a preallocated state in place.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn

from lerobot_wmrl.precision import compute_in, imagination_dtype
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.compatibility import (
    check_cameras,
    check_dataset,
    check_episode_lengths,
    check_tokenizer_source,
)
from lerobot_wmrl.world_models.configuration_world_model import (
    ActionWorldModelConfig,
    TextWorldModelConfig,
    WorldModelConfig,
)
from lerobot_wmrl.world_models.context import NO_CONTEXT, Context
from lerobot_wmrl.world_models.decoding import Condition, FramesSeen, make_decoding
from lerobot_wmrl.world_models.frame_tokenizer import Decoded, FrameTokenizer
from lerobot_wmrl.world_models.frozen_t5 import CHECKPOINT_FOLDER, FrozenT5
from lerobot_wmrl.world_models.goal import imagine_goal, similarity_to_goal
from lerobot_wmrl.world_models.hub_card import HubCard
from lerobot_wmrl.world_models.instructions import check_one_each
from lerobot_wmrl.world_models.losses import (
    Clip,
    corrupt_digits,
    force_predictions,
    forced_share,
    next_frame_loss,
    token_weights,
)
from lerobot_wmrl.world_models.modeling_frame_tokenizer import stack_cameras
from lerobot_wmrl.world_models.next_frame import NextFrameNetwork, Prediction
from lerobot_wmrl.world_models.temporal_memory import TemporalCache
from lerobot_wmrl.world_models.text_encoder import make_text_encoder
from lerobot_wmrl.world_models.windows import clip_from_windows

SMALL_BATCH = 16
"""In so few imaginations at once on the CPU, casts cost more than bfloat16 saves."""

MIN_SPREAD = 1e-3
"""Components that vary less than this are constants, and left alone by normalisation."""


STATE_LIMIT = 5.0
"""In standard deviations."""


class Imagined(NamedTuple):
    """One imagined frame of every environment.

    tokens (B, S); done_logit (B,); proprioception (B, P) in the dataset's units; hidden (B, D);
    entropy (B,), the mean over code factors of the predictive entropy in nats.
    """

    tokens: Tensor
    done_logit: Tensor
    proprioception: Tensor
    hidden: Tensor
    entropy: Tensor


@dataclass
class ImaginationState:
    """Where B imaginations stand: digits (B, 1, S, C), normalised state (B, 1, P), ring of past frames.

    Its tensors are allocated once and advanced in place. The network computes in the ring's dtype.
    """

    digits: Tensor
    proprioception: Tensor
    cache: TemporalCache
    condition: Condition | None = None


class WorldModelRewardModel(HubCard, PreTrainedRewardModel):
    """Base of both: tokenizer, next-frame network and statistics in one checkpoint."""

    config_class = WorldModelConfig
    name = "world_model"
    state_mean: Tensor
    state_std: Tensor

    def __init__(
        self, config: WorldModelConfig, dataset_stats: Any = None, dataset_meta: Any = None, **kwargs: Any
    ) -> None:
        super().__init__(config)
        self.config: Any = config
        self.training_progress = 1.0
        if dataset_meta is not None:
            check_tokenizer_source(config)
            check_episode_lengths(dataset_meta)
        source = self._adopt_tokenizer() if config.tokenizer_path else None
        if dataset_meta is not None:
            self._adopt_features(dataset_meta.features)
        self.tokenizer = FrameTokenizer(
            config.image_size, config.tokenizer_widths, config.levels, len(config.cameras), config.quantizer,
            config.tokenizer_context,
        ).requires_grad_(False)  # fmt: skip
        if source is not None:
            self.tokenizer.load_state_dict(source.tokenizer.state_dict())
        if self.tokenizer.grid % config.patch:
            raise ValueError(
                f"--model.patch={config.patch}: must divide the tokenizer's grid, {self.tokenizer.grid}"
            )
        self.network = NextFrameNetwork(
            levels=config.levels, grid=self.tokenizer.grid, num_cameras=len(config.cameras),
            state_size=config.state_size, patch=config.patch, layers=config.layers, width=config.width,
            heads=config.heads, window=config.window, code_width=config.code_width,
            quantizer=config.quantizer,
            conditioning=config.conditioning,
        )  # fmt: skip
        self.decoding = make_decoding(config, self.network.embedding.local.in_channels)
        self._register_statistics("state", OBS_STATE, config.state_size, dataset_stats)

    def train(self, mode: bool = True) -> "WorldModelRewardModel":
        """The tokenizer is fixed: it stays in evaluation mode."""
        super().train(mode)
        self.tokenizer.eval()
        return self

    def _adopt_tokenizer(self) -> Any:
        """Take the tokenizer's sizes into the config; a trained checkpoint no longer needs its path."""
        source = load_model(self.config.tokenizer_path, "frame_tokenizer")
        self.config.cameras, self.config.image_size = source.config.cameras, source.config.image_size
        self.config.tokenizer_widths, self.config.levels = source.config.widths, source.config.levels
        self.config.quantizer, self.config.tokenizer_context = source.config.quantizer, source.config.context
        self.config.tokenizer_path = None
        return source

    def _adopt_features(self, features: dict[str, Any]) -> None:
        """Take the widths from the dataset; a trained model must find its own there."""
        if self.config.pretrained_path:
            check_dataset(self.config, features)
        check_cameras(self.config, features)
        if self.config.state_size and OBS_STATE not in features:
            logging.info("the dataset has no observation.state: the world model does without proprioception")
        if self.config.state_size:
            self.config.state_size = features[OBS_STATE]["shape"][0] if OBS_STATE in features else 0

    def _register_statistics(self, name: str, key: str, size: int, stats: Any) -> None:
        mean, std = torch.zeros(size), torch.ones(size)
        if stats is not None and size:
            mean = torch.as_tensor(stats[key]["mean"], dtype=torch.float32)
            std = torch.as_tensor(stats[key]["std"], dtype=torch.float32)
            std = torch.where(std < MIN_SPREAD, 1.0, std)
        self.register_buffer(f"{name}_mean", mean)
        self.register_buffer(f"{name}_std", std)

    def normalize_state(self, state: Tensor) -> Tensor:
        """Dataset units to zero mean and unit spread, clipped: rare collisions must not outweigh the rest.

        Components beyond the model's `state_size` are dropped.
        """
        state = state[..., : self.config.state_size]
        return ((state - self.state_mean) / self.state_std).clamp(-STATE_LIMIT, STATE_LIMIT)

    def condition(self, clip: Clip) -> Condition:
        """Eq. 1's c as tokens for cross-attention."""
        raise NotImplementedError

    def loss(self, clip: Clip) -> tuple[Tensor, dict[str, float]]:
        """Eqs. 2-4 on a clip of tokens, with part of the inputs replaced by the model's own predictions."""
        condition = self.condition(clip)
        digits, state = self.network.codebook.digits(clip.tokens), self.normalize_state(clip.state)
        seen, seen_state = (
            corrupt_digits(digits, self.network.codebook, self.config.token_noise),
            state,
        )
        share = forced_share(self.config.self_forcing, self.training_progress)
        if share > 0:
            with torch.no_grad():
                guess = self.network(seen, seen_state, *condition)
            seen, seen_state = force_predictions(guess, self.network.codebook, seen, seen_state, share)
        memory = self.network.transformer.clip_memory(digits.shape[1], digits.device)
        prediction = self.network(seen, seen_state, *condition, memory)
        loss, metrics = next_frame_loss(prediction, self.network.codebook, digits, state, clip, self.config)
        weight, _ = token_weights(self.network.codebook, digits, clip, self.config.motion_weight)
        frames = FramesSeen(seen, condition, prediction, memory)
        decoding_loss, decoding_metrics = self.decoding.loss(self.network, frames, digits[:, 1:], weight)
        return loss + decoding_loss, metrics | decoding_metrics

    def forward(self, batch: Clip | dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """The loss on a clip, or on LeRobot's batch, of which `clip_from_windows` has the shapes."""
        return self.loss(batch if isinstance(batch, Clip) else self.clip_from_batch(batch))

    @torch.no_grad()
    def clip_from_batch(self, batch: dict[str, Any]) -> Clip:
        """Tokenise a batch of LeRobot's windows."""
        images = stack_cameras(batch, self.config.camera_keys, self.config.image_size)
        shape = images.shape[:2]
        context = self._context(batch)[torch.arange(shape[0]).repeat_interleave(shape[1])]
        tokens = self.tokenizer.encode(images.flatten(0, 1), context).unflatten(0, shape)
        return clip_from_windows(tokens, batch, self.config.camera_keys[0], self.config.state_size)

    def _context(self, batch: dict[str, Any]) -> Context:
        """Of the windows' first frames, since a window does not hold its episode's. B rows, or none."""
        images = stack_cameras(batch, self.config.camera_keys, self.config.image_size)
        return self.tokenizer.context(images[:, 0])

    @torch.no_grad()
    def predict(self, clip: Clip) -> Prediction:
        """Teacher-forced predictions on a clip."""
        digits = self.network.codebook.digits(clip.tokens)
        return self.network(digits, self.normalize_state(clip.state), *self.condition(clip))

    def start(
        self,
        tokens: Tensor,
        proprioception: Tensor,
        instructions: Sequence[str] | None = None,
        dtype: torch.dtype | None = None,
    ) -> ImaginationState:
        """Imagination from one frame: tokens (B, S), proprioception (B, P) in dataset units.

        The network computes in `dtype`, by default the fastest; samples, done, state and entropy are float32.
        """
        batch, device = tokens.shape[0], tokens.device
        small = batch < SMALL_BATCH and device.type == "cpu"
        dtype = dtype or (torch.float32 if small else imagination_dtype(device))
        cache = self.network.transformer.make_cache(batch, self.network.transformer_tokens, device, dtype)
        condition = self.encode_instructions(instructions, batch) if instructions is not None else None
        digits = self.network.codebook.digits(tokens)[:, None]
        return ImaginationState(digits, self.normalize_state(proprioception)[:, None], cache, condition)

    def restart(self, state: ImaginationState, mask: Tensor, tokens: Tensor, proprioception: Tensor) -> None:
        """Put the environments in `mask` (B,) back to a first frame; their past is masked, not moved."""
        digits = self.network.codebook.digits(tokens)[:, None]
        first = self.normalize_state(proprioception)[:, None]
        state.digits.copy_(torch.where(mask[:, None, None, None], digits, state.digits))
        state.proprioception.copy_(torch.where(mask[:, None, None], first, state.proprioception))
        state.cache.restart(mask)

    @torch.no_grad()
    def step(
        self, state: ImaginationState, action: Tensor | None = None, generator: torch.Generator | None = None
    ) -> Imagined:
        """Imagine the next frame of every environment: action (B, A) in the dataset's units."""
        condition = state.condition if action is None else self.encode_actions(action[:, None])
        if condition is None:
            raise ValueError("this imagination needs an action each step, or an instruction at the start")
        codebook = self.network.codebook
        with compute_in(state.cache.keys.dtype, state.digits.device):
            prediction = self.network.step(state.digits, state.proprioception, *condition, state.cache)
            seen = FramesSeen(state.digits, condition, prediction, state.cache)
            digits = self.decoding.decode(self.network, seen, self.config.temperature, generator)
        state.digits.copy_(digits)
        state.proprioception.copy_(prediction.proprioception)
        return Imagined(
            codebook.tokens(state.digits[:, 0]),
            prediction.done_logit[:, 0],
            prediction.proprioception[:, 0] * self.state_std + self.state_mean,
            prediction.hidden[:, 0],
            codebook.entropy(prediction.logits[:, 0]),
        )

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


class ActionWorldModelRewardModel(WorldModelRewardModel):
    """The world model that answers a policy."""

    config_class = ActionWorldModelConfig
    name = "action_world_model"
    summary = (
        "An action-conditioned world model: from a frame, the robot's state and an action it imagines the "
        "next frame and state. Its reward is the probability that the task is then done."
    )
    action_mean: Tensor
    action_std: Tensor

    def __init__(self, config: ActionWorldModelConfig, dataset_stats: Any = None, **kwargs: Any) -> None:
        super().__init__(config, dataset_stats, **kwargs)
        self._register_statistics("action", ACTION, config.action_size, dataset_stats)
        width, count = config.width, config.condition_tokens
        self.embed_action = nn.Sequential(
            nn.Linear(config.action_size, width), nn.SiLU(), nn.Linear(width, count * width)
        )

    def _adopt_features(self, features: dict[str, Any]) -> None:
        super()._adopt_features(features)
        self.config.action_size = features[ACTION]["shape"][0]

    def encode_actions(self, actions: Tensor) -> Condition:
        if actions.shape[-1] != self.config.action_size:
            raise ValueError(
                f"action: {actions.shape[-1]} components, but the world model was trained with "
                f"{self.config.action_size}; use a dataset or policy with the same actions"
            )
        normalised = (actions - self.action_mean) / self.action_std
        return self.embed_action(normalised).unflatten(-1, (self.config.condition_tokens, -1)), None

    def condition(self, clip: Clip) -> Condition:
        return self.encode_actions(clip.action)

    @torch.no_grad()
    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Probability that success holds after the window's last action. → (B,)"""
        clip = self.clip_from_batch(batch)
        last = clip.valid.sum(1, keepdim=True) - 1
        return self.predict(clip).done_logit.gather(1, last).squeeze(1).sigmoid()


class TextWorldModelRewardModel(WorldModelRewardModel):
    """The world model that imagines the golden trajectory of an instruction."""

    config_class = TextWorldModelConfig
    name = "text_world_model"
    summary = (
        "A text-conditioned world model: from a frame and an instruction it imagines how the task is done. "
        "Its reward is the similarity of a frame to the end of what it imagined."
    )

    def __init__(
        self, config: TextWorldModelConfig, *, dataset_meta: Any = None, t5: FrozenT5 | None = None,
        **kwargs: Any,
    ) -> None:  # fmt: skip
        super().__init__(config, dataset_meta=dataset_meta, **kwargs)
        if config.text_encoder is not None:
            t5 = t5 or FrozenT5.load(config.text_encoder)
            config.text_encoder = CHECKPOINT_FOLDER
        self.text_encoder = make_text_encoder(config.width, t5)
        if dataset_meta is not None:
            self.text_encoder.check(dataset_meta.tasks.index)

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path, *, config: Any = None, **kwargs: Any
    ) -> "TextWorldModelRewardModel":
        """Load a checkpoint: a folder or a hub id, with its frozen T5 if it was trained with one."""
        config = config or RewardModelConfig.from_pretrained(pretrained_name_or_path, **kwargs)
        if config.text_encoder is not None:
            kwargs["t5"] = FrozenT5.load_carried(pretrained_name_or_path, kwargs.get("revision"))
        return super().from_pretrained(pretrained_name_or_path, config=config, **kwargs)

    def _save_pretrained(self, save_directory: Path) -> None:
        self.text_encoder.save(save_directory / CHECKPOINT_FOLDER)
        super()._save_pretrained(save_directory)

    def encode_instructions(self, instructions: Sequence[str], batch: int) -> Condition:
        check_one_each(instructions, batch)
        return self.text_encoder(instructions)

    def condition(self, clip: Clip) -> Condition:
        return self.encode_instructions(clip.instructions, len(clip.tokens))

    @torch.no_grad()
    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Similarity of the window's last frame to the goal imagined from its first one. → (B,)"""
        clip, context = self.clip_from_batch(batch), self._context(batch)
        goal = imagine_goal(self, clip.tokens[:, 0], clip.state[:, 0], clip.instructions, context)
        return similarity_to_goal(self.tokenizer, clip.tokens[:, -1], goal.features, context)

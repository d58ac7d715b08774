"""The two world models (eq. 1) as LeRobot reward models: one architecture, two conditions.

They are trained on clips of tokens, or on lerobot-train's batches; `ImaginationMixin` adds imagination. A
checkpoint holds tokenizer, dynamics and statistics.
"""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policy_checks import check_units
from lerobot_wmrl.common.precision import compute_in
from lerobot_wmrl.data.checks import check_cameras, check_depth, check_episode_lengths, check_statistics
from lerobot_wmrl.data.clips import Clip, clip_from_windows
from lerobot_wmrl.data.embodiment import check_range, read_embodiment
from lerobot_wmrl.data.episodes import parquet_files, read_vectors, success_column
from lerobot_wmrl.data.frame_cache import depth_of_windows, unmeasured_depth
from lerobot_wmrl.world_models.anchored.dynamics import AnchoredDynamics
from lerobot_wmrl.world_models.autoregressive.configuration import AutoregressiveConfig
from lerobot_wmrl.world_models.autoregressive.dynamics import AutoregressiveDynamics
from lerobot_wmrl.world_models.checkpoint import check_dataset, check_tokenizer_source, load_model
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.configuration_world_model import (
    ActionWorldModelConfig,
    AnchoredConfig,
    TextWorldModelConfig,
    WorldModelConfig,
)
from lerobot_wmrl.world_models.dynamics import Dynamics
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer
from lerobot_wmrl.world_models.goal import imagine_goal, similarity_to_goal
from lerobot_wmrl.world_models.hub_card import HubCard
from lerobot_wmrl.world_models.imagination import ImaginationMixin
from lerobot_wmrl.world_models.layers import FrameSizes, Prediction
from lerobot_wmrl.world_models.modeling_frame_tokenizer import (
    stack_cameras,
    stretch_cameras,
    with_frame_sizes,
)
from lerobot_wmrl.world_models.scaling import STATE_MIN_STD, Scale
from lerobot_wmrl.world_models.text import CHECKPOINT_FOLDER, FrozenT5, check_one_each, make_text_encoder

CONDITION_TOKENS: Final = 4
"""Tokens that an action is embedded into."""

UNLABELLED_DONE: Final = -5.0
"""Initial logit of done where the dataset does not say what success is. Nothing trains done then, and at a
probability of one half imaginations would end in success."""


def make_dynamics(config: WorldModelConfig, grid: int) -> Dynamics:
    """Make the dynamics that the configuration chooses, untrained, for a tokenizer with this grid."""
    tokenizer, chosen = config.trained_tokenizer, config.dynamics
    if grid % chosen.patch:
        raise FieldError("dynamics.patch", chosen.patch, f"must divide the tokenizer's grid, {grid}")
    sizes = FrameSizes(
        levels=tokenizer.levels,
        quantizer=tokenizer.quantizer,
        grid=grid,
        num_cameras=len(tokenizer.cameras),
        state_size=config.state_size,
        clip_length=config.clip_length,
        context_channels=config.context_channels,
        success=config.predicts_success,
    )
    if isinstance(chosen, AnchoredConfig):
        return AnchoredDynamics(chosen, sizes)
    assert isinstance(chosen, AutoregressiveConfig)
    return AutoregressiveDynamics(chosen, sizes)


class WorldModelRewardModel(HubCard, ImaginationMixin, PreTrainedRewardModel):
    """Base of both world models: what they learn from, and imagination in the dataset's units."""

    config_class = WorldModelConfig
    name = "world_model"
    state_mean: Tensor
    state_std: Tensor
    state_limit: Tensor

    def __init__(
        self, config: WorldModelConfig, dataset_stats: Any = None, dataset_meta: Any = None, **kwargs: Any
    ) -> None:
        super().__init__(config)
        self.config: Any = config
        check_tokenizer_source(config, dataset_meta is not None and not config.pretrained_path)
        if dataset_meta is not None:
            check_episode_lengths(dataset_meta.root, dataset_meta.total_episodes, dataset_meta.total_frames)
        source = self._adopt_tokenizer() if config.tokenizer_path else None
        self._unmeasured: list[float] = []  # known with the dataset
        if dataset_meta is not None:
            self._adopt_dataset(dataset_meta)
        tokenizer_config: Any = config.tokenizer  # given, or adopted above
        self.tokenizer = FrameTokenizer(tokenizer_config).requires_grad_(False)
        if source is not None:
            self.tokenizer.load_state_dict(source.tokenizer.state_dict())
        self.tokenizer.eval()
        self._instruction_weights: dict[str, Tensor] = {}
        self.dynamics = make_dynamics(config, self.tokenizer.grid)
        done: Any = self.dynamics.network.done
        if config.predicts_success:
            done.head.load_state_dict(self.tokenizer.success.head.state_dict())  # type: ignore[union-attr]
        elif dataset_meta is not None and success_column(dataset_meta.features) is None:
            nn.init.constant_(done[-1].bias, UNLABELLED_DONE)
        scale = Scale.of(config.state_size, dataset_stats and dataset_stats.get(OBS_STATE), STATE_MIN_STD)
        self._register_scale("state", scale)
        self.register_buffer("state_limit", scale.reach(self._recorded_states(dataset_meta)))

    def _recorded_states(self, meta: Any) -> np.ndarray | None:
        """Return the states (rows, P) of a dataset, None where there are none on this machine, and for a
        trained model, whose weights bring its reach."""
        if meta is None or self.config.pretrained_path or not self.config.state_size:
            return None
        return read_vectors(Path(meta.root), OBS_STATE) if parquet_files(Path(meta.root)) else None

    def train(self, mode: bool = True) -> "WorldModelRewardModel":
        """Keep the tokenizer, which is fixed, in evaluation mode."""
        super().train(mode)
        self.tokenizer.eval()
        return self

    def _adopt_tokenizer(self) -> Any:
        """Take the tokenizer's settings into the config; a trained checkpoint no longer needs its path."""
        source = load_model(self.config.tokenizer_path, "frame_tokenizer")
        self.config.tokenizer = source.config.tokenizer
        self.config.tokenizer_path = None
        return source

    def _adopt_dataset(self, meta: Any) -> None:
        """Take the sizes of features from the dataset, or check them against those of a trained model."""
        if self.config.pretrained_path:
            check_dataset(self.config, meta)
        tokenizer_config, features = self.config.tokenizer, meta.features
        check_cameras(meta, tokenizer_config.camera_keys)
        self.config.tokenizer = with_frame_sizes(tokenizer_config, features)
        if self.config.depth:
            check_depth(features, tokenizer_config.camera_keys)
            self._unmeasured = unmeasured_depth(features, tokenizer_config.camera_keys)
        if self.config.state_size and OBS_STATE not in features:
            logging.info("the dataset has no observation.state: the world model does without it")
        elif self.config.state_size:
            check_statistics(meta, OBS_STATE)
        if self.config.state_size:
            self.config.state_size = features[OBS_STATE]["shape"][0] if OBS_STATE in features else 0

    def _register_scale(self, name: str, scale: Scale) -> None:
        self.register_buffer(f"{name}_mean", scale.mean)
        self.register_buffer(f"{name}_std", scale.std)

    def normalize_state(self, state: Tensor) -> Tensor:
        """Dataset units (…, P) to zero mean and unit spread.

        Clipped at `state_limit`. Without proprioception → (…, 0).
        """
        state = state[..., : self.config.state_size]
        return ((state - self.state_mean) / self.state_std).clamp(-self.state_limit, self.state_limit)

    @torch.no_grad()
    def instruction_weights(self, instructions: Sequence[str], batch: int) -> Tensor | None:
        if not self.config.reads_instructions:
            return None
        check_one_each(instructions, batch)
        classifier: Any = self.tokenizer.success
        for text in set(instructions) - self._instruction_weights.keys():  # the tokenizer is fixed
            with compute_in(torch.float32, self.device):  # kept: the same for trainings in bfloat16
                self._instruction_weights[text] = classifier.instructions([text])[0]
        device = self.device
        return torch.stack([self._instruction_weights[text].to(device) for text in instructions])

    def condition(self, clip: Clip) -> Condition:
        """Return the condition (eq. 1's c) of every row of a clip, tokens (B, T or 1, M, D)."""
        raise NotImplementedError

    def forward(self, batch: Clip | dict[str, Any], progress: float = 1.0) -> tuple[Tensor, dict[str, float]]:
        """Compute the loss of eqs. 2-4 and its parts on a clip, or on LeRobot's batch (`clip_from_windows`).

        progress: share of the training that is over, which lerobot-train does not give.
        """
        clip = batch if isinstance(batch, Clip) else self.clip_from_batch(batch)
        return self.dynamics.loss(self._normalized_clip(clip), self.condition(clip), progress)

    @torch.no_grad()
    def predict(self, clip: Clip, with_tokens: bool = True) -> Prediction:
        """Predict the frame after every row of a clip, normalised; no prediction is fed back.

        Where its tokens are not needed, `with_tokens` = False is faster.
        """
        return self.dynamics.predict(self._normalized_clip(clip), self.condition(clip), with_tokens)

    def _normalized_clip(self, clip: Clip) -> Clip:
        return clip._replace(state=self.normalize_state(clip.state))

    @torch.no_grad()
    def clip_from_batch(self, batch: dict[str, Any]) -> Clip:
        """Tokenise a batch of LeRobot's windows.

        Each window's first frame gives the context, because the batch lacks the episode's first frame.
        """
        tokenizer_config = self.config.tokenizer
        images = stack_cameras(batch, tokenizer_config.camera_keys, tokenizer_config.image_size)
        shape = images.shape[:2]
        context = self.tokenizer.context(images[:, 0])
        rows = torch.arange(shape[0]).repeat_interleave(shape[1])
        tokens = self.tokenizer.encode(images.flatten(0, 1), context[rows]).unflatten(0, shape)
        depth = None
        if self.config.depth:
            unmeasured = self._unmeasured or [0.0] * len(tokenizer_config.cameras)
            depth = depth_of_windows(batch, tokenizer_config.camera_keys, self.tokenizer.grid, unmeasured)
        features = None
        if self.config.predicts_success:
            first = images[:, :1].expand_as(images)
            features = self.tokenizer.success_features(first.flatten(0, 1), images.flatten(0, 1))
            features = features.unflatten(0, shape)
        clip = clip_from_windows(
            tokens, batch, tokenizer_config.camera_keys[0], self.config.state_size, depth, features
        )
        return clip._replace(context=context)


class ActionWorldModelRewardModel(WorldModelRewardModel):
    """The world model that imagines what follows a policy's actions."""

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
        low, high = map(torch.tensor, (config.embodiment.action_low, config.embodiment.action_high))
        unit = ((high - low) / 2).clamp_max(1.0) if len(low) else 1.0
        stats = dataset_stats and dataset_stats[ACTION]
        self._register_scale("action", Scale.of(config.action_size, stats, unit=unit))
        width = config.dynamics.width
        self.embed_action = nn.Sequential(
            nn.Linear(config.action_size, width), nn.SiLU(), nn.Linear(width, CONDITION_TOKENS * width)
        )

    def _adopt_dataset(self, meta: Any) -> None:
        super()._adopt_dataset(meta)
        check_statistics(meta, ACTION)
        self.config.action_size = meta.features[ACTION]["shape"][0]
        embodiment = self.config.embodiment
        if self.config.pretrained_path:  # another range may have been given beside it
            check_range(embodiment.action_low, embodiment.action_high, embodiment.action_names)
        else:
            self.config.embodiment = read_embodiment(meta, embodiment)

    def check_units(self, policy: PreTrainedConfig, postprocessor: Any) -> None:
        """Raise FieldError if a policy's actions are in other units than those that the model learnt from."""
        check_units(policy, postprocessor, self.config.embodiment.action_names, *self.action_range())

    def action_deviation(self) -> Tensor:
        """Return the standard deviation of each component of an action, 0 where it never varies. (A,)"""
        return torch.where(self.action_std == 1, 0.0, self.action_std)  # statistics hold 1 for constants

    def action_range(self) -> tuple[Tensor, Tensor]:
        """Return the least and the greatest value of each component of an action. (A,), (A,)

        Raises:
            FieldError: the checkpoint does not say.
        """
        embodiment = self.config.embodiment
        if not embodiment.action_low:
            raise FieldError(
                "world_model_path",
                self.config.pretrained_path,
                "does not say in which range actions are",
                "train it with this version of the package",
            )
        ends = embodiment.action_low, embodiment.action_high
        low, high = (torch.tensor(end, device=self.device) for end in ends)
        return low, high

    def observation(self, images: Tensor, state: Tensor, instructions: Sequence[str]) -> dict[str, Any]:
        """Return B frames as a policy sees them.

        Args:
            images: (B, N, 3, S, S) in [0, 1], squares as the tokenizer has them; shown in the sizes of the
                dataset's frames.
            state: (B, P); left out if it is not predicted.
            instructions: B of them, `task`.
        """
        return self.shown(self.compact_observation(images, state, instructions))

    def compact_observation(
        self, images: Tensor, state: Tensor, instructions: Sequence[str]
    ) -> dict[str, Any]:
        """Return B frames as in `observation`, but as squares: what is worth storing of large frames."""
        observation = dict(zip(self.config.trained_tokenizer.frame_shapes, images.unbind(1), strict=True))
        if self.config.state_size:
            observation[OBS_STATE] = state
        return {**observation, "task": list(instructions)}

    def shown(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """Return a compact observation with frames of the dataset's sizes; those that have them stay."""
        return stretch_cameras(observation, self.config.trained_tokenizer.frame_shapes)

    def encode_actions(self, actions: Tensor, instruction_weights: Tensor | None = None) -> Condition:
        if actions.shape[-1] != self.config.action_size:
            raise ValueError(
                f"action: {actions.shape[-1]} components, but the world model was trained with "
                f"{self.config.action_size}; use a dataset or policy with the same actions"
            )
        normalised = (actions - self.action_mean) / self.action_std
        tokens = self.embed_action(normalised).unflatten(-1, (CONDITION_TOKENS, -1))
        weights = None if instruction_weights is None else instruction_weights[:, None]
        return Condition(tokens, instruction_weights=weights)

    def condition(self, clip: Clip) -> Condition:
        return self.encode_actions(clip.action, self.instruction_weights(clip.instructions, len(clip.tokens)))

    @torch.no_grad()
    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Return the probability that success holds after the window's last action. → (B,)"""
        clip = self.clip_from_batch(batch)
        last = clip.valid.sum(1, keepdim=True) - 1
        return self.predict(clip, with_tokens=False).done_logit.gather(1, last).squeeze(1).sigmoid()


class TextWorldModelRewardModel(WorldModelRewardModel):
    """The world model that imagines the golden trajectory of an instruction."""

    config_class = TextWorldModelConfig
    name = "text_world_model"
    summary = (
        "A text-conditioned world model: from a frame and an instruction it imagines how the task is done. "
        "Its reward is the similarity of a frame to the end of what it imagined."
    )

    def __init__(
        self,
        config: TextWorldModelConfig,
        *,
        dataset_meta: Any = None,
        t5: FrozenT5 | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(config, dataset_meta=dataset_meta, **kwargs)
        if config.text_encoder is not None:
            t5 = t5 or FrozenT5.load(config.text_encoder)
            config.text_encoder = CHECKPOINT_FOLDER
        self.text_encoder = make_text_encoder(config.dynamics.width, t5)
        if dataset_meta is not None:
            self.text_encoder.check(dataset_meta.tasks.index)

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path, *, config: Any = None, **kwargs: Any
    ) -> "TextWorldModelRewardModel":
        """Load a checkpoint: a folder or a hub id, with its frozen T5 if it was trained with one."""
        config = config or RewardModelConfig.from_pretrained(pretrained_name_or_path, **kwargs)
        if config.text_encoder not in (None, CHECKPOINT_FOLDER):
            raise FieldError(
                "text_encoder",
                config.text_encoder,
                "a trained model keeps the text encoder that it has",
                "leave it out, or train a new model with `model.type`",
            )
        if config.text_encoder is not None:
            kwargs["t5"] = FrozenT5.load_carried(pretrained_name_or_path, kwargs.get("revision"))
        return super().from_pretrained(pretrained_name_or_path, config=config, **kwargs)

    def _save_pretrained(self, save_directory: Path) -> None:
        self.text_encoder.save(save_directory / CHECKPOINT_FOLDER)
        super()._save_pretrained(save_directory)

    def encode_instructions(self, instructions: Sequence[str], batch: int) -> Condition:
        check_one_each(instructions, batch)
        weights = self.instruction_weights(instructions, batch)
        condition: Condition = self.text_encoder(instructions)
        return condition._replace(instruction_weights=None if weights is None else weights[:, None])

    def condition(self, clip: Clip) -> Condition:
        return self.encode_instructions(clip.instructions, len(clip.tokens))

    @torch.no_grad()
    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Return the similarity of the window's last frame to the goal imagined from its first one. → (B,)"""
        clip = self.clip_from_batch(batch)
        goal = imagine_goal(self, clip.first(), clip.instructions)
        return similarity_to_goal(self.tokenizer, clip.tokens[:, -1], goal.decoded.features, clip.context)

"""The two world models (eq. 1) as LeRobot reward models: one architecture, two conditions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lerobot.configs.rewards import RewardModelConfig
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from lerobot_wmrl.data.clips import Clip
from lerobot_wmrl.world_models.configuration_world_model import (
    ActionWorldModelConfig,
    TextWorldModelConfig,
)
from lerobot_wmrl.world_models.decoding import Condition
from lerobot_wmrl.world_models.frozen_t5 import CHECKPOINT_FOLDER, FrozenT5
from lerobot_wmrl.world_models.goal import imagine_goal, similarity_to_goal
from lerobot_wmrl.world_models.instructions import check_one_each
from lerobot_wmrl.world_models.text_encoder import make_text_encoder
from lerobot_wmrl.world_models.world_model import WorldModelRewardModel


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
        return self.predict(clip, drawn=False).done_logit.gather(1, last).squeeze(1).sigmoid()


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
        clip = self.clip_from_batch(batch)
        depth = clip.depth if clip.depth is None else clip.depth[:, 0]
        goal = imagine_goal(self, clip.tokens[:, 0], clip.state[:, 0], clip.instructions, clip.context, depth)
        return similarity_to_goal(self.tokenizer, clip.tokens[:, -1], goal.decoded.features, clip.context)

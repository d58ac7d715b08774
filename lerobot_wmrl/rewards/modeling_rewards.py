"""The rewards as LeRobot reward models: trained by lerobot-train, asked by the environment."""

from typing import Any

import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.constants import REWARD
from torch import Tensor, nn

from lerobot_wmrl.common.checkpoints import weights_digest
from lerobot_wmrl.common.errors import FieldError, require_at_least
from lerobot_wmrl.data.checks import check_cameras, frame_size
from lerobot_wmrl.data.clips import take_steps, unpadded_rows
from lerobot_wmrl.rewards.configuration_rewards import EmbeddingConfig, GeneralConfig, ProxyConfig
from lerobot_wmrl.rewards.general import general_reward
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.hub_card import HubCard
from lerobot_wmrl.world_models.modeling_frame_tokenizer import stack_cameras
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel


class GeneralRewardModel(PreTrainedRewardModel):
    """The general reward behind LeRobot's interface. It has no weights."""

    config_class = GeneralConfig
    name = "general"

    def __init__(self, config: GeneralConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: GeneralConfig = config

    def compute_reward(self, batch: dict[str, Tensor]) -> Tensor:
        """Return Algorithm 1's reward. → (B,)

        Args:
            batch: `success` (B,), 1 on the one frame that completes the run of done frames, and, unless α is
                1, `similarity` and `previous.similarity` to the goal frame, (B,) each.
        """
        config = self.config
        if not config.needs_goal:
            return batch["success"]
        gamma = config.gamma
        if gamma is None and config.form == "potential":
            raise FieldError("gamma", None, "how long episodes are is not known here", "give the discount")
        return general_reward(
            batch["success"],
            batch["similarity"],
            batch["previous.similarity"],
            alpha=config.success_weight,
            form=config.form,
            gamma=gamma or 1.0,
        )


class ProxyRewardModel(HubCard, PreTrainedRewardModel):
    """The reward of a frame by a convolutional network that knows nothing of the world model (DiWA)."""

    config_class = ProxyConfig
    name = "proxy"
    summary = "A reward that a convolutional network reads off camera frames, fitted to recorded rewards."

    def __init__(self, config: ProxyConfig, dataset_meta: Any = None, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: ProxyConfig = config
        if dataset_meta is not None:
            self._read_image_size(dataset_meta)
        require_at_least(config, 8, "image_size")
        width, last, side = config.width, 2 * config.width, -(-config.image_size // 8)
        self.layers = nn.Sequential(
            nn.Conv2d(3 * len(config.cameras), width, 5, stride=2, padding=2),
            nn.ReLU(),
            nn.Conv2d(width, last, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(last, last, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(last * side**2, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, 1),
        )

    def _read_image_size(self, meta: Any) -> None:
        features = meta.features
        first = self.config.camera_keys[0]
        if not self.config.image_size and first in features:
            self.config.image_size = frame_size(features[first])[0]
        check_cameras(meta, self.config.camera_keys, "cameras")

    def check_world_model(self, model: ActionWorldModelRewardModel) -> None:
        """Raise FieldError unless the model imagines frames like those that the network was trained on."""
        cameras = model.config.tokenizer.cameras
        if not {*self.config.cameras} <= {*cameras}:
            raise FieldError(
                "reward.pretrained_path",
                self.config.pretrained_path,
                f"this proxy reward looks at {', '.join(self.config.cameras)}, the world model imagines "
                f"{', '.join(cameras)}",
                "train the reward again on the world model's cameras",
            )

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss on frames that actions led to: images (B, 1, 3, H, W), `next.reward` (B, 1)."""
        first = self.config.camera_keys[0]
        reward = recorded_rewards(batch).flatten()
        padded = batch.get(f"{first}_is_pad", torch.zeros_like(reward, dtype=torch.bool))
        return regression_loss(self.compute_reward(batch), reward, ~padded.reshape(reward.shape))

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Return the reward of `observation.images.<camera>`, (B, 3, H, W) or (B, 1, 3, H, W). → (B,)"""
        images = stack_cameras(batch, self.config.camera_keys, self.config.image_size)
        return self.layers(images.flatten(-4, -3).flatten(0, -4) - 0.5).squeeze(1)


class EmbeddingRewardModel(HubCard, PreTrainedRewardModel):
    """The reward of an imagined frame by a head on the world model's hidden state (iVideoGPT).

    The world model is not part of the checkpoint, and the head fits no other world model.
    """

    config_class = EmbeddingConfig
    name = "embedding"
    summary = "A reward that a head reads off a world model's hidden state, fitted to recorded rewards."

    def __init__(self, config: EmbeddingConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: EmbeddingConfig = config
        self._world_model: list[ActionWorldModelRewardModel] = []  # in a list it is no submodule
        if not config.world_model:
            config.world_model = weights_digest(self.world_model.state_dict())
            config.hidden_size = self.world_model.config.dynamics.width
        self.head = nn.Sequential(
            nn.LayerNorm(config.hidden_size),
            nn.Linear(config.hidden_size, config.hidden),
            nn.SiLU(),
            nn.Linear(config.hidden, 1),
        )

    @property
    def world_model(self) -> ActionWorldModelRewardModel:
        """The world model, loaded when it is first needed."""
        if not self._world_model:
            path = self.config.world_model_path
            if not path:
                raise FieldError(
                    "world_model_path",
                    path,
                    "the reward is predicted from a world model's hidden states",
                    "give the action world model",
                )
            model = load_model(path, "action_world_model", self.config.device)
            self._world_model.append(model.requires_grad_(False))
        return self._world_model[0]

    def check_world_model(self, model: ActionWorldModelRewardModel) -> None:
        """Raise FieldError unless the head was trained on the hidden states of this very model."""
        if weights_digest(model.state_dict()) != self.config.world_model:
            raise FieldError(
                "reward.pretrained_path",
                self.config.pretrained_path,
                "this embedding reward was trained on the hidden states of another world model",
                "train it again on those of `world_model_path`",
            )

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss on LeRobot's windows (shapes as `clip_from_windows`), `next.reward` (B, T)."""
        clip = self.world_model.clip_from_batch(batch)
        hidden = self.world_model.predict(clip, with_tokens=False).hidden
        reward = recorded_rewards(batch).reshape(clip.valid.shape)
        in_order = take_steps(reward, unpadded_rows(~clip.valid))
        return regression_loss(self.head(hidden).squeeze(-1), in_order, clip.valid)

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Return the reward of hidden states `hidden` (B, D), else of the last frame of windows. → (B,)"""
        if "hidden" in batch:
            return self.head(batch["hidden"]).squeeze(-1)
        clip = self.world_model.clip_from_batch(batch)
        hidden = self.world_model.predict(clip, with_tokens=False).hidden
        return self.head(take_steps(hidden, clip.valid.sum(1, keepdim=True) - 1)[:, 0]).squeeze(-1)


def recorded_rewards(batch: dict[str, Any]) -> Tensor:
    """Return `next.reward` of a batch as float32. ValueError if the dataset has none, or NaN or infinity."""
    reward = batch.get(REWARD)
    if not isinstance(reward, Tensor):  # LeRobot's processors put a number where the dataset has none
        raise ValueError(
            f"{REWARD}: the dataset has none, and a learned reward is fitted to it; record a dataset with "
            "lerobot-wmrl-record, which writes the task's rule-based reward"
        )
    if not bool(torch.isfinite(reward).all()):
        raise ValueError(f"{REWARD}: contains NaN or infinity; remove such episodes from the dataset")
    return reward.float()


def regression_loss(predicted: Tensor, reward: Tensor, known: Tensor) -> tuple[Tensor, dict[str, float]]:
    """Return the mean squared error where `known`, and its root as a metric. All of one shape."""
    error = ((predicted - reward).square() * known).sum() / known.sum().clamp_min(1)
    return error, {"reward_error": error.sqrt().item()}

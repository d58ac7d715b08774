"""The two learned rewards as LeRobot reward models: trained by lerobot-train, asked by the environment."""

import hashlib
from typing import Any

import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from torch import Tensor, nn

from lerobot_wmrl.data.clip import take_rows
from lerobot_wmrl.data.compatibility import check_cameras, frame_size
from lerobot_wmrl.data.windows import unpadded_rows
from lerobot_wmrl.rewards.configuration_learned import EmbeddingConfig, ProxyConfig
from lerobot_wmrl.rewards.learned import recorded_rewards, regression
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.hub_card import HubCard
from lerobot_wmrl.world_models.modeling_frame_tokenizer import stack_cameras
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel


class ProxyRewardModel(HubCard, PreTrainedRewardModel):
    """The reward of a frame, by a convolutional network that knows nothing of the world model (DiWA)."""

    config_class = ProxyConfig
    name = "proxy"
    summary = "A reward that a convolutional network reads off camera frames, fitted to recorded rewards."

    def __init__(self, config: ProxyConfig, dataset_meta: Any = None, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: ProxyConfig = config
        if dataset_meta is not None:
            self._adopt_size(dataset_meta.features)
        if config.image_size < 8:
            raise ValueError(f"--reward_model.image_size={config.image_size}: must be at least 8")
        width, last, side = config.width, 2 * config.width, -(-config.image_size // 8)
        self.layers = nn.Sequential(
            nn.Conv2d(3 * len(config.cameras), width, 5, stride=2, padding=2), nn.ReLU(),
            nn.Conv2d(width, last, 3, stride=2, padding=1), nn.ReLU(),
            nn.Conv2d(last, last, 3, stride=2, padding=1), nn.ReLU(),
            nn.Flatten(), nn.Linear(last * side**2, config.hidden), nn.ReLU(), nn.Linear(config.hidden, 1),
        )  # fmt: skip

    def _adopt_size(self, features: dict[str, Any]) -> None:
        first = self.config.camera_keys[0]
        if not self.config.image_size and first in features:
            self.config.image_size = frame_size(features[first])[0]
        check_cameras(self.config, features)

    def check_world_model(self, model: ActionWorldModelRewardModel) -> None:
        """ValueError unless the model imagines such frames as the network was trained on."""
        size, cameras = model.config.image_size, model.config.cameras
        if self.config.image_size != size or not {*self.config.cameras} <= {*cameras}:
            raise ValueError(
                f"--env.reward.pretrained_path: this proxy reward looks at {', '.join(self.config.cameras)} "
                f"of {self.config.image_size} pixels, the world model imagines {', '.join(cameras)} of "
                f"{size}; train it again on frames like those, with --reward_model.cameras=[…]"
            )

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """On the frames that actions led to: images (B, 1, 3, H, W), `next.reward` (B,) or (B, 1)."""
        first = self.config.camera_keys[0]
        reward = recorded_rewards(batch).flatten()
        padded = batch.get(f"{first}_is_pad", torch.zeros_like(reward, dtype=torch.bool))
        return regression(self.compute_reward(batch), reward, ~padded.reshape(reward.shape))

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Of frames `observation.images.<camera>` (B, 3, H, W) or (B, 1, 3, H, W). → (B,)"""
        images = stack_cameras(batch, self.config.camera_keys, self.config.image_size)
        return self.layers(images.flatten(-4, -3).flatten(0, -4) - 0.5).squeeze(1)


class EmbeddingRewardModel(HubCard, PreTrainedRewardModel):
    """The reward of an imagined frame, by a head on the world model's hidden state (iVideoGPT).

    The world model is not part of the checkpoint; the head is of use beside that very one alone.
    """

    config_class = EmbeddingConfig
    name = "embedding"
    summary = "A reward that a head reads off a world model's hidden state, fitted to recorded rewards."

    def __init__(self, config: EmbeddingConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: EmbeddingConfig = config
        self._source: list[ActionWorldModelRewardModel] = []
        if not config.world_model:
            config.world_model, config.hidden_size = digest(self.source), self.source.config.width
        self.head = nn.Sequential(
            nn.LayerNorm(config.hidden_size), nn.Linear(config.hidden_size, config.hidden), nn.SiLU(),
            nn.Linear(config.hidden, 1),
        )  # fmt: skip

    @property
    def source(self) -> ActionWorldModelRewardModel:
        """The world model, loaded when it is first needed; in a list, so that it is no part of this one."""
        if not self._source:
            if not self.config.world_model_path:
                raise ValueError(
                    "--reward_model.world_model_path is missing: give the action world model whose hidden "
                    "states the reward is read off"
                )
            model = load_model(self.config.world_model_path, "action_world_model", self.config.device)
            self._source.append(model.requires_grad_(False))
        return self._source[0]

    def check_world_model(self, model: ActionWorldModelRewardModel) -> None:
        """ValueError unless the head was trained on the hidden states of this very model."""
        if digest(model) != self.config.world_model:
            raise ValueError(
                "--env.reward.pretrained_path: this embedding reward was trained on the hidden states of "
                "another world model; train it again with --reward_model.world_model_path=… of this one"
            )

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """On LeRobot's windows, of which `clip_from_windows` has the shapes, with `next.reward` (B, T)."""
        clip = self.source.clip_from_batch(batch)
        hidden = self.source.predict(clip, drawn=False).hidden
        reward = recorded_rewards(batch).reshape(clip.valid.shape)
        in_order = take_rows(reward, unpadded_rows(~clip.valid))
        return regression(self.head(hidden).squeeze(-1), in_order, clip.valid)

    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Of hidden states `hidden` (B, D), else of the last frame of LeRobot's windows. → (B,)"""
        if "hidden" in batch:
            return self.head(batch["hidden"]).squeeze(-1)
        clip = self.source.clip_from_batch(batch)
        hidden = self.source.predict(clip, drawn=False).hidden
        return self.head(take_rows(hidden, clip.valid.sum(1, keepdim=True) - 1)[:, 0]).squeeze(-1)


def digest(model: nn.Module) -> str:
    """Which weights these are."""
    found = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        found.update(name.encode())
        found.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return found.hexdigest()[:16]

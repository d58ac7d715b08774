"""Configurations of the rewards: the general one, and two that are learnt from recorded rewards.

LeRobot finds the classes by the names of this module and of its neighbours: `modeling_rewards`,
`processor_rewards`.
"""

from dataclasses import dataclass, field
from typing import Final

from lerobot.configs.rewards import RewardModelConfig
from lerobot.optim.optimizers import AdamWConfig

from lerobot_wmrl.common.errors import require_at_least, require_choice, require_positive
from lerobot_wmrl.common.images import camera_key
from lerobot_wmrl.rewards.general import DEFAULT_ALPHA, check_general_reward

LPIPS_BACKBONES: Final = {"lpips_alex": "alex", "lpips_vgg": "vgg"}
SIMILARITIES: Final = ("tokenizer", *LPIPS_BACKBONES, "mse")


@RewardModelConfig.register_subclass("general")
@dataclass
class GeneralConfig(RewardModelConfig):
    """The general reward (Algorithm 1): success, and similarity to an imagined goal frame.

    Args:
        alpha: weight α of the sparse part (success); the dense part (similarity) has 1 − α. By default 0.9,
            and 1 in a world model without a text world model, which imagines the goal frame.
        form: `potential` pays for getting closer to the goal frame, `absolute` (as published) for being
            close.
        gamma: discount of the potential form, which should be PPO's; by default PPO's default, and 1 for
            GRPO, which adds rewards up without one.
        similarity: measure of similarity to the goal frame: `tokenizer`, 1 − LPIPS's formula on the
            tokenizer's features; `lpips_alex` or `lpips_vgg`, 1 − LPIPS, whose backbone must be in torch's
            cache; `mse`, 1 − the mean squared error.
    """

    alpha: float | None = None
    form: str = "potential"
    gamma: float | None = None
    similarity: str = "tokenizer"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_general_reward(self)
        require_choice(self, "similarity", SIMILARITIES)

    @property
    def success_weight(self) -> float:
        """α, where none is given the default."""
        return DEFAULT_ALPHA if self.alpha is None else self.alpha

    @property
    def needs_goal(self) -> bool:
        """Whether there is a dense part, which needs goal frames."""
        return self.success_weight < 1


@dataclass
class LearnedRewardConfig(RewardModelConfig):
    """Settings that both learned rewards have. They are fitted to the dataset's `next.reward`.

    Args:
        hidden: width of the last hidden layer.
        learning_rate: learning rate of AdamW.
    """

    hidden: int = 128
    learning_rate: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(self, 1, "hidden")
        require_positive(self, "learning_rate")

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.learning_rate, weight_decay=1e-4, grad_clip_norm=1.0)


@RewardModelConfig.register_subclass("proxy")
@dataclass
class ProxyConfig(LearnedRewardConfig):
    """A convolutional network that predicts the reward from a frame (as in DiWA).

    Args:
        cameras: cameras whose frames the network sees.
        image_size: side in pixels of the squares to which frames are stretched; by default the height of the
            dataset's frames.
        width: channels of the first convolution.
    """

    cameras: list[str] = field(default_factory=lambda: ["third_view"])
    image_size: int = 0
    width: int = 32

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(self, 1, "width")

    @property
    def camera_keys(self) -> list[str]:
        """The cameras' keys in the dataset."""
        return [camera_key(camera) for camera in self.cameras]

    @property
    def observation_delta_indices(self) -> list[int]:
        """A row's reward is about the frame that its action leads to, the next one."""
        return [1]


@RewardModelConfig.register_subclass("embedding")
@dataclass
class EmbeddingConfig(LearnedRewardConfig):
    """A head that predicts the reward from the action world model's hidden state (as in iVideoGPT).

    Args:
        world_model_path: the trained action world model. Needed in training and to score windows of a
            dataset; an environment gives its own hidden states.
        world_model: digest of that world model's weights. hidden_size, clip_length: its sizes. All three are
            read from its checkpoint.
    """

    world_model_path: str | None = None
    world_model: str = ""
    hidden_size: int = 0
    clip_length: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.world_model_path and not self.clip_length:
            from lerobot_wmrl.world_models.checkpoint import read_config

            model = read_config(self.world_model_path, "action_world_model")
            self.clip_length = model.clip_length

    @property
    def observation_delta_indices(self) -> list[int]:
        return list(range(1 - self.clip_length, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        return self.observation_delta_indices

    @property
    def reward_delta_indices(self) -> list[int]:
        return self.observation_delta_indices

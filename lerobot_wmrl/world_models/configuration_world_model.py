"""Configurations of the action-conditioned and the text-conditioned world model, and of their dynamics."""

from dataclasses import dataclass, field
from typing import ClassVar

from draccus import ChoiceRegistry
from lerobot.configs.rewards import RewardModelConfig
from lerobot.optim.optimizers import AdamWConfig
from lerobot.optim.schedulers import LRSchedulerConfig
from lerobot.utils.constants import OBS_STATE

from lerobot_wmrl.common.errors import FieldError, require_at_least, require_share, within
from lerobot_wmrl.data.embodiment import Embodiment
from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig


@dataclass
class DynamicsConfig(ChoiceRegistry):
    """How frames follow each other: `anchored` or `autoregressive`.

    Args:
        layers: blocks of the transformer.
        width: channels of the transformer.
        heads: attention heads of a block.
        patch: side of the square of tokens that forms one transformer token.
        code_width: channels of the convolutions on the token grid.
    """

    layers: int = 4
    width: int = 128
    heads: int = 4
    patch: int = 2
    code_width: int = 48
    uses_context: ClassVar[bool] = False
    """Whether it looks at the tokenizer's context."""
    predicts_success: ClassVar[bool] = False
    """Whether it predicts the features of the tokenizer's success classifier."""

    def __post_init__(self) -> None:
        with within("dynamics"):
            require_at_least(self, 1, "layers", "width", "heads", "patch", "code_width")
        if self.width % (2 * self.heads):
            raise FieldError("dynamics.width", self.width, "must be a multiple of 2 x `dynamics.heads`")

    @property
    def looks_at_depth(self) -> bool:
        """Whether it predicts from depth too, and predicts it."""
        return False

    @classmethod
    def default_choice_name(cls) -> str:
        """Choose what a configuration without `type` means."""
        return "anchored"

    @property
    def type(self) -> str:
        """The name by which `dynamics.type` chooses this kind."""
        return self.get_choice_name(type(self))


@DynamicsConfig.register_subclass("anchored")
@dataclass
class AnchoredConfig(DynamicsConfig):
    """Predicts from the episode's first frame and the actions since, so errors in pictures do not add up.

    An imagination as long as a training clip (`clip_length`) takes its last frame as a new first frame.

    Args:
        dropout: dropout rate on the residual branches of the trajectory, against overfitting.
    """

    dropout: float = 0.0
    uses_context: ClassVar[bool] = True
    predicts_success: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.dropout < 1:
            raise FieldError("dynamics.dropout", self.dropout, "must be a share, from 0 to below 1")


@dataclass
class WorldModelConfig(RewardModelConfig):
    """What both world models share.

    Args:
        tokenizer_path: frame tokenizer checkpoint to start from; a trained world model carries its own copy.
        tokenizer: that tokenizer's settings, filled in from its checkpoint.
        state_size: width of `observation.state`, 0 to do without it; filled in from the dataset.
        dynamics: network that predicts frames, `dynamics.type=anchored` or `autoregressive`.
        clip_length: frames in a training clip. Success is learnt only up to this many frames after a start,
            so set it to the length of the episodes that will be imagined.
        from_start: share of training clips that begin with their episode; the others begin anywhere in it.
        learning_rate: peak learning rate; constant in lerobot-train.
    """

    tokenizer_path: str | None = None
    tokenizer: TokenizerConfig | None = None
    state_size: int = 8
    dynamics: DynamicsConfig = field(default_factory=AnchoredConfig)
    clip_length: int = 28
    from_start: float = 0.75
    learning_rate: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(self, 2, "clip_length")
        require_at_least(self, 0, "state_size")
        require_share(self, "from_start")

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.learning_rate, weight_decay=1e-2, grad_clip_norm=1.0)

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        return None

    @property
    def trained_tokenizer(self) -> TokenizerConfig:
        """The tokenizer's settings, which every trained world model has."""
        assert self.tokenizer is not None, "filled in before the training"
        return self.tokenizer

    @property
    def depth(self) -> bool:
        """Whether the dynamics look at depth."""
        return self.dynamics.looks_at_depth

    @property
    def context_channels(self) -> int:
        """Channels of the tokenizer's context, as far as the dynamics look at it; 0 if they do not."""
        if self.tokenizer is None or not self.tokenizer.context:
            return 0
        return self.tokenizer.widths[-1] if self.dynamics.uses_context else 0

    @property
    def predicts_success(self) -> bool:
        """Whether the dynamics predict the features of the tokenizer's success classifier."""
        return self.tokenizer is not None and self.tokenizer.success and self.dynamics.predicts_success

    @property
    def reads_instructions(self) -> bool:
        """Whether success depends on the instruction."""
        return self.predicts_success and bool(self.trained_tokenizer.instructions)

    @property
    def observation_delta_indices(self) -> list[int]:
        return list(range(1 - self.clip_length, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        """One action more than frames: where it is padding, the window begins with its episode."""
        return list(range(-self.clip_length, 1))


@RewardModelConfig.register_subclass("action_world_model")
@dataclass
class ActionWorldModelConfig(WorldModelConfig):
    """Predicts the next frame, the robot's state and success from an action (RoboScape-R, eq. 1 with c = a).

    Args:
        action_size: width of `action`, filled in from the dataset.
        embodiment: names, ranges and frame rate, filled in from the dataset; imagined episodes keep to them.
        learnt_successes: successful episodes that it has learnt from, filled in from the datasets.
        learnt_failures: failed ones; episodes of which nobody knows the outcome are neither.
    """

    action_size: int = 7
    embodiment: Embodiment = field(default_factory=Embodiment)
    learnt_successes: int | None = None
    learnt_failures: int | None = None

    @property
    def observation_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of what a policy sees in imagination: images (3, H, W), and the state (P,) if it is
        predicted."""
        state = {OBS_STATE: (self.state_size,)} if self.state_size else {}
        return {**self.trained_tokenizer.frame_shapes, **state}


@RewardModelConfig.register_subclass("text_world_model")
@dataclass
class TextWorldModelConfig(WorldModelConfig):
    """Imagines a successful trajectory of an instruction (eq. 1 with c = i). Learns from successful
    demonstrations, or from all successes of a dataset that does not say who acted.

    Args:
        text_encoder: id or folder of a pretrained T5 (T5, flan-T5, ByT5, mT5, umT5) that reads the
            instruction, frozen. A trained checkpoint carries it in its own folder `text_encoder`. None: a
            small T5 over ByT5's bytes, trained along.
        goal_horizon: frames imagined in search of the goal frame.
    """

    text_encoder: str | None = None
    goal_horizon: int = 40

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(self, 1, "goal_horizon")


for _kind in (ActionWorldModelConfig, TextWorldModelConfig):  # --help shows a class's own docstring alone
    _kind.__doc__ = f"{_kind.__doc__}\n    {WorldModelConfig.__doc__}"

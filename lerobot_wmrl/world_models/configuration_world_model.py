"""Configurations of the action-conditioned and the text-conditioned world model."""

from dataclasses import dataclass
from typing import Final

from lerobot.configs.rewards import RewardModelConfig
from lerobot.optim.optimizers import AdamWConfig
from lerobot.optim.schedulers import LRSchedulerConfig

from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig

AUTOREGRESSIVE_ONLY: Final = {
    "decoding": "shifted", "depth": False, "self_rollout": 0.0, "keypoint_weight": 0.0,
}  # fmt: skip
"""Options that anchored dynamics do not have, and their defaults; `conditioning` is one more."""


@dataclass
class WorldModelConfig(RewardModelConfig):
    """What both world models share.

    Args:
        tokenizer_path: frame tokenizer checkpoint to start from; a trained world model carries its own copy.
        tokenizer: that tokenizer's settings, filled in from its checkpoint.
        state_size: width of `observation.state`, 0 to do without proprioception; filled in from the dataset.
        dynamics: what a frame is predicted from: `autoregressive`, the frame before it (eq. 1); `anchored`,
            the episode's first frame and what was done since, so that errors in pictures do not add up.
        layers, width, heads: of the spatial-temporal transformer.
        window: frames the model remembers; with anchored dynamics `clip_length` says that.
        clip_length: frames of a training clip. Success is learnt only that far from an episode's start, so
            give it the number of frames that episodes are imagined for.
        from_start: share of training clips that begin with their episode; the others begin anywhere in it.
        patch: side of the square of tokens that forms one transformer token.
        code_width: channels of the convolutions on the token grid.
        conditioning: how blocks take in the condition: cross_attention (the paper's), adaln or additive.
        decoding: how a frame's tokens come about: shifted (all drawn in one pass) or maskgit (in
            `maskgit_steps` passes, the most confident first). maskgit takes a second pass in training too.
        maskgit_steps: passes a frame of maskgit; 1 is as fast as shifted, and decodes the same way.
        depth: see and predict each camera's depth beside its tokens (RoboScape's depth branch). The dataset
            must have `observation.images.<camera>_depth`, which `lerobot-wmrl-record --depth=true` writes.
        dropout: share of what each layer adds to the trajectory of anchored dynamics that training leaves
            out, so that episodes are not learnt by heart.
        motion_weight: how much more a token counts in the loss when it moves. A high weight makes the model
            believe in motion: it then pushes objects that the hand misses.
        done_weight, done_positive_weight, state_weight, depth_weight: of the losses beside the tokens' one.
        drawn_frames: of each clip that anchored dynamics draw in a training step, at random; done and state
            are learnt from all of them.
        self_forcing: share of input frames replaced by the model's own predictions in training
            (autoregressive).
        self_rollout: share of clips that in the last quarter of training show what the model itself makes of
            their first frame and actions, instead of the real frames; what it has to predict stays real.
        keypoint_weight: of RoboScape's keypoint consistency: the tokens that move most should look, wherever
            they get to, as at the clip's start. 0: off.
        token_noise: share of input code factors moved by one step in training: a level of FSQ, a sign of LFQ.
        temperature: of sampling in imagination; 0 takes the most likely code.
    """

    tokenizer_path: str | None = None
    tokenizer: TokenizerConfig | None = None
    state_size: int = 8

    dynamics: str = "autoregressive"
    layers: int = 4
    width: int = 128
    heads: int = 4
    window: int = 48
    clip_length: int = 28
    from_start: float = 0.75
    patch: int = 2
    code_width: int = 48
    conditioning: str = "cross_attention"
    decoding: str = "shifted"
    maskgit_steps: int = 4
    depth: bool = False

    motion_weight: float = 1.0
    done_weight: float = 1.0
    done_positive_weight: float = 1.0
    state_weight: float = 4.0
    depth_weight: float = 1.0
    drawn_frames: int = 4
    dropout: float = 0.0
    self_forcing: float = 0.5
    self_rollout: float = 0.0
    keypoint_weight: float = 0.0
    token_noise: float = 0.02
    temperature: float = 0.0
    learning_rate: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (
            "layers", "width", "heads", "window", "patch", "code_width", "maskgit_steps", "drawn_frames",
        ):  # fmt: skip
            if getattr(self, name) < 1:
                raise ValueError(f"--model.{name}={getattr(self, name)}: must be at least 1")
        if not 0 <= self.self_rollout <= 1:
            raise ValueError(
                f"--model.self_rollout={self.self_rollout}: must be a share of the clips, between 0 and 1"
            )
        if not 0 <= self.from_start <= 1:
            raise ValueError(
                f"--model.from_start={self.from_start}: must be a share of the clips, between 0 and 1"
            )
        if not 0 <= self.dropout < 1:
            raise ValueError(f"--model.dropout={self.dropout}: must be a share, from 0 to below 1")
        if self.keypoint_weight < 0:
            raise ValueError(
                f"--model.keypoint_weight={self.keypoint_weight}: must be 0 (off) or a positive weight"
            )
        if self.clip_length < 2:
            raise ValueError(
                f"--model.clip_length={self.clip_length}: must be at least 2, a frame and its next"
            )
        if self.width % (2 * self.heads):
            raise ValueError(
                f"--model.width={self.width}: must be a multiple of 2 x --model.heads={self.heads}"
            )
        if self.dynamics == "anchored":
            self._check_anchored()
        if self.state_size < 0:
            raise ValueError(
                f"--model.state_size={self.state_size}: must be 0 (none) or the width of the state"
            )

    def _check_anchored(self) -> None:
        """ValueError if something is asked for that only predictions from the frame before have."""
        allowed: dict[str, tuple[object, ...]] = {name: (off,) for name, off in AUTOREGRESSIVE_ONLY.items()}
        allowed["conditioning"] = (type(self).conditioning, WorldModelConfig.conditioning)
        for name, values in allowed.items():
            if (value := getattr(self, name)) not in values:
                raise ValueError(
                    f"--model.{name}={value}: anchored dynamics do not have it; leave it out, or choose "
                    "--model.dynamics=autoregressive"
                )

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=self.learning_rate, weight_decay=1e-2, grad_clip_norm=1.0)

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        return None

    @property
    def memory(self) -> int:
        """Frames that imagination remembers at most."""
        return self.clip_length if self.dynamics == "anchored" else self.window

    @property
    def context_channels(self) -> int:
        """Of the tokenizer's context, as far as the dynamics look at it; 0 if they do not."""
        if self.tokenizer is None or not self.tokenizer.context or self.dynamics != "anchored":
            return 0
        return self.tokenizer.widths[-1]

    @property
    def observation_delta_indices(self) -> list[int]:
        return list(range(1 - self.clip_length, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(1 - self.clip_length, 1))


@RewardModelConfig.register_subclass("action_world_model")
@dataclass
class ActionWorldModelConfig(WorldModelConfig):
    """Predicts the next frame, the robot's state and success from an action (RoboScape-R, eq. 1 with c = a).

    Args:
        dynamics, conditioning: as of both models, but `anchored` and `adaln` by default.
        action_size: width of `action`, filled in from the dataset.
        condition_tokens: tokens the action is embedded into for cross-attention.
    """

    dynamics: str = "anchored"
    conditioning: str = "adaln"
    action_size: int = 7
    condition_tokens: int = 4


@RewardModelConfig.register_subclass("text_world_model")
@dataclass
class TextWorldModelConfig(WorldModelConfig):
    """Imagines the golden trajectory of an instruction (eq. 1 with c = i). Learns from optimal successes.

    Args:
        text_encoder: id or folder of a pretrained T5 (T5, flan-T5, ByT5, mT5, umT5) that reads the
            instruction, frozen. A trained checkpoint carries it in its own folder `text_encoder`. None: a
            small T5 over ByT5's bytes, trained along.
        goal_threshold: θ of eq. 6, the done probability at which a frame becomes the goal frame.
        goal_horizon: frames imagined in search of it.
    """

    text_encoder: str | None = None
    goal_threshold: float = 0.5
    goal_horizon: int = 40

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.goal_threshold < 1:
            raise ValueError(
                f"--model.goal_threshold={self.goal_threshold}: must be a probability between 0 and 1"
            )
        if self.goal_horizon < 1:
            raise ValueError(f"--model.goal_horizon={self.goal_horizon}: must be at least 1 frame")


for _kind in (ActionWorldModelConfig, TextWorldModelConfig):  # --help shows a class's own docstring alone
    _kind.__doc__ = f"{_kind.__doc__}\n    {WorldModelConfig.__doc__}"

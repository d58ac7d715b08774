"""Configuration of the autoregressive dynamics, `dynamics.type=autoregressive`."""

from dataclasses import dataclass
from typing import Final

from lerobot_wmrl.common.errors import require_at_least, require_choice, require_share, within
from lerobot_wmrl.world_models.configuration_world_model import DynamicsConfig

CONDITIONINGS: Final = ("adaln", "cross_attention", "additive")


@DynamicsConfig.register_subclass("autoregressive")
@dataclass
class AutoregressiveConfig(DynamicsConfig):
    """Predicts from the frames before (eq. 1, as the paper does). In imagination these are its own.

    Args:
        window: frames that the model remembers.
        conditioning: how blocks take in the condition: adaln, cross_attention (the paper's) or additive.
        maskgit_steps: passes in which a frame's tokens are decoded, the most confident first (MaskGIT; takes
            a second pass in training too). 0: all tokens in the pass that predicts the frame.
        depth: take in and predict each camera's depth beside its tokens (RoboScape's depth branch). The
            dataset must have `observation.images.<camera>_depth`.
        self_forcing: share of input frames that training replaces by the model's one-pass predictions of them
            (scheduled sampling, Mihaylova & Martins 2019), from half time on.
        self_rollout: share of clips whose input frames, in the last quarter of training, are the model's own
            imagination from the first frame and the actions. The targets stay the recorded frames. With
            lerobot-train, which does not say how far it is, these two act from the first step.
        keypoint_weight: weight of RoboScape's keypoint consistency: the tokens that move most keep the
            appearance that they have at the clip's start. 0: off.
    """

    window: int = 48
    conditioning: str = "adaln"
    maskgit_steps: int = 0
    depth: bool = False
    self_forcing: float = 0.5
    self_rollout: float = 0.0
    keypoint_weight: float = 0.0

    @property
    def looks_at_depth(self) -> bool:
        return self.depth

    def __post_init__(self) -> None:
        super().__post_init__()
        with within("dynamics"):
            require_choice(self, "conditioning", CONDITIONINGS)
            require_at_least(self, 1, "window")
            require_at_least(self, 0, "maskgit_steps", "keypoint_weight")
            require_share(self, "self_forcing", "self_rollout")

"""Configuration of the small image policy, `--policy.type=cnn`."""

from dataclasses import dataclass, field
from typing import Final

from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policy_configuration import ClonedConfig

MIN_STD: Final = 0.05
MAX_STD: Final = 1.0
"""Bounds of the Gaussian's standard deviation, in normalised actions."""


@PreTrainedConfig.register_subclass("cnn")
@dataclass
class CnnConfig(ClonedConfig):
    """A policy that maps images, `observation.state` and the instruction to one action.

    Args:
        use_state: whether to use `observation.state` when the dataset has it.
        width: channels of the first convolution; later ones have twice as many.
        hidden_size: width of the MLPs behind the encoders.
        max_shift: pixels by which images are shifted at random in supervised training; 0 for not at all.
        initial_std: standard deviation of the Gaussian before any training, in normalised actions.
    """

    use_state: bool = True
    width: int = 16
    hidden_size: int = 256
    max_shift: int = 2
    initial_std: float = 0.5
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_std(self.initial_std)

    @property
    def state_feature(self) -> PolicyFeature | None:
        """`observation.state` if the policy uses it."""
        return (self.input_features or {}).get(OBS_STATE) if self.use_state else None

    def validate_features(self) -> None:
        """Raise FieldError unless there is a one-dimensional action, and an image or a state.

        Depth maps (images of one channel), which environments do not show, and a state that is not used are
        left out.
        """
        inputs = self.input_features or {}
        unused = [key for key, feature in inputs.items() if _is_depth(feature)]
        for key in unused if self.use_state else [*unused, *({OBS_STATE} & inputs.keys())]:
            del inputs[key]
        action = self.action_feature
        if action is None or len(action.shape) != 1:
            raise FieldError("output_features", self.output_features, f"needs {ACTION} with one dimension")
        if not self.image_features and self.state_feature is None:
            raise FieldError("input_features", self.input_features, f"needs an image or {OBS_STATE}")
        for key, feature in self.image_features.items():
            if feature.type is FeatureType.VISUAL and (len(feature.shape) != 3 or feature.shape[0] != 3):
                raise FieldError(f"input_features[{key}].shape", feature.shape, "needs (3, height, width)")


def check_std(std: float) -> None:
    """Raise FieldError unless a standard deviation lies within its bounds."""
    if not MIN_STD <= std <= MAX_STD:
        raise FieldError("initial_std", std, f"must be between {MIN_STD} and {MAX_STD}")


def _is_depth(feature: PolicyFeature) -> bool:
    return feature.type is FeatureType.VISUAL and len(feature.shape) == 3 and feature.shape[0] == 1

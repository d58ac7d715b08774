"""Configuration of the small image policy, `--policy.type=cnn`."""

from dataclasses import dataclass, field

from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_wmrl.common.policy_configuration import ClonedConfig


@PreTrainedConfig.register_subclass("cnn")
@dataclass
class CnnConfig(ClonedConfig):
    """One action from one observation: images, `observation.state` if there is one, and the instruction.

    Args:
        use_state: feed `observation.state` when the dataset has it.
        width: channels of the first convolution; the others have twice as many.
        value_width: the same for the value's own, smaller encoder.
        hidden_size: of the MLPs behind the encoders.
        language_buckets, language_size: hashed character n-grams, and the embedding made of them.
        max_shift: pixels by which images are shifted at random during cloning (0 = not at all).
        initial_std, min_std, max_std: standard deviation of the Gaussian, in normalised actions: before
            any training, and its bounds at all times.
        std_lr_factor: learning rate of the standard deviation relative to the rest, during cloning.
        min_state_std, min_action_std: floors of the dataset's standard deviations, in the dataset's units,
            so that a component that hardly varies is not blown up by normalisation.
    """

    use_state: bool = True
    width: int = 16
    value_width: int = 8
    hidden_size: int = 256
    language_buckets: int = 256
    language_size: int = 32
    max_shift: int = 2
    initial_std: float = 0.5
    min_std: float = 0.05
    max_std: float = 1.0
    std_lr_factor: float = 20.0
    min_state_std: float = 1e-2
    min_action_std: float = 1e-4
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.min_std <= self.initial_std <= self.max_std:
            raise ValueError(
                f"initial_std={self.initial_std}: must lie between min_std={self.min_std} (above 0) "
                f"and max_std={self.max_std}"
            )

    @property
    def state_feature(self) -> PolicyFeature | None:
        """`observation.state` if the policy is fed with it."""
        return (self.input_features or {}).get(OBS_STATE) if self.use_state else None

    def validate_features(self) -> None:
        """ValueError unless there is a one-dimensional action and something to look at.

        Depth maps, pictures of one channel, are left out: environments do not show them.
        """
        inputs = self.input_features or {}
        for key in [key for key, feature in inputs.items() if _is_depth(feature)]:
            del inputs[key]
        action = self.action_feature
        if action is None or len(action.shape) != 1:
            raise ValueError(f"output_features={self.output_features}: needs `{ACTION}` with one dimension")
        if not self.image_features and self.state_feature is None:
            raise ValueError(f"input_features={self.input_features}: needs an image or `{OBS_STATE}`")
        for key, feature in self.image_features.items():
            if feature.type is FeatureType.VISUAL and (len(feature.shape) != 3 or feature.shape[0] != 3):
                raise ValueError(f"input_features[{key}].shape={feature.shape}: needs (3, height, width)")


def _is_depth(feature: PolicyFeature) -> bool:
    return feature.type is FeatureType.VISUAL and len(feature.shape) == 3 and feature.shape[0] == 1

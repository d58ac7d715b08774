"""Configuration of OpenVLA, `--policy.type=openvla`."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.utils.constants import ACTION

from lerobot_policy_openvla.sizes import Sizes
from lerobot_wmrl.common.errors import FieldError, require_choice
from lerobot_wmrl.common.policy_configuration import ClonedConfig

DTYPES = ("auto", "float32", "bfloat16")


@PreTrainedConfig.register_subclass("openvla")
@dataclass
class OpenVLAConfig(ClonedConfig):
    """OpenVLA: one action, as tokens, from one image and the instruction.

    A checkpoint of OpenVLA brings its sizes and statistics along (`lerobot-wmrl-convert-openvla`). Without
    one, a model of `sizes` starts from random weights.

    Args:
        sizes: sizes of the vision transformers, the projector and the Llama.
        camera: full name of the camera it sees, such as `observation.images.third_view`; needed only where
            there are several.
        unnorm_key: the dataset whose statistics turn normalised actions into the robot's; set by the import
            and by fine-tuning, together with the processors.
        norm_stats: 1st and 99th percentile and mask of the actions of every dataset it knows.
        dtype: number format of the network. `auto` is bfloat16 for a checkpoint on a GPU that multiplies in
            it, else float32. Adapters and the value head stay in float32; bfloat16 weights cannot be trained.
        temperature: divides the logits in sampling, and in the log-probabilities of samples.
        sampling: act by drawn tokens, as in reinforcement learning; else by the likeliest, as OpenVLA does.
        value_sizes: widths of the value head's hidden layers (those of RL4VLA, Liu et al. 2025).
        gradient_checkpointing: recompute activations instead of keeping them: less memory, a third more time.
    """

    sizes: Sizes = field(default_factory=Sizes)
    camera: str | None = None
    unnorm_key: str | None = None
    norm_stats: dict[str, Any] = field(default_factory=dict)
    dtype: str = "auto"
    temperature: float = 1.0
    sampling: bool = False
    value_sizes: list[int] = field(default_factory=lambda: [512, 128])
    gradient_checkpointing: bool = False
    optimizer_lr: float = 5e-4
    optimizer_weight_decay: float = 0.0
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.QUANTILES,
        }
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice(self, "dtype", DTYPES)
        if self.temperature <= 0:
            raise FieldError("temperature", self.temperature, "must be above 0")

    @property
    def action_size(self) -> int:
        """Number of action tokens per step. Raises FieldError while their statistics are not known."""
        undecided = self.unnorm_key is None and bool(self.norm_stats)
        if self.action_feature is None or undecided:
            known = ", ".join(sorted(self.norm_stats)) or "none"
            raise FieldError(
                "unnorm_key",
                self.unnorm_key,
                f"the policy must know whose statistics turn tokens into actions, one of: {known}",
                "import the checkpoint with that `unnorm_key`, or fine-tune it on a dataset",
            )
        return self.action_feature.shape[0]

    def validate_features(self) -> None:
        """Keep the one camera that the policy sees. Raises FieldError if there are several and none is named.

        Depth maps (images of one channel) and the state are left out: OpenVLA does not see them.
        """
        cameras = {key: feature for key, feature in self.image_features.items() if feature.shape[0] == 3}
        names = ", ".join(sorted(cameras)) or "none"
        if self.camera is not None and cameras and self.camera not in cameras:
            raise FieldError("camera", self.camera, f"no such camera; choose one of {names}")
        if self.camera is None and len(cameras) > 1:
            problem = f"the policy sees one of several cameras, name it: {names}"
            raise FieldError("camera", None, problem)
        inputs = self.input_features or {}
        if inputs and not cameras:
            raise FieldError("input_features", sorted(inputs), "needs a camera")
        for key in [key for key in inputs if key not in cameras or self.camera not in (None, key)]:
            del inputs[key]
        self._validate_action()

    def _validate_action(self) -> None:
        action: PolicyFeature | None = self.action_feature
        if action is not None and (action.type is not FeatureType.ACTION or len(action.shape) != 1):
            raise FieldError("output_features", self.output_features, f"needs {ACTION} with one dimension")

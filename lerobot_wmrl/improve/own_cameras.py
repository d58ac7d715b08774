"""Policies that were fine-tuned from a base with other cameras, as policies of the dataset's cameras.

`lerobot-train --policy.path=lerobot/smolvla_base --rename_map=…` leaves a checkpoint that looks at `camera1`
in 256x256, whatever the dataset's camera is called and however large its frames are: its preprocessor renames
the camera, and the policy resizes what it sees. It keeps the base's other cameras, too. Everything else here
goes by the dataset's names and sizes.
"""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any, Final

from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.processor import NormalizerProcessorStep, RenameObservationsProcessorStep

from lerobot_wmrl.data.checks import frame_size

RESIZING: Final = ("smolvla", "pi0", "pi05", "pi0_fast")
"""Types of policies that resize frames of any size, pad the state, do not normalise frames, and leave out or
mask cameras that are not there."""


def with_own_cameras(
    policy: PreTrainedConfig, preprocessor: Any, columns: Mapping[str, Mapping[str, Any]]
) -> PreTrainedConfig:
    """Return the configuration of such a policy with the names and sizes of a dataset's columns.

    It is the same object where these are its own, and for policies of other types.

    Args:
        policy: the policy's configuration.
        preprocessor: its preprocessor, which may rename columns, and has statistics of its training's data.
        columns: the dataset's features, by name.
    """
    if policy.type not in RESIZING:
        return policy
    renames, known = given_names(preprocessor), trained_on(preprocessor)
    inputs: dict[str, PolicyFeature] = {}
    for name, feature in (policy.input_features or {}).items():
        source = renames.get(name, name)
        column = source if source in columns and name not in columns else name
        if column in columns:
            is_image = feature.type is FeatureType.VISUAL
            size = (3, *frame_size(columns[column])) if is_image else tuple(columns[column]["shape"])
            if is_image or known.get(column) == size:
                feature = replace(feature, shape=size)
        elif feature.type is FeatureType.VISUAL and not {name, source} & known.keys():
            continue  # a camera of the base, which the policy has not been trained with
        inputs[column] = feature
    if inputs == policy.input_features:
        return policy
    changed: Any = deepcopy(policy)
    changed.input_features, changed.empty_cameras = inputs, 0
    return changed


def without_renaming(preprocessor: Any, policy: PreTrainedConfig) -> Any:
    """Return a preprocessor that renames nothing, for a policy that `with_own_cameras` has made."""

    def adapt(step: Any) -> Any:
        if isinstance(step, RenameObservationsProcessorStep):
            return replace(step, rename_map={})
        if not isinstance(step, NormalizerProcessorStep):
            return step
        # statistics that were given would stay as they are: they are loaded instead
        made = replace(step, features={**(policy.input_features or {}), **policy.output_features}, stats=None)
        made.load_state_dict(step.state_dict())
        return made

    return replace(preprocessor, steps=[adapt(step) for step in preprocessor.steps])


def given_names(preprocessor: Any) -> dict[str, str]:
    """Return the columns that a preprocessor makes by renaming, and what they were called before."""
    steps = (step for step in preprocessor.steps if isinstance(step, RenameObservationsProcessorStep))
    return {renamed: name for step in steps for name, renamed in step.rename_map.items()}


def trained_on(preprocessor: Any) -> dict[str, tuple[int, ...]]:
    """Return the columns of the data that a policy was trained on, with the shapes of their means."""
    steps = (step for step in preprocessor.steps if isinstance(step, NormalizerProcessorStep))
    return {
        key.removesuffix(".mean"): tuple(value.shape)
        for step in steps
        for key, value in step.state_dict().items()
        if key.endswith(".mean")
    }

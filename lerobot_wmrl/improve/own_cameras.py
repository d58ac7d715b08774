"""Policies whose cameras have other names or sizes than the dataset's, as policies of the dataset's cameras.

`lerobot-train --policy.path=lerobot/smolvla_base --rename_map=…` leaves a checkpoint that looks at `camera1`
in 256x256, whatever the dataset's camera is called and however large its frames are: its preprocessor renames
the camera, and the policy resizes what it sees. Everything else here goes by the dataset's names and sizes.
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
"""Types of policies that resize frames of any size, and mask the cameras that they keep free for others."""

EMPTY: Final = ".empty_camera_"
"""In the names of those cameras."""


def with_own_cameras(
    policy: PreTrainedConfig, preprocessor: Any, columns: Mapping[str, Mapping[str, Any]]
) -> PreTrainedConfig:
    """Return a policy's configuration with the names and frame sizes of a dataset's columns.

    It is the same object where these are its own.

    Args:
        policy: the policy's configuration.
        preprocessor: its preprocessor, which may rename columns.
        columns: the dataset's features, by name.
    """
    given = {
        renamed: name
        for name, renamed in renames(preprocessor).items()
        if name in columns and renamed not in columns
    }
    inputs: dict[str, PolicyFeature] = {}
    for name, feature in (policy.input_features or {}).items():
        own, resizes = given.get(name, name), policy.type in RESIZING
        if resizes and EMPTY in name:
            continue
        if resizes and feature.type is FeatureType.VISUAL and own in columns:
            feature = replace(feature, shape=(3, *frame_size(columns[own])))
        inputs[own] = feature
    if inputs == (policy.input_features or {}):
        return policy
    changed: Any = deepcopy(policy)
    changed.input_features = inputs
    if policy.type in RESIZING:
        changed.empty_cameras = 0
    return changed


def without_renaming(preprocessor: Any, policy: PreTrainedConfig) -> Any:
    """Return a preprocessor for the columns of `policy`, which `with_own_cameras` has made.

    It renames nothing, and normalises by the statistics of the renamed columns under their own names.
    """
    given = {
        renamed: name
        for name, renamed in renames(preprocessor).items()
        if name in (policy.input_features or {})
    }

    def own(step: Any) -> Any:
        if isinstance(step, RenameObservationsProcessorStep):
            return replace(step, rename_map={})
        if not isinstance(step, NormalizerProcessorStep):
            return step
        features = {given.get(name, name): each for name, each in step.features.items()}
        made = replace(step, features=features, stats=None)  # statistics that are given would stay
        state = {}
        for key, value in step.state_dict().items():
            name, _, statistic = key.rpartition(".")
            state[f"{given.get(name, name)}.{statistic}"] = value
        made.load_state_dict(state)
        return made

    return replace(preprocessor, steps=[own(step) for step in preprocessor.steps])


def renames(preprocessor: Any) -> dict[str, str]:
    """Return the columns that a preprocessor renames, and what it calls them."""
    steps = (step for step in preprocessor.steps if isinstance(step, RenameObservationsProcessorStep))
    return {name: renamed for step in steps for name, renamed in step.rename_map.items()}

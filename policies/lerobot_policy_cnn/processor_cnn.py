"""Pre- and postprocessor of the small image policy: LeRobot's own, with bounded statistics."""

from typing import Any, Final

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_policy_cnn.configuration_cnn import CnnConfig

Statistics = dict[str, dict[str, Tensor]]

MIN_DATASET_STD: Final = {OBS_STATE: 1e-2, ACTION: 1e-4}
"""Smallest standard deviations to normalise by, in the dataset's units."""


def bounded_statistics(statistics: Statistics) -> Statistics:
    """Return the statistics with standard deviations of at least MIN_DATASET_STD.

    LeRobot divides by std + 1e-8, which turns a rounding error in a constant component into 10 normalised
    units.
    """
    bounded = {}
    for key, values in statistics.items():
        bounded[key] = dict(values)
        if key in MIN_DATASET_STD and "std" in values:
            std = torch.as_tensor(values["std"], dtype=torch.float32)
            bounded[key]["std"] = std.clamp_min(MIN_DATASET_STD[key])
    return bounded


def make_cnn_pre_post_processors(
    config: CnnConfig, dataset_stats: Statistics | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Return processors that normalise state and action by mean and std; images stay in [0, 1]."""
    bounded = bounded_statistics(dataset_stats) if dataset_stats else dataset_stats
    return make_default_pre_post_processors(config, bounded, normalizer_device=config.device)

"""Pre- and postprocessor of the small image policy: LeRobot's own, on bounded statistics."""

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_policy_cnn.configuration_cnn import CnnConfig

Statistics = dict[str, dict[str, Tensor]]


def bounded_statistics(statistics: Statistics, config: CnnConfig) -> Statistics:
    """Raise standard deviations to their floors: LeRobot divides by std + 1e-8, which makes 10 normalised
    units of a rounding error in a constant component."""
    floors = {OBS_STATE: config.min_state_std, ACTION: config.min_action_std}
    bounded = {}
    for key, values in statistics.items():
        bounded[key] = dict(values)
        if key in floors and "std" in values:
            bounded[key]["std"] = torch.as_tensor(values["std"], dtype=torch.float32).clamp_min(floors[key])
    return bounded


def make_cnn_pre_post_processors(
    config: CnnConfig, dataset_stats: Statistics | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Normalise state and action by mean and std; images stay in [0, 1]."""
    bounded = bounded_statistics(dataset_stats, config) if dataset_stats else dataset_stats
    return make_default_pre_post_processors(config, bounded, normalizer_device=config.device)

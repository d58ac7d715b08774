"""Pre- and postprocessor of the planning policy: LeRobot's own. Images stay in [0, 1], actions in the units
of the dataset."""

from typing import Any

from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_policy_wm_mpc.configuration_wm_mpc import WmMpcConfig


def make_wm_mpc_pre_post_processors(
    config: WmMpcConfig, dataset_stats: Any = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Return processors that normalise nothing: the world model has its own statistics."""
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)

"""Pre- and postprocessor of OpenVLA: LeRobot's own with OpenVLA's statistics, and a step that decodes
tokens."""

from dataclasses import dataclass
from typing import Any

from lerobot.configs.types import PipelineFeatureType, PolicyFeature
from lerobot.processor import (
    ActionProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)
from lerobot.utils.constants import ACTION

from lerobot_policy_openvla.actions import ActionTokenizer, choose_key, lerobot_statistics
from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


@dataclass
class DecodeActionTokens(ActionProcessorStep):
    """Decodes token ids (…, A) to actions in [-1, 1]. `vocabulary` is the number of all token ids."""

    vocabulary: int

    def action(self, action: PolicyAction) -> PolicyAction:
        return ActionTokenizer(self.vocabulary).decode(action)

    def get_config(self) -> dict[str, Any]:
        return {"vocabulary": self.vocabulary}

    def transform_features(self, features: Features) -> Features:
        return features


def make_openvla_pre_post_processors(
    config: OpenVLAConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Make the processors; actions are normalised by the statistics of `config.unnorm_key`, else
    `dataset_stats`.

    Images stay as they are: the policy resizes and normalises them.
    """
    key = choose_key(config.norm_stats, config.unnorm_key)
    statistics = {ACTION: lerobot_statistics(config.norm_stats[key]["action"])} if key else dataset_stats
    steps = make_default_policy_processor_steps(config, statistics, normalizer_device=config.device)
    decode = DecodeActionTokens(config.sizes.llama.tokenizer_size)
    return make_policy_processor_pipelines(
        input_steps=[steps.rename_observations, steps.add_batch_dim, steps.to_device, steps.normalize],
        output_steps=[decode, steps.unnormalize, steps.to_cpu],
    )

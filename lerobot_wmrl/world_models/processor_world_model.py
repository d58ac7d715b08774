"""Processors of the world models: they move batches to the device, and put success in the place of done.

Statistics live in the models' buffers, because LeRobot does not reload reward processors on resume.
"""

from typing import Any

from lerobot.configs.rewards import RewardModelConfig
from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    EnvTransition,
    PolicyProcessorPipeline,
    batch_to_transition,
    policy_action_to_transition,
    transition_to_policy_action,
)
from lerobot.utils.constants import (
    DONE,
    POLICY_POSTPROCESSOR_DEFAULT_NAME,
    POLICY_PREPROCESSOR_DEFAULT_NAME,
)

from lerobot_wmrl.data.episodes import success_column


def labelled_transition(batch: dict[str, Any]) -> EnvTransition:
    """Make LeRobot's transition, in which `next.success`, if there is one, takes the place of `next.done`."""
    column = success_column(batch)
    return batch_to_transition(batch if column is None else {**batch, DONE: batch[column]})


def make_pass_through_processors(
    config: RewardModelConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Return the pre- and postprocessor of any model of this package."""
    preprocessor: PolicyProcessorPipeline = PolicyProcessorPipeline(
        steps=[AddBatchDimensionProcessorStep(), DeviceProcessorStep(device=config.device or "cpu")],
        name=POLICY_PREPROCESSOR_DEFAULT_NAME,
        to_transition=labelled_transition,
    )
    postprocessor: PolicyProcessorPipeline = PolicyProcessorPipeline(
        steps=[DeviceProcessorStep(device="cpu")],
        name=POLICY_POSTPROCESSOR_DEFAULT_NAME,
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    return preprocessor, postprocessor


make_action_world_model_pre_post_processors = make_pass_through_processors
make_text_world_model_pre_post_processors = make_pass_through_processors

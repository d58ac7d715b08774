"""What a policy must have in common with an environment, a dataset or a training."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.errors import FieldError

WIDEST_STD: Final = 2.0
"""Standard deviation of a policy's actions, in widths of an environment's range, beyond which they are in
other units. Within a range it is at most half of its width."""


def adopt_features(config: PreTrainedConfig, shown: Mapping[str, tuple[int, ...]]) -> None:
    """Let a policy that saw no dataset yet see what the environment shows, as lerobot-eval does."""
    if config.input_features:
        return
    kinds = {name: FeatureType.VISUAL if name.startswith(OBS_IMAGE) else FeatureType.STATE for name in shown}
    config.input_features = {
        name: PolicyFeature(type=kinds[name], shape=shape) for name, shape in shown.items()
    }
    config.validate_features()


def require_trained(config: PreTrainedConfig) -> None:
    """Raise FieldError for a policy without a checkpoint, unless it has nothing to train (a planner)."""
    if config.pretrained_path is None and config.get_optimizer_preset() is not None:
        raise FieldError(
            "policy.type", config.type, "would act with random weights", "give a checkpoint: `policy.path`"
        )


def require_distillable(config: PreTrainedConfig) -> None:
    """Raise FieldError for a policy that learns from what the labels of a planner lack, later observations or
    rewards, or whose actions are relative to a state that later actions of a chunk no longer have."""
    if getattr(config, "use_relative_actions", False):
        raise FieldError(
            "policy.path",
            config.pretrained_path,
            f"this {config.type} predicts relative actions",
            "take one that was trained with `use_relative_actions=false`",
        )
    ahead = max(config.observation_delta_indices or [0]) > 0
    if ahead or config.reward_delta_indices is not None:
        raise FieldError(
            "policy.path",
            config.pretrained_path,
            f"{config.type} learns from {'later observations' if ahead else 'rewards'}, and a planner's "
            "labels have none",
            "take one that is cloned from observations and actions, such as act",
        )


def require_chunks(config: PreTrainedConfig) -> None:
    """Raise FieldError for an ACT policy whose actions are averages of several chunks."""
    if config.temporal_ensemble_coeff is not None:
        raise FieldError(
            "policy.temporal_ensemble_coeff",
            config.temporal_ensemble_coeff,
            "averaged chunks have no log-probability",
            "set `policy.temporal_ensemble_coeff` to null",
        )


def fit_to_environment(
    config: PreTrainedConfig, shown: Mapping[str, tuple[int, ...]], action_size: int
) -> None:
    """Let a policy without features take the environment's; `check_fit` for all others."""
    adopt_features(config, shown)
    action = PolicyFeature(type=FeatureType.ACTION, shape=(action_size,))
    config.output_features = config.output_features or {ACTION: action}
    check_fit(config, shown, action_size)


def seen_shape(feature: PolicyFeature) -> tuple[int, ...]:
    """Return the shape of what a policy sees, images (C, H, W).

    LeRobot's feature says (H, W, 3) where the dataset calls the channels by another name, such as `rgb`.
    """
    shape = tuple(feature.shape)
    channels_last = feature.type is FeatureType.VISUAL and shape[-1] == 3 and shape[0] != 3
    return (3, *shape[:2]) if channels_last else shape


def check_fit(
    config: PreTrainedConfig,
    shown: Mapping[str, tuple[int, ...]],
    action_size: int,
    where: str = "the environment",
) -> None:
    """Raise FieldError unless an environment shows what the policy looks at, in the same sizes.

    Args:
        config: the policy's.
        shown: the environment's observations by LeRobot's names with their shapes, images (3, H, W).
        action_size: components of the environment's actions.
        where: what the error calls the environment.
    """
    cameras = ", ".join(name for name in shown if name.startswith(OBS_IMAGE)) or "none"
    path = config.pretrained_path
    for name, feature in (config.input_features or {}).items():
        if name not in shown and name != OBS_STATE and not name.startswith(OBS_IMAGE):
            raise FieldError(
                "policy.path",
                path,
                f"the policy needs {name}, and a policy is shown cameras and {OBS_STATE} alone",
                "train it on data without that column (lerobot-edit-dataset, remove_feature)",
            )
        if name not in shown:
            raise FieldError(
                "policy.path",
                path,
                f"the policy needs {name}, which {where} does not have (its cameras: {cameras})",
                "use one with the policy's cameras and state, or train the policy on what this one shows",
            )
        if shown[name] != seen_shape(feature):
            needed = f"the policy needs {name} of shape {seen_shape(feature)}"
            of_images = "use the image size that the policy was trained on"
            of_state = "use the robot that the policy was trained for, or train it on this one's data"
            raise FieldError(
                "policy.path",
                path,
                f"{needed}, {where} has {shown[name]}",
                of_images if name.startswith(OBS_IMAGE) else of_state,
            )
    check_action_size(config, action_size, where)


def check_action_size(config: PreTrainedConfig, action_size: int, where: str) -> None:
    """Raise FieldError unless the policy's actions have as many components as an environment's."""
    path = config.pretrained_path
    if config.action_feature is None:
        raise FieldError(
            "policy.path",
            path,
            "does not say how many components an action has",
            "train it on a dataset with the environment's actions",
        )
    wanted = config.action_feature.shape[0]
    if wanted != action_size:
        raise FieldError(
            "policy.path",
            path,
            f"the policy has {wanted} action components, {where} {action_size}",
            "train it on a dataset with these actions",
        )


def check_units(
    config: PreTrainedConfig,
    postprocessor: Any,
    names: Sequence[str],
    low: Tensor,
    high: Tensor,
    where: str = "the environment",
) -> None:
    """Raise FieldError if a policy's actions are in other units than an environment's.

    This is seen from the actions that the policy was trained on: no component's mean may lie farther outside
    of the environment's range than this is wide, nor may most components vary far more than it is wide.

    Args:
        config: the policy's.
        postprocessor: the policy's, which knows mean and standard deviation, if actions are normalised.
        names: one for each component of an action.
        low, high: the range of the environment's actions. (A,), (A,)
        where: what the error calls the environment.
    """
    for known in _action_statistics(postprocessor, "mean"):
        mean, least, most = (torch.as_tensor(each).flatten().cpu().double() for each in (*known, low, high))
        width = (most - least).clamp_min(1e-3 * most.abs())  # a constant component's mean was rounded
        strange = (mean < least - width) | (mean > most + width)
        for component in strange.nonzero().flatten().tolist()[:1]:
            raise FieldError(
                "policy.path",
                config.pretrained_path,
                f"was trained on actions whose {names[component]} is {mean[component]:.4g} on average, in "
                f"{where} it is between {least[component]:.4g} and {most[component]:.4g}",
                "use a policy with the same actions in the same units",
            )
    for (std,) in _action_statistics(postprocessor, "std"):
        spread, least, most = (torch.as_tensor(each).flatten().cpu().double() for each in (std, low, high))
        check_spread(config, spread, names, least, most, where)


def check_spread(
    config: PreTrainedConfig, std: Tensor, names: Sequence[str], least: Tensor, most: Tensor, where: str
) -> None:
    """Raise FieldError if most components of a policy's actions that vary in an environment have a standard
    deviation of more than `WIDEST_STD` times the width of its range."""
    moving = most - least > 1e-3 * torch.maximum(least.abs(), most.abs())  # the others' std is rounding noise
    strange = moving & (std > WIDEST_STD * (most - least))
    if 2 * strange.sum() > moving.sum():
        component = int(strange.nonzero()[0])
        raise FieldError(
            "policy.path",
            config.pretrained_path,
            f"was trained on actions whose {names[component]} has a standard deviation of "
            f"{std[component]:.4g}, in {where} it is between {least[component]:.4g} and "
            f"{most[component]:.4g}, and others are like it",
            "use a policy with the same actions in the same units: displacements are no targets",
        )


def learnt_range(postprocessor: Any) -> tuple[Tensor, Tensor] | None:
    """Return the least and the greatest actions that a policy has learnt from, if its postprocessor says it.
    (A,), (A,)"""
    for low, high in _action_statistics(postprocessor, "min", "max"):
        return torch.as_tensor(low).flatten().cpu().float(), torch.as_tensor(high).flatten().cpu().float()
    return None


def _action_statistics(postprocessor: Any, *names: str) -> Iterator[list[Any]]:
    """Yield these statistics of actions from every step of a postprocessor that has them all."""
    for step in postprocessor.steps:
        stats = (getattr(step, "stats", None) or {}).get(ACTION, {})
        if all(stats.get(name) is not None for name in names):
            yield [stats[name] for name in names]

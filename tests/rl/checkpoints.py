"""Checkpoints of untrained policies."""

from collections.abc import Sequence
from pathlib import Path

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors

from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.images import camera_key
from lerobot_wmrl.common.policies import LoadedPolicy, read_policy_config


def save_untrained_policy(
    folder: Path,
    camera: str = "third_view",
    size: int | tuple[int, int] = 32,
    actions: int = 3,
    constant: float | Sequence[float] | None = None,
) -> Path:
    """A policy that sees one camera, with its processors.

    With `constant` all its actions are that one, or have that number in every component.
    """
    image = PolicyFeature(
        type=FeatureType.VISUAL, shape=(3, *((size, size) if isinstance(size, int) else size))
    )
    action = PolicyFeature(type=FeatureType.ACTION, shape=(actions,))
    config = CnnConfig(
        device="cpu",
        input_features={camera_key(camera): image},
        output_features={"action": action},
    )
    CnnPolicy(config).save_pretrained(folder)
    mean, std = (0.0, 1.0) if constant is None else (constant, 0.0)
    means = torch.as_tensor(mean, dtype=torch.float32).expand(actions)
    stats = {"action": {"mean": means, "std": torch.full((actions,), std)}}
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


def loaded(checkpoint: Path) -> LoadedPolicy:
    """The policy of a checkpoint with its processors."""
    return LoadedPolicy.load(read_policy_config(str(checkpoint), []))

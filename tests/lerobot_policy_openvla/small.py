"""Small policies with random weights, observations for them, and datasets' statistics."""

from typing import Any

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor, nn

from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
from lerobot_policy_openvla.sizes import DinoSizes, LlamaSizes, Sizes, ViTSizes

CAMERA = "observation.images.third_view"
ACTIONS = 3
LONG, SHORT = "push the red cube as far forward as it goes", "push"

SMALL_SIZES = Sizes(
    image_size=32,
    patch_size=16,
    dino=DinoSizes(width=16, depth=3, heads=1, mlp_size=32, registers=2),
    siglip=ViTSizes(width=32, depth=2, heads=2, mlp_size=48),
    llama=LlamaSizes(width=32, depth=2, heads=4, kv_heads=2, mlp_size=48, vocab_size=640),
)
"""576 ids of the tokenizer, 320 … 575 of them actions."""


def small_config(**settings: Any) -> OpenVLAConfig:
    """For one camera and three action components."""
    image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, 32, 32))
    action = PolicyFeature(type=FeatureType.ACTION, shape=(ACTIONS,))
    features = {"input_features": {CAMERA: image}, "output_features": {"action": action}}
    return OpenVLAConfig(
        **{"device": "cpu", "sizes": SMALL_SIZES, "value_sizes": [16], **features, **settings}
    )


def small_policy(**settings: Any) -> OpenVLAPolicy:
    """Untrained, with a value that is not 0, and weights large enough for answers to differ."""
    torch.manual_seed(0)
    policy = OpenVLAPolicy(small_config(**settings)).eval()
    for name, parameter in policy.model.named_parameters():
        if parameter.ndim > 1:
            nn.init.normal_(parameter, std=0.3 if "embed_tokens" in name else parameter.shape[-1] ** -0.5)
    nn.init.normal_(policy.value_head[-1].weight)
    return policy


def observe(batch: int = 4, instructions: tuple[str, ...] = (LONG, SHORT)) -> dict[str, Any]:
    """Random pictures; the instructions take turns."""
    images = torch.rand(batch, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    return {CAMERA: images, "task": [instructions[row % len(instructions)] for row in range(batch)]}


def row_of(observation: dict[str, Any], row: int) -> dict[str, Any]:
    """One row alone, so that nothing is padded."""
    return {CAMERA: observation[CAMERA][row : row + 1], "task": observation["task"][row : row + 1]}


def random_ids(policy: OpenVLAPolicy, batch: int) -> Tensor:
    """Action tokens (B, A)."""
    tokens = policy.action_tokens
    return torch.randint(tokens.first_id, tokens.vocabulary, (batch, ACTIONS))

"""Which layers get adapters when nobody says so."""

from typing import Any

from lerobot_policy_openvla.sizes import Sizes

VALUE_HEAD = "value_head"


def adapter_targets(sizes: Sizes) -> dict[str, Any]:
    """For PEFT: every linear layer that contributes (OpenVLA's and RL4VLA's choice); the value head whole.

    The vision transformers' last blocks and the pooling head contribute nothing, so they get none.
    """
    depths = {"featurizer": sizes.dino.depth, "fused_featurizer": sizes.siglip.depth}
    linear = r"(attn\.(qkv|proj)|mlp\.fc\d)"
    layers = [
        rf"vision_backbone\.{name}\.blocks\.({_any_below(depth - 1)})\.{linear}"
        for name, depth in depths.items()
    ]
    layers += [r"projector\.fc\d", r"language_model\.model\.layers\.\d+\.(self_attn|mlp)\.\w+_proj"]
    return {"target_modules": rf"model\.({'|'.join(layers)})", "modules_to_save": [VALUE_HEAD]}


def _any_below(count: int) -> str:
    return "|".join(map(str, range(count)))

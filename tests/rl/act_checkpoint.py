"""An untrained ACT of LeRobot's, as small as it can be made."""

from pathlib import Path

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

IMAGE, STATE, SCENE = "observation.images.third_view", "observation.state", "observation.environment_state"
CHUNK, ACTED = 6, 3


def small_act(state: int = 4, actions: int = 3, images: bool = True) -> ACTPolicy:
    """For 32x32 pictures of one camera, by a ResNet, or for a state of the environment, which is far smaller.

    Acts `ACTED` of `CHUNK` predicted actions.
    """
    torch.manual_seed(0)
    picture = PolicyFeature(type=FeatureType.VISUAL, shape=(3, 32, 32))
    scene = PolicyFeature(type=FeatureType.ENV, shape=(state,))
    config = ACTConfig(
        device="cpu",
        pretrained_backbone_weights=None,
        dim_model=16,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        chunk_size=CHUNK,
        n_action_steps=ACTED,
        input_features={
            **({IMAGE: picture} if images else {SCENE: scene}),
            STATE: PolicyFeature(type=FeatureType.STATE, shape=(state,)),
        },
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(actions,))},
    )
    return ACTPolicy(config).eval()


def save_small_act(folder: Path, state: int, actions: int) -> Path:
    """Its checkpoint, with processors that change images and actions little."""
    policy = small_act(state, actions)
    policy.save_pretrained(folder)
    sizes = {IMAGE: (3, 1, 1), STATE: (state,), "action": (actions,)}
    stats = {name: {"mean": torch.zeros(size), "std": torch.full(size, 0.1)} for name, size in sizes.items()}
    for processor in make_pre_post_processors(policy.config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder

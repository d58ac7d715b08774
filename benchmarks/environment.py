"""What a reward costs: steps of the world-model environment against bare imagination, in one run.

    python benchmarks/environment.py --world_model=outputs/gate/action_world_model \\
        --text_world_model=outputs/imagined_ppo/text_world_model --dataset.root=outputs/gate/rollouts

For each number of environments, in turns: imagining and drawing frames without any environment, and the
environment's step with each reward. `proxy` and `embedding` have random weights, which cost the same.
Memory is what the environment and its imagination hold in tensors, beside the models. Writes
docs/results/environment_speed.json.
"""

import argparse
import gc
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import torch
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.import_utils import register_third_party_plugins
from torch import Tensor

from imagined_env import add_world_models, world_model_env
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.envs.start_frames import read_start_images
from lerobot_wmrl.envs.world_model_env import WorldModels, WorldModelVectorEnv, load_world_models, make_env_at
from lerobot_wmrl.maniskill.embodiment import ACTION_LOW
from lerobot_wmrl.rewards.configuration_rewards import EmbeddingConfig, GeneralConfig, ProxyConfig
from lerobot_wmrl.rewards.modeling_rewards import EmbeddingRewardModel, GeneralRewardModel, ProxyRewardModel
from lerobot_wmrl.rewards.similarity import PixelSimilarity
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from machine import rates
from workloads import STEPS, Imagination, Work, repeated

RESULTS: Final = Path(__file__).parents[1] / "docs" / "results" / "environment_speed.json"
NUMBERS = (1, 16, 64, 256)
BARE: Final = "imagined and drawn"


def learned_rewards(model: ActionWorldModelRewardModel) -> dict[str, PreTrainedRewardModel]:
    """Proxy and embedding, untrained."""
    config, device = model.config, model.device.type
    sizes = config.tokenizer
    proxy = ProxyConfig(device=device, cameras=sizes.cameras, image_size=sizes.image_size)
    embedding = EmbeddingConfig(device=device, world_model="untrained", hidden_size=config.dynamics.width)
    return {
        "proxy": ProxyRewardModel(proxy).to(device).eval(),
        "embedding": EmbeddingRewardModel(embedding).to(device).eval(),
    }


def environments(config: WorldModelEnv, models: WorldModels, count: int) -> dict[str, WorldModelVectorEnv]:
    """One of each reward."""
    frames = read_start_images(config.dataset, models.model.config)
    device = models.model.device.type
    goalless = models._replace(text_model=None)
    sparse = goalless._replace(reward=GeneralRewardModel(GeneralConfig(device=device, alpha=1.0)))
    variants = {
        "sparse": sparse,
        "general": models,
        "general, mse": models._replace(measure=PixelSimilarity()),
        **{name: goalless._replace(reward=reward) for name, reward in learned_rewards(models.model).items()},
    }
    return {name: make_env_at(frames, variant, config, count) for name, variant in variants.items()}


def stepping(env: WorldModelVectorEnv) -> Work:
    """`STEPS` steps that move nothing."""
    env.reset(seed=0)
    still = torch.zeros(env.num_envs, len(ACTION_LOW), device=env.device)
    return repeated(lambda: env.step(still), graphed=False)


def tensor_bytes() -> int:
    """Return the bytes of all tensors that Python holds."""
    gc.collect()
    found = {
        each.untyped_storage().data_ptr(): each.untyped_storage().nbytes()
        for each in gc.get_objects()
        if issubclass(type(each), Tensor)
    }
    return sum(found.values())


def measure(config: WorldModelEnv, models: WorldModels, count: int) -> dict[str, Any]:
    """Frames a second of everything at one number of environments, and what each reward adds."""
    device = models.model.device
    bare = Imagination(models.model, count, torch.float32, device)
    before = tensor_bytes()
    envs = environments(config, models, count)
    works = {name: (count * STEPS, stepping(env)) for name, env in envs.items()}
    held = (tensor_bytes() - before) / len(envs)
    found = rates({BARE: (count * STEPS, repeated(bare.step_and_decode, graphed=False)), **works}, device)
    return {
        "environments": count,
        "frames_per_s": {name: round(rate, 1) for name, rate in found.items()},
        "costs_more": {name: round(found[BARE] / found[name] - 1, 3) for name in envs},
        "mbyte": round(held / 1e6, 1),
    }


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_world_models(parser)
    parser.add_argument("--numbers", type=int, nargs="+", default=NUMBERS, help="of environments")
    parser.add_argument("--output", type=Path, default=RESULTS, help="JSON file")
    return parser


def main() -> None:
    """Measure everything, print it, write it."""
    register_third_party_plugins()
    given = make_parser().parse_args()
    config = world_model_env(given, device="cpu")
    models = load_world_models(config, config.device)
    figures: Mapping[str, Any] = {
        "threads": torch.get_num_threads(),
        "by_number": [measure(config, models, count) for count in given.numbers],
    }
    print(json.dumps(figures, indent=2))
    write_json(given.output, figures)


if __name__ == "__main__":
    main()

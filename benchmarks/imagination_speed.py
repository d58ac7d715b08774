"""Imagined frames a second against ManiSkill's rendered frames a second, in one run on one machine.

    python benchmarks/imagination_speed.py --world_model=outputs/demo/action_world_model \
        --output=docs/results/imagination_speed.json

Both sides do what a policy sees: the world model imagines and decodes the picture, ManiSkill steps the
physics and renders the same picture. ManiSkill is measured twice: with this package's light robot meshes,
and with the stock ones, which is what a user would render without it. The floor is the network's
arithmetic at the machine's measured matrix-multiplication rate.
"""

import argparse
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.files import write_json
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.context import Context
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel

REPETITIONS = 3
MATMULS = 50


def median_rate(frames: int, work: Callable[[], object]) -> float:
    """Median frames a second of a few repetitions, after one that is not counted."""
    work()
    rates = []
    for _ in range(REPETITIONS):
        start = time.perf_counter()
        work()
        rates.append(frames / (time.perf_counter() - start))
    return float(np.median(rates))


def blank_context(model: ActionWorldModelRewardModel, batch: int) -> Context:
    """What decoding needs, if the tokenizer is conditioned on first frames."""
    size = model.config.image_size
    return model.tokenizer.context(torch.zeros(batch, model.tokenizer.num_cameras, 3, size, size))


def imagination_rate(model: ActionWorldModelRewardModel, batch: int, steps: int) -> float:
    """Frames a second of `batch` imaginations, decoded to pictures."""
    tokens = torch.zeros(batch, model.tokenizer.tokens_per_frame, dtype=torch.long)
    state, action = model.state_mean.expand(batch, -1), model.action_mean.expand(batch, -1)
    context = blank_context(model, batch)

    @torch.no_grad()
    def roll() -> None:
        imagination = model.start(tokens, state)
        for _ in range(steps):
            model.tokenizer.decode(model.step(imagination, action).tokens, context)

    return median_rate(batch * steps, roll)


def maniskill_rate(image_size: int, steps: int, robot_mesh_detail: float) -> float:
    """Frames a second of one ManiSkill process with a camera."""
    config = WmrlManiSkillEnv(image_size=image_size, robot_mesh_detail=robot_mesh_detail)
    envs = config.create_envs(1)
    env = envs[config.type][0]
    env.reset(seed=[1_000_000])
    still = np.zeros((1, 7), np.float32)

    def roll() -> None:
        for _ in range(steps):
            env.unwrapped.envs[0].unwrapped.step(still[0])

    rate = median_rate(steps, roll)
    env.close()
    return rate


def network_flop(model: ActionWorldModelRewardModel) -> float:
    """Multiply-adds of one imagined and decoded frame, counted as 2, from torch's own counter."""
    from torch.utils.flop_counter import FlopCounterMode

    tokens = torch.zeros(1, model.tokenizer.tokens_per_frame, dtype=torch.long)
    imagination, context = model.start(tokens, model.state_mean[None]), blank_context(model, 1)
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        model.tokenizer.decode(model.step(imagination, model.action_mean[None]).tokens, context)
    return float(counter.get_total_flops())


def matmul_rate() -> float:
    """FLOP a second of large float32 matrix products into memory that is there already."""
    a, b, out = torch.randn(2048, 512), torch.randn(512, 1024), torch.empty(2048, 1024)

    def multiply() -> None:
        for _ in range(MATMULS):
            torch.mm(a, b, out=out)

    return median_rate(MATMULS, multiply) * 2 * 2048 * 512 * 1024


def main() -> None:
    """Measure everything, print it, write it."""
    register_third_party_plugins()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--world_model", required=True, help="output folder of an action world model's training"
    )
    parser.add_argument("--batch", type=int, default=64, help="imaginations in one batch")
    parser.add_argument("--steps", type=int, default=30, help="frames a repetition")
    parser.add_argument("--output", type=Path, help="JSON file for the figures")
    arguments = parser.parse_args()
    model = load_model(arguments.world_model, "action_world_model")
    imagined = imagination_rate(model, arguments.batch, arguments.steps)
    light = maniskill_rate(model.config.image_size, arguments.steps, WmrlManiSkillEnv().robot_mesh_detail)
    stock = maniskill_rate(model.config.image_size, arguments.steps, 1.0)
    flop, peak = network_flop(model), matmul_rate()
    figures = {
        "machine": platform.processor() or platform.machine(),
        "threads": torch.get_num_threads(),
        "maniskill_processes": 1,
        "image_size": model.config.image_size,
        "batch": arguments.batch,
        "network": {name: getattr(model.config, name) for name in ("layers", "width", "heads", "patch")},
        "imagined_frames_per_s": round(imagined, 1),
        "maniskill_frames_per_s": round(light, 1),
        "maniskill_stock_meshes_frames_per_s": round(stock, 1),
        "ratio": round(imagined / light, 2),
        "ratio_to_stock_meshes": round(imagined / stock, 2),
        "mflop_per_frame": round(flop / 1e6, 1),
        "matmul_gflop_per_s": round(peak / 1e9, 1),
        "share_of_floor": round(imagined * flop / peak, 3),
    }
    print(json.dumps(figures, indent=2))
    if arguments.output:
        write_json(arguments.output, figures)


if __name__ == "__main__":
    main()

"""How fast a world model learns and imagines, against what the machine allows and against ManiSkill.

    python benchmarks/world_model.py --world_model=outputs/demo/improve/world_model
    python benchmarks/world_model.py --sizes=gpu --no_maniskill
    python benchmarks/world_model.py --sizes=cpu --model.dynamics=autoregressive --output=autoregressive.json

All in one run. `--sizes` takes a preset's sizes with random weights, and flags of the model may follow. At
each batch size, measured in turns: imagining (with as much remembered as in the long run), imagining and
decoding to pictures, imagining in float32, imagining without memory (what is remembered computed anew for
each frame), and training on clips, the optimiser included. The floor of a frame is the larger of two times:
its arithmetic at the measured rate of matrix products, and its bytes (weights and memory) at the measured
rate of memory. ManiSkill, one process, steps and renders the same pictures, with this package's light robot
meshes and with its own. On CUDA a step of an autoregressive model is captured in a CUDA graph. Writes
docs/results/world_model_speed.json.
"""

import argparse
import json
import platform
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from lerobot.utils.import_utils import register_third_party_plugins
from torch.utils.flop_counter import FlopCounterMode

from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.precision import imagination_dtype, keep_freed_memory
from lerobot_wmrl.common.presets import presets_of
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from machine import matmul_rate, rates, stream_rate
from workloads import STEPS, Imagination, Work, preset_config, random_clip, repeated, training_step

RESULTS = Path(__file__).parents[1] / "docs" / "results"
BATCHES = (1, 16, 64, 256)
MOST_TRAINING_FRAMES = 4096
"""Clips in one training batch: the activations of more do not fit into the memory of a small machine."""


def flop(work: Work) -> float:
    """Multiply-adds of one call, counted as 2, by torch's own counter."""
    with FlopCounterMode(display=False) as counter:
        work()
    return float(counter.get_total_flops())


def measure_batch(
    model: ActionWorldModelRewardModel, batch: int, matmul: float, stream: float
) -> dict[str, Any]:
    """All rates (frames a second) at one batch size, and their shares of the floor."""
    device = model.device
    dtype = imagination_dtype(device)
    fast, plain = (Imagination(model, batch, kind, device) for kind in (dtype, torch.float32))
    frames = batch * model.config.clip_length
    graphed = device.type == "cuda" and model.config.dynamics.type == "autoregressive"
    works: dict[str, tuple[float, Work]] = {
        "imagined": (batch * STEPS, repeated(fast.step, graphed)),
        "imagined_and_decoded": (batch * STEPS, repeated(fast.step_and_decode, graphed)),
        "imagined_in_float32": (batch * STEPS, repeated(plain.step, graphed)),
        "imagined_without_memory": (batch, fast.step_without_memory),
    }
    if frames <= MOST_TRAINING_FRAMES:
        train = training_step(model, random_clip(model, batch, device), dtype)
        if fits(train):
            works["trained"] = (frames, train)
    found = rates(works, device)
    arithmetic = {
        "imagined": flop(fast.step) / batch,
        "imagined_and_decoded": flop(fast.step_and_decode) / batch,
    }
    if "trained" in works:
        arithmetic["trained"] = flop(works["trained"][1]) / frames
    byte_seconds = {name: fast.bytes_a_frame() / stream for name in arithmetic if name != "trained"}
    floor = {name: max(count / matmul, byte_seconds.get(name, 0.0)) for name, count in arithmetic.items()}
    return {
        "batch": batch,
        "frames_per_s": {name: round(rate, 1) for name, rate in found.items()},
        "mflop_per_frame": {name: round(count / 1e6, 1) for name, count in arithmetic.items()},
        "mbyte_per_frame": round(fast.bytes_a_frame() / 1e6, 3),
        "floor_frames_per_s": {name: round(1 / seconds, 1) for name, seconds in floor.items()},
        "share_of_floor": {name: round(found[name] * seconds, 3) for name, seconds in floor.items()},
        "times_faster_than_without_memory": round(found["imagined"] / found["imagined_without_memory"], 2),
        "times_faster_than_float32": round(found["imagined"] / found["imagined_in_float32"], 2),
    }


def measure_if_it_fits(
    model: ActionWorldModelRewardModel, batch: int, matmul: float, stream: float
) -> dict[str, Any]:
    """`measure_batch`, or that the GPU's memory is too small for it."""
    try:
        return measure_batch(model, batch, matmul, stream)
    except torch.OutOfMemoryError:
        torch.cuda.empty_cache()
        return {"batch": batch, "does not fit": True}


def fits(work: Work) -> bool:
    """Whether the GPU's memory is large enough for one call."""
    try:
        work()
    except torch.OutOfMemoryError:
        torch.cuda.empty_cache()
        return False
    return True


def maniskill_rates(image_size: int, cameras: list[str]) -> dict[str, float]:
    """Rendered steps a second of one ManiSkill process, with light and with ManiSkill's robot meshes."""
    works, open_envs = {}, []
    for name, detail in (("light meshes", WmrlManiSkillEnv().robot_mesh_detail), ("stock meshes", 1.0)):
        config = WmrlManiSkillEnv(image_size=image_size, cameras=cameras, robot_mesh_detail=detail)
        env = config.create_envs(1)[config.type][0]
        env.reset(seed=[1_000_000])
        simulation, still = env.unwrapped.envs[0].unwrapped, env.single_action_space.sample() * 0
        open_envs.append(env)
        works[name] = (
            STEPS,
            lambda simulation=simulation, still=still: [simulation.step(still) for _ in range(STEPS)],
        )
    found = rates(works, torch.device("cpu"))
    for env in open_envs:
        env.close()
    return {name: round(rate, 1) for name, rate in found.items()}


def make_model(given: argparse.Namespace, flags: Sequence[str]) -> ActionWorldModelRewardModel:
    """The checkpoint, or random weights of a preset's sizes, changed by `flags`."""
    device = given.device or ("cuda" if torch.cuda.is_available() else "cpu")
    if given.world_model:
        return load_model(given.world_model, "action_world_model", device)
    tokenizer, config = (
        preset_config(given.sizes, kind, flags if kind == "action_world_model" else ()).model
        for kind in ("frame_tokenizer", "action_world_model")
    )
    config.device, config.tokenizer = device, tokenizer.tokenizer
    return ActionWorldModelRewardModel(config).to(device).eval()


def add_model(parser: argparse.ArgumentParser) -> None:
    """Add the flags that `make_model` reads."""
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--world_model", help="output folder of an action world model's training")
    sizes = list(presets_of("train-world-model"))
    source.add_argument("--sizes", choices=sizes, help="random weights of this preset's sizes")
    parser.add_argument("--device", help="cpu or cuda; by default CUDA if there is any")


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_model(parser)
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES, help="batch sizes")
    parser.add_argument("--no_maniskill", action="store_true", help="leave the simulator out")
    parser.add_argument("--output", type=Path, default=RESULTS / "world_model_speed.json", help="JSON file")
    return parser


def main() -> None:
    """Measure everything, print it, write it."""
    keep_freed_memory()
    register_third_party_plugins()
    parser = make_parser()
    given, flags = parser.parse_known_args()
    if flags and given.world_model:
        parser.error(f"{' '.join(flags)}: a checkpoint's model is as it was trained; flags need --sizes")
    model = make_model(given, flags)
    device = model.device
    dtype = imagination_dtype(device)
    matmul, stream = matmul_rate(dtype, device), stream_rate(device)
    config = model.config
    figures: dict[str, Any] = {
        "machine": torch.cuda.get_device_name() if device.type == "cuda" else platform.machine(),
        "threads": torch.get_num_threads(),
        "dtype": str(dtype).removeprefix("torch."),
        "image_size": config.tokenizer.image_size,
        "network": {
            "type": config.dynamics.type,
            **asdict(config.dynamics),
            "clip_length": config.clip_length,
            "cameras": config.tokenizer.cameras,
        },
        "transformer_tokens": model.dynamics.network.tokens_per_frame,
        "matmul_gflop_per_s": round(matmul / 1e9, 1),
        "stream_gbyte_per_s": round(stream / 1e9, 1),
        "by_batch": [measure_if_it_fits(model, batch, matmul, stream) for batch in given.batches],
    }
    if not given.no_maniskill:
        simulated = figures["maniskill_frames_per_s"] = maniskill_rates(
            config.tokenizer.image_size, config.tokenizer.cameras
        )
        figures["times_faster_than_maniskill"] = {
            meshes: {
                str(row["batch"]): round(row["frames_per_s"]["imagined_and_decoded"] / rate, 2)
                for row in figures["by_batch"]
                if "frames_per_s" in row
            }
            for meshes, rate in simulated.items()
        }
    print(json.dumps(figures, indent=2))
    write_json(given.output, figures)


if __name__ == "__main__":
    main()

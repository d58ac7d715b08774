"""What the presets' world models take of memory in training, and whether they train: on any CPU.

    python benchmarks/training_memory.py
    python benchmarks/training_memory.py --presets paper --output=docs/results/training_memory.json

Every model has its preset's sizes and cameras, and random weights. Two batches are sent through
the loss, of 1 and 2 samples (frames or clips; 2 and 3 of frames, some losses compare them), in bfloat16 with
losses in float32, as on a GPU. Autograd tells what it keeps of each for the backward pass: the difference is
a sample's share. Memory in training is `fixed` (weights, gradients and AdamW's two moments, each in float32)
and `activations` at the preset's batch size. Not counted: the workspace of kernels and what the allocator
loses to fragments. Then it takes `--steps` optimizer steps on the smaller batch, whose losses must be finite.
"""

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import torch
from lerobot.rewards import make_reward_model
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.precision import compute_in, keep_freed_memory
from lerobot_wmrl.common.presets import presets_of
from lerobot_wmrl.scripts.train_world_model import TRAINED
from workloads import preset_config, random_clip, random_frames, training_step

RESULTS = Path(__file__).parents[1] / "docs" / "results"
GB = 1e9
TRAINED_COPIES = 4
"""Float32 numbers of a trained weight: itself, its gradient, two moments."""


def kept_bytes(model: Any, batch: Any) -> int:
    """What autograd would keep of a loss, every storage once, the weights not counted. Nothing is kept."""
    weights = {parameter.untyped_storage()._cdata for parameter in model.parameters()}
    counted: WeakValueDictionary[int, torch.UntypedStorage] = WeakValueDictionary()
    total = 0

    def count(tensor: torch.Tensor) -> None:
        nonlocal total
        storage = tensor.untyped_storage()
        if storage._cdata not in weights and storage._cdata not in counted:
            counted[storage._cdata] = storage
            total += storage.nbytes()

    def refuse(_: object) -> torch.Tensor:
        raise RuntimeError("nothing was kept for a backward pass")

    with torch.autograd.graph.saved_tensors_hooks(count, refuse), compute_in(torch.bfloat16, "cpu"):
        model(batch)
    return total


def measured(preset: str, kind: str, steps: int) -> dict[str, Any]:
    """Sizes and memory of one model, and its first steps."""
    config, tokenizer = preset_config(preset, kind), preset_config(preset, "frame_tokenizer")
    config.model.tokenizer = tokenizer.model.tokenizer
    torch.manual_seed(0)
    model: Any = make_reward_model(config.model).train()
    make = random_frames if kind == "frame_tokenizer" else random_clip
    small = 2 if kind == "frame_tokenizer" else 1
    device = torch.device("cpu")
    batch = make(model, small, device)
    less, more = kept_bytes(model, batch), kept_bytes(model, make(model, small + 1, device))
    a_sample = more - less
    activations = less + a_sample * (config.batch_size - small)
    trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
    count = sum(parameter.numel() for parameter in trained)
    fixed = 4 * (TRAINED_COPIES * count + sum(p.numel() for p in model.parameters() if not p.requires_grad))
    step, began = training_step(model, batch, torch.bfloat16), time.perf_counter()
    losses = [step().item() for _ in range(steps)]
    if not all(map(math.isfinite, losses)):
        raise ValueError(f"{preset}, {kind}: losses {losses}")
    return {
        "preset": preset,
        "model": kind,
        "batch_size": config.batch_size,
        "trained parameters": count,
        "tokens a frame": model.tokenizer.tokens_per_frame,
        "fixed": in_gb(fixed),
        "activations of a sample": in_gb(a_sample),
        "activations": in_gb(activations),
        "in training": in_gb(fixed + activations),
        "losses": [round(loss, 3) for loss in losses],
        "seconds a step and sample": round((time.perf_counter() - began) / steps / small, 1),
    }


def in_gb(size: int) -> float:
    return round(size / GB, 3)


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    sizes = list(presets_of("train-world-model"))
    parser.add_argument("--presets", nargs="+", choices=sizes, default=["cpu", "gpu", "paper"], help="sizes")
    parser.add_argument("--models", nargs="+", choices=TRAINED, default=TRAINED, help="what is trained")
    parser.add_argument("--steps", type=int, default=4, help="optimizer steps")
    parser.add_argument("--output", type=Path, default=RESULTS / "training_memory.json", help="JSON file")
    return parser


def main() -> None:
    """Measure every model, print and write what was found."""
    keep_freed_memory()
    register_third_party_plugins()
    given = make_parser().parse_args()
    found = []
    for preset in given.presets:
        for kind in given.models:
            found.append(measured(preset, kind, given.steps))
            print(json.dumps(found[-1]), flush=True)
    write_json(given.output, {"models": found})


if __name__ == "__main__":
    main()

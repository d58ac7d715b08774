"""What fine-tuning OpenVLA by LoRA takes of a GPU's memory: computed without one, or measured.

    python benchmarks/openvla_memory.py --rank=32 --batch_sizes 1 8 16
    python benchmarks/openvla_memory.py --measure --output=docs/results/openvla_memory.json

The network is built in the release's size without memory (torch's fake tensors), PEFT puts adapters in, and a
loss is taken: autograd then tells what it keeps for the backward pass. Not counted: the workspace of kernels,
what the allocator loses to fragments, and the environment.

Parts, in GB: `weights` bfloat16; `adapters` and value head float32, with gradients and AdamW's two moments;
`reference` their frozen copy (PPO); `cache` keys and values of a rollout's step; `activations` of an update,
without and with checkpointing.

`--measure` also runs it on this machine's GPU, with random weights: the peak memory of SFT's updates, beside
the computed sum, and of decoding all environments' actions; and observations a second of both.
"""

import argparse
import gc
import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from accelerate import init_empty_weights
from peft import LoraConfig, PeftModel, get_peft_model
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode

from lerobot_policy_openvla.actions import BINS
from lerobot_policy_openvla.modeling_openvla import adapter_targets
from lerobot_policy_openvla.network import OpenVLANetwork, Prefix, make_value_head
from lerobot_policy_openvla.sizes import RELEASED
from lerobot_wmrl.common.files import write_json
from machine import rates

GB = 1e9
ACTIONS = 7
PROMPT = 25
"""Tokens of a usual instruction's prompt."""

TRAINED_COPIES = 4
"""Bytes of a trained float32 weight: itself, its gradient, two moments."""

VALUE_SIZES = (512, 128)


class Policy(nn.Module):
    """Network and value head under the names that the policy gives them, for PEFT's targets."""

    def __init__(self) -> None:
        super().__init__()
        torch.set_default_dtype(torch.bfloat16)
        self.model = OpenVLANetwork(RELEASED)
        torch.set_default_dtype(torch.float32)
        self.value_head = make_value_head([RELEASED.llama.width, *VALUE_SIZES])

    def forward(self, batch: int) -> Tensor:
        """A loss over all action tokens and the value: what SFT and PPO differentiate, (B, 7, V) logits."""
        ids = torch.zeros(batch, ACTIONS - 1, dtype=torch.long)
        states = self.model.states(self.prefix(batch), ids)
        log_probs = self.model.logits(states).log_softmax(dim=2)[..., :BINS]
        return log_probs.sum() + self.value_head(states[:, 0].detach().float()).sum()

    def prefix(self, batch: int) -> Prefix:
        """Encoded pictures and prompts, of the default device."""
        pixels = torch.zeros(batch, 6, RELEASED.image_size, RELEASED.image_size)
        return self.model.prefix(pixels, torch.zeros(batch, PROMPT, dtype=torch.long))

    @torch.inference_mode()
    def act(self, environments: int) -> Tensor:
        """A rollout's step: action tokens, (B, 7)."""
        ids, _ = self.model.decode(self.prefix(environments), ACTIONS, lambda logits: logits.argmax(dim=1))
        return ids


def adapted(rank: int) -> PeftModel:
    """Make the policy on the meta device, without memory: its default adapters, all else frozen."""
    config = LoraConfig(r=rank, lora_alpha=rank // 2, **adapter_targets(RELEASED))
    with init_empty_weights():
        return get_peft_model(Policy(), config)


def make_fake(policy: nn.Module) -> None:
    """Weights that behave like a CPU's, whose attention keeps what flash attention keeps on a GPU."""
    for module in policy.modules():
        for name, weight in module._parameters.items():
            if weight is not None:
                fake = torch.empty(weight.shape, dtype=weight.dtype)
                module._parameters[name] = nn.Parameter(fake, requires_grad=weight.requires_grad)


def kept_bytes(policy: nn.Module, batch: int) -> int:
    """What autograd keeps of one forward pass, every storage once, the weights not counted."""
    make_fake(policy)
    known = {parameter.untyped_storage()._cdata for parameter in policy.parameters()}
    kept: dict[int, Any] = {}

    def pack(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage._cdata not in known:
            kept[storage._cdata] = storage
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        loss = policy(batch)
    total = sum(storage.nbytes() for storage in kept.values())
    del loss
    return total


def sequence_length() -> int:
    """Tokens that the language model sees: picture, prompt, all action tokens but the last."""
    return RELEASED.patches + PROMPT + ACTIONS - 1


def layer_inputs(batch: int) -> int:
    """Bytes that checkpointing keeps: every layer's input, bfloat16."""
    vision = sum((vit.depth - 1) * vit.width * RELEASED.patches for vit in (RELEASED.dino, RELEASED.siglip))
    language = RELEASED.llama.depth * RELEASED.llama.width * sequence_length()
    return 2 * batch * (vision + language)


def activations(rank: int, batch: int) -> tuple[int, int]:
    """Bytes of an update's activations without and with checkpointing, where one layer is there at a time."""
    plain, checkpointed = adapted(rank), adapted(rank)
    checkpointed.get_base_model().model.enable_checkpointing()
    with FakeTensorMode(allow_non_fake_inputs=True):
        everything, outside = kept_bytes(plain, batch), kept_bytes(checkpointed, batch)
    return everything, outside + layer_inputs(batch) + (everything - outside) // RELEASED.llama.depth


def cache_bytes(environments: int) -> int:
    """Keys and values of all layers of a rollout step, bfloat16."""
    llama = RELEASED.llama
    width = llama.kv_heads * llama.width // llama.heads
    return 2 * 2 * llama.depth * width * (sequence_length() + 1) * environments


def static_bytes(rank: int) -> dict[str, int]:
    """What does not depend on the batch."""
    policy = adapted(rank)
    frozen = [parameter for parameter in policy.parameters() if not parameter.requires_grad]
    trained = sum(parameter.numel() for parameter in policy.parameters() if parameter.requires_grad)
    return {
        "trained parameters": trained,
        "weights": sum(parameter.numel() * parameter.itemsize for parameter in frozen),
        "adapters": TRAINED_COPIES * 4 * trained,
        "reference": 4 * trained,
    }


def table(rank: int, batch_sizes: Sequence[int], environments: int) -> dict[str, Any]:
    """All parts in GB, and their sums for SFT and PPO."""
    fixed = static_bytes(rank)
    updates = {batch: activations(rank, batch) for batch in batch_sizes}
    trained = fixed.pop("trained parameters")
    cache = cache_bytes(environments)
    sft = fixed["weights"] + fixed["adapters"]
    ppo = sft + fixed["reference"]
    return {
        "rank": rank,
        "trained parameters": trained,
        **{name: in_gb(value) for name, value in fixed.items()},
        f"cache of {environments} environments": in_gb(cache),
        "PPO, rollout": in_gb(ppo + cache),
        "updates": [
            {
                "batch": batch,
                **by_mode("activations", updates[batch], lambda each: each),
                **by_mode("SFT", updates[batch], lambda each: sft + each),
                **by_mode("PPO, update", updates[batch], lambda each: ppo + each),
            }
            for batch in batch_sizes
        ],
    }


def by_mode(name: str, sizes: tuple[int, int], total: Callable[[int], int]) -> dict[str, float]:
    """The same number without and with checkpointing."""
    plain, checkpointed = sizes
    return {name: in_gb(total(plain)), f"{name}, checkpointing": in_gb(total(checkpointed))}


def measured(rank: int, batch_sizes: Sequence[int], environments: int) -> dict[str, Any]:
    """Peak memory in GB and observations a second on the GPU, each mode from a policy of its own."""
    device = torch.device("cuda")
    found: dict[str, Any] = {"device": torch.cuda.get_device_name(device)}
    with device:
        for checkpointing in (False, True):
            found["checkpointing" if checkpointing else "plain"] = updates(rank, batch_sizes, checkpointing)
        policy = on_gpu(adapted(rank))
        found["decoding"] = {"environments": environments} | peak_and_rate(
            lambda: policy.get_base_model().act(environments), environments
        )
    return found


def updates(rank: int, batch_sizes: Sequence[int], checkpointing: bool) -> list[dict[str, Any]]:
    """Peak memory and rate of SFT's optimizer steps, by batch size."""
    policy = on_gpu(adapted(rank))
    if checkpointing:
        policy.get_base_model().model.enable_checkpointing()
    optimizer = torch.optim.AdamW(each for each in policy.parameters() if each.requires_grad)

    def update(batch: int) -> None:
        policy(batch).backward()
        optimizer.step()
        optimizer.zero_grad()

    return [{"batch": batch} | peak_and_rate(partial(update, batch), batch) for batch in batch_sizes]


def on_gpu[P: nn.Module](policy: P) -> P:
    """Give every weight small random values on the default device."""
    for module in policy.modules():
        for name, weight in module._parameters.items():
            if weight is not None:
                values = torch.empty(weight.shape, dtype=weight.dtype).normal_(std=0.02)
                module._parameters[name] = nn.Parameter(values, requires_grad=weight.requires_grad)
        for name, buffer in module._buffers.items():
            module._buffers[name] = None if buffer is None else buffer.to(torch.get_default_device())
    return policy.train()


def peak_and_rate(work: Callable[[], object], units: int) -> dict[str, float | str]:
    """Most memory that was allocated at once, and units a second; or that it did not fit."""
    gc.collect()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    try:
        rate = rates({"work": (units, work)}, torch.get_default_device())["work"]
    except torch.OutOfMemoryError:
        return {"GB": "does not fit"}
    return {"GB": in_gb(torch.cuda.max_memory_allocated()), "a second": round(rate, 2)}


def in_gb(size: int) -> float:
    return round(size / GB, 2)


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rank", type=int, default=32, help="of the adapters")
    parser.add_argument("--batch_sizes", type=int, nargs="+", default=[1, 8, 16], help="of updates")
    parser.add_argument("--environments", type=int, default=64, help="stepped together in a rollout")
    parser.add_argument("--measure", action="store_true", help="run it on the GPU too")
    parser.add_argument("--output", type=Path, help="JSON file for what is printed")
    return parser


def main() -> None:
    """Compute everything, measure it if wanted, and print it."""
    given = make_parser().parse_args()
    sizes = (given.rank, given.batch_sizes, given.environments)
    found = table(*sizes) | ({"measured": measured(*sizes)} if given.measure else {})
    print(json.dumps(found, indent=2))
    if given.output:
        write_json(given.output, found)


if __name__ == "__main__":
    main()

"""Presets: one place for the flags of every command at every size; of recordings, their recipes are it.

A preset is nothing but flags: `--preset=demo` is replaced, in place, by the flags listed here for that
command, so whatever a preset sets can also be set (and overridden, further right) by hand.
"""

from collections.abc import Mapping, Sequence
from typing import Final

Flags = Mapping[str, str | int | float | bool]

TYPE: Final = ".type"
"""Ends the flags that say which of several things is meant; their settings begin alike."""

DEMO_SCENES: Final = "[0,1,2]"
"""A sponge, a can and a box: what the 900 episodes of the recipe `demo` suffice for."""

DEMO_IMAGE_SIZE: Final = 64
"""Pixels a side that two cores can learn from in minutes."""

DEMO_CAMERAS: Final = "[third_view,side_view]"
"""Both stand still: what moves in them is what happens."""

STRICT_DONE: Final[Flags] = {"done_threshold": 0.95, "done_frames": 2}
"""Where a world model of this size believes fewer failures; PPO finds what it believes."""

TINY_WORLD_MODEL: Final[Flags] = {
    "model.layers": 1,
    "model.width": 32,
    "model.heads": 2,
    "model.clip_length": 12,
    "model.code_width": 16,
    "steps": 16,
    "batch_size": 4,
    "save_freq": 8,
    "log_freq": 5,
}

CPU_TOKENIZER: Final[Flags] = {
    "model.tokenizer.cameras": "[third_view,side_view]",
    "model.tokenizer.widths": "[32,64,128]",
    "model.tokenizer.context": True,
    "steps": 1600,
    "batch_size": 48,
    "save_freq": 200,
}
"""64 tokens for each of the two views that stand still, of 128 pixels a side as the recipe has them."""

CPU_ACTION_MODEL: Final[Flags] = {
    "model.dynamics": "anchored",
    "model.layers": 4,
    "model.width": 192,
    "model.patch": 2,
    "model.clip_length": 64,
    "model.from_start": 0.4,
    "model.dropout": 0.1,
    "steps": 7000,
    "batch_size": 16,
    "save_freq": 250,
}
"""75 minutes on two cores with AVX2; 64 frames hold nearly every success of all four tasks."""

CPU_TEXT_MODEL: Final[Flags] = {
    "model.layers": 6,
    "model.width": 192,
    "model.patch": 4,
    "model.window": 48,
    "model.clip_length": 40,
    "steps": 12_000,
    "batch_size": 2,
    "save_freq": 500,
}
"""An hour too. Where a clip costs so much, many steps of two teach more than few of six."""

CPU_REINFORCEMENT: Final[Flags] = {
    "num_envs": 64,
    "iterations": 60,
    "save_freq": 10,
    "algorithm.type": "ppo",
    "algorithm.epochs": 2,
    "algorithm.initial_std": 0.3,
    "algorithm.value_iterations": 2,
}
"""A quarter of an hour in imagination on one core, for a policy that is cloned from few episodes."""

GPU_WORLD_MODEL: Final[Flags] = {
    "model.dynamics": "autoregressive",
    "model.layers": 12,
    "model.width": 512,
    "model.heads": 8,
    "model.window": 16,
    "model.clip_length": 28,
    "steps": 50_000,
    "batch_size": 16,
    "save_freq": 1000,
}
"""64 transformer tokens a frame of 128 pixels a side, beside the register."""

LFQ_TOKENIZER: Final[Flags] = {
    "model.tokenizer.quantizer": "lfq",
    "model.tokenizer.levels": "[512,512]",
    "steps": 50_000,
    "batch_size": 64,
    "save_freq": 1000,
}
"""MAGVIT-2's quantiser with 2^18 codes, in two factors of nine bits, at 128 pixels a side."""

PAPER_WORLD_MODEL: Final[Flags] = {
    "model.dynamics": "autoregressive",
    "model.layers": 32,
    "model.conditioning": "cross_attention",
    "model.width": 256,
    "model.heads": 8,
    "model.patch": 1,
    "model.window": 48,
    "model.clip_length": 28,
    "steps": 100_000,
    "batch_size": 16,
    "save_freq": 1000,
}
"""RoboScape's transformer and the paper's clips and window."""

SMALL_OPENVLA: Final[Flags] = {
    "policy.type": "openvla",
    "policy.sizes.image_size": DEMO_IMAGE_SIZE,
    "policy.sizes.patch_size": 8,
    "policy.sizes.dino.width": 48,
    "policy.sizes.dino.depth": 3,
    "policy.sizes.dino.mlp_size": 192,
    "policy.sizes.siglip.width": 48,
    "policy.sizes.siglip.depth": 3,
    "policy.sizes.siglip.mlp_size": 192,
    "policy.sizes.llama.width": 96,
    "policy.sizes.llama.depth": 3,
    "policy.sizes.llama.mlp_size": 256,
    "policy.optimizer_lr": 1e-3,
    "steps": 4000,
    "save_freq": 1000,
}
"""OpenVLA's parts at a size that one core can train from random weights; the rest is that of `sft`."""

PRESETS: Final[dict[str, dict[str, Flags]]] = {
    "tiny": {
        "train-world-model:frame_tokenizer": {
            "model.tokenizer.image_size": DEMO_IMAGE_SIZE,
            "model.tokenizer.widths": "[8,16]",
            "steps": 20,
            "batch_size": 8,
            "save_freq": 10,
            "log_freq": 5,
        },
        "train-world-model:action_world_model": TINY_WORLD_MODEL,
        "train-world-model:text_world_model": TINY_WORLD_MODEL,
        "eval-world-model": {"max_episodes": 8},
        "demo": {
            "stage_preset": "tiny",
            "sft_episodes": 3,
            "explore_episodes": 4,
            "eval_episodes": 4,
            "rollout_episodes": 4,
        },
        "sft": {
            "steps": 20,
            "batch_size": 8,
            "num_workers": 0,
            "env_eval_freq": 0,
            "save_freq": 10,
            "log_freq": 5,
        },
        "train": {
            "num_envs": 4,
            "iterations": 2,
            "save_freq": 1,
            "gate.action": "warn",
            "algorithm.type": "ppo",
            "algorithm.value_iterations": 1,
            "algorithm.minibatch_size": 64,
        },
        "eval": {"eval.batch_size": 1, "eval.use_async_envs": False},
        "eval-imagined": {"eval.batch_size": 4},
    },
    "demo": {
        "train-world-model:frame_tokenizer": {
            "model.tokenizer.image_size": DEMO_IMAGE_SIZE,
            "model.tokenizer.cameras": DEMO_CAMERAS,
            "model.tokenizer.context": True,
            "steps": 800,
            "batch_size": 48,
            "save_freq": 100,
        },
        "train-world-model:action_world_model": {
            "model.dynamics": "anchored",
            "model.layers": 4,
            "model.width": 192,
            "model.patch": 4,
            "model.clip_length": 44,
            "model.from_start": 0.4,
            "model.dropout": 0.1,
            "steps": 2500,
            "batch_size": 16,
            "save_freq": 250,
        },
        "train-world-model:text_world_model": {
            "model.patch": 4,
            "model.layers": 3,
            "steps": 400,
            "batch_size": 6,
            "save_freq": 100,
        },
        "eval-world-model": STRICT_DONE,
        "demo": {
            "stage_preset": "demo",
            "sft_episodes": 8,
            "explore_episodes": 300,
            "eval_episodes": 100,
            "rollout_episodes": 60,
        },
        "sft": {
            "steps": 400,
            "batch_size": 32,
            "num_workers": 1,
            "prefetch_factor": 8,
            "dataset.return_uint8": True,
            "env_eval_freq": 0,
            "save_freq": 100,
            "log_freq": 20,
        },
        "sft:openvla": SMALL_OPENVLA,
        "train": {
            "num_envs": 64,
            "iterations": 40,
            "save_freq": 10,
            "gate.action": "warn",
            "env.type": "world_model",
            "env.dataset.max_starts": 1024,
            **{f"env.{name}": value for name, value in STRICT_DONE.items()},
            "algorithm.type": "ppo",
            "algorithm.epochs": 2,
            "algorithm.initial_std": 0.3,
            "algorithm.value_iterations": 2,
        },
        "eval": {"eval.batch_size": 2, "eval.use_async_envs": True, "env.cameras": DEMO_CAMERAS},
        "eval-imagined": {
            "eval.batch_size": 50,
            **{f"env.{name}": value for name, value in STRICT_DONE.items()},
        },
    },
    "cpu": {
        "train-world-model:frame_tokenizer": CPU_TOKENIZER,
        "train-world-model:action_world_model": CPU_ACTION_MODEL,
        "train-world-model:text_world_model": CPU_TEXT_MODEL,
        "train": CPU_REINFORCEMENT,
    },
    "gpu": {
        "train-world-model:frame_tokenizer": LFQ_TOKENIZER,
        "train-world-model:action_world_model": GPU_WORLD_MODEL,
        "train-world-model:text_world_model": GPU_WORLD_MODEL,
    },
    "paper": {
        "train-world-model:frame_tokenizer": LFQ_TOKENIZER,
        "train-world-model:action_world_model": PAPER_WORLD_MODEL,
        "train-world-model:text_world_model": PAPER_WORLD_MODEL,
    },
}
"""Size → command → flags. `train-world-model:frame_tokenizer` adds to `train-world-model` for that type."""


def format_flags(flags: Flags) -> list[str]:
    """`{"a.b": 1, "c": True}` → `["--a.b=1", "--c=true"]`, the form draccus parses."""
    return [
        f"--{name}={str(value).lower() if isinstance(value, bool) else value}"
        for name, value in flags.items()
    ]


def preset_flags(preset: str, command: str, types: Sequence[str] = ()) -> list[str]:
    """The flags of `command` at size `preset`, then those of `command:type`. ValueError if there are none."""
    if preset not in PRESETS:
        raise ValueError(f"--preset={preset}: unknown preset; choose one of {', '.join(PRESETS)}")
    keys = [command, *(f"{command}:{name}" for name in types)]
    if not PRESETS[preset].keys() & set(keys):
        known = [key.partition(":")[2] for key in PRESETS[preset] if key.startswith(f"{command}:")]
        if known and not types:
            raise ValueError(f"--preset={preset}: {command} has one a type; give a type: {', '.join(known)}")
        sizes = ", ".join(name for name, commands in PRESETS.items() if commands.keys() & set(keys)) or "none"
        raise ValueError(f"--preset={preset}: {command} has no such preset; it has: {sizes}")
    return [flag for key in keys for flag in format_flags(PRESETS[preset].get(key, {}))]


def expand_preset(argv: Sequence[str], command: str) -> list[str]:
    """Replace `--preset=NAME` in `argv` by that preset's flags, which later flags override."""
    split = [argument.partition("=") for argument in argv]
    types = {name: value for name, _, value in split if name.endswith(TYPE)}
    expanded: list[str] = []
    for argument, (name, separator, value) in zip(argv, split, strict=True):
        if name == "--preset" and separator:
            expanded += still_meant(preset_flags(value, command, list(types.values())), types)
        else:
            expanded.append(argument)
    return expanded


def still_meant(flags: Sequence[str], types: Mapping[str, str]) -> list[str]:
    """Without the settings of what is of another type now: PPO's, where `types` has GRPO."""
    presets = dict(flag.split("=", 1) for flag in flags)
    replaced = [
        name.removesuffix(TYPE) + "." for name in types if presets.get(name, types[name]) != types[name]
    ]
    return [flag for flag in flags if not flag.startswith(tuple(replaced))]

"""Small models trained for a few steps by the real training code, for tests that need trained ones."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import torch

from lerobot_wmrl.data.dataset import TrainingData
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig, train_world_model
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig, TokenizerConfig
from lerobot_wmrl.world_models.configuration_world_model import (
    ActionWorldModelConfig,
    DynamicsConfig,
    TextWorldModelConfig,
)

SIZES: dict[str, Any] = {"layers": 1, "width": 32, "heads": 2, "code_width": 8}
CLIP_LENGTH = 10


def nested(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of a world model, of which those that are its dynamics' are given beside the others."""
    kind = DynamicsConfig.get_choice_class(settings.get("dynamics", "anchored"))
    own = {field.name for field in fields(kind)} & settings.keys()
    others = {name: value for name, value in settings.items() if name not in own}
    return {**others, "dynamics": kind(**{name: settings[name] for name in own})}


def run_training(config: Any, root: Path, output_dir: Path, steps: int = 3, **settings: Any) -> Path:
    """Train `config`'s model on the dataset at `root`; returns the output folder."""
    options = {"batch_size": 2, "save_freq": 1, "log_freq": 1, "precision": "float32", **settings}
    train_world_model(
        TrainWorldModelConfig(
            model=config, dataset=TrainingData(str(root)), output_dir=output_dir, steps=steps, **options
        )
    )
    return output_dir


def small_tokenizer(**settings: Any) -> TokenizerConfig:
    """Sizes for 32x32 images, 16 tokens of 20 codes a camera."""
    return TokenizerConfig(**{"image_size": 32, "widths": [8, 16], "levels": [5, 4], **settings})


def tokenizer_config(**settings: Any) -> FrameTokenizerConfig:
    """A small frame tokenizer."""
    return FrameTokenizerConfig(tokenizer=small_tokenizer(**settings), device="cpu")


def train_tokenizer(root: Path, output_dir: Path, **settings: Any) -> Path:
    """The tokenizer above, trained."""
    return run_training(tokenizer_config(), root, output_dir, **settings)


def action_config(tokenizer: Path, **settings: Any) -> ActionWorldModelConfig:
    """A small action world model; settings of its dynamics stand beside the others."""
    options = {**SIZES, "clip_length": CLIP_LENGTH, **settings}
    return ActionWorldModelConfig(tokenizer_path=str(tokenizer), device="cpu", **nested(options))


PUSH, PULL = "push the red square", "pull the red square"


def told_apart(root: Path, folder: Path) -> Path:
    """An action world model of a dataset with both instructions, which read success very differently."""
    config = tokenizer_config(context=True, success=True, instructions=True)
    tokenizer = run_training(config, root, folder / "frame_tokenizer")
    path = run_training(action_config(tokenizer), root, folder / "action_world_model")
    model = load_model(path, "action_world_model")
    torch.manual_seed(0)
    torch.nn.init.normal_(model.tokenizer.success.instructions.encoder.project.weight, std=0.5)
    model.save_pretrained(folder / "told_apart")
    return folder / "told_apart"


def text_config(tokenizer: Path, **settings: Any) -> TextWorldModelConfig:
    """A small autoregressive text world model; settings of its dynamics stand beside the others."""
    options = {
        **SIZES,
        "clip_length": CLIP_LENGTH,
        "goal_horizon": 6,
        "dynamics": "autoregressive",
        "conditioning": "cross_attention",
        **settings,
    }
    return TextWorldModelConfig(tokenizer_path=str(tokenizer), device="cpu", **nested(options))

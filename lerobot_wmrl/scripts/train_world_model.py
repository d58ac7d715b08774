"""lerobot-wmrl-train-world-model: train a frame tokenizer or a world model on a LeRobotDataset.

    lerobot-wmrl-train-world-model --model.type=frame_tokenizer --dataset.root=D \\
        --output_dir=outputs/tokenizer
    lerobot-wmrl-train-world-model --model.type=action_world_model --model.tokenizer_path=outputs/tokenizer \\
        --dataset.root=D --output_dir=outputs/action_world_model

Running the same command again continues from the last checkpoint. `--preset=demo` sets the sizes.
"""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import draccus
from lerobot.configs.rewards import RewardModelConfig

from lerobot_wmrl.command import RunConfig, claim_output_dir, require_free, run_command
from lerobot_wmrl.dataset_source import DatasetSource
from lerobot_wmrl.malloc import keep_freed_memory
from lerobot_wmrl.presets import expand_preset
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig
from lerobot_wmrl.world_models.configuration_world_model import WorldModelConfig

TRAINED = ("frame_tokenizer", "action_world_model", "text_world_model")


@dataclass
class TrainWorldModelConfig(RunConfig):
    """Train a tokenizer or world model.

    `--preset=tiny` or `--preset=demo` stands for the flags of that size; flags further right override it.

    Args:
        model: `--model.type=frame_tokenizer|action_world_model|text_world_model` and its settings.
        dataset: the LeRobotDataset to learn from.
        output_dir: where checkpoints and metrics go; continues if it holds this run already.
        steps, batch_size: optimiser steps, and frames (tokenizer) or clips (world models) a step.
        save_freq, log_freq: steps between checkpoints and between lines of metrics.jsonl.
        seed: of initial weights and batches.
    """

    model: RewardModelConfig = field(default_factory=FrameTokenizerConfig)
    dataset: DatasetSource = field(default_factory=DatasetSource)
    output_dir: Path = Path("outputs/world_model")
    steps: int = 20_000
    batch_size: int = 8
    save_freq: int = 500
    log_freq: int = 20
    seed: int = 0


def check_config(cfg: TrainWorldModelConfig) -> None:
    """ValueError names the setting that cannot be."""
    if cfg.model.type not in TRAINED:
        raise ValueError(f"--model.type={cfg.model.type}: this command trains {', '.join(TRAINED)}")
    for name in ("steps", "batch_size", "save_freq", "log_freq"):
        if getattr(cfg, name) < 1:
            raise ValueError(f"--{name}={getattr(cfg, name)}: must be at least 1")


def check_tokenizer_path(model: RewardModelConfig) -> None:
    """ValueError if a world model would learn the codes of an untrained tokenizer."""
    if isinstance(model, WorldModelConfig) and not model.tokenizer_path:
        raise ValueError(
            "--model.tokenizer_path is missing: give the output folder of a training with "
            "--model.type=frame_tokenizer"
        )


def train_world_model(cfg: TrainWorldModelConfig) -> None:
    """Build or reload the model, cache the data, train; a tokenizer's held-out accuracy goes beside it."""
    from lerobot.utils.random_utils import set_seed

    from lerobot_wmrl.checkpoints import latest_checkpoint
    from lerobot_wmrl.world_models.episode_table import open_dataset, read_episodes
    from lerobot_wmrl.world_models.reconstruction import write_reconstruction
    from lerobot_wmrl.world_models.training import build_model, make_sampler, train

    check_config(cfg)
    table = read_episodes(open_dataset(cfg.dataset.root, cfg.dataset.repo_id))
    given = draccus.encode(cfg)
    checkpoint = latest_checkpoint(cfg.output_dir)
    if checkpoint is not None and int(checkpoint.name) >= cfg.steps:
        claim_output_dir(cfg.output_dir, given)
        print(f"{cfg.output_dir}: already trained for {cfg.steps} steps")
        return
    if checkpoint is None:
        check_tokenizer_path(cfg.model)
    set_seed(cfg.seed)
    model = build_model(cfg.model, table, cfg.output_dir)
    require_free(cfg.output_dir, given)
    sampler = make_sampler(model, table, cfg.batch_size, cfg.seed)
    claim_output_dir(cfg.output_dir, given)
    train(model, sampler, cfg, cfg.save_pretrained)
    if isinstance(cfg.model, FrameTokenizerConfig):
        write_reconstruction(model, table, cfg.output_dir)


def main() -> None:
    """Entry point of the console command."""
    keep_freed_memory()
    run_command(train_world_model, TrainWorldModelConfig, partial(expand_preset, command="train-world-model"))


if __name__ == "__main__":
    main()

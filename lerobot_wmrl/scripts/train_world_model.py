"""lerobot-wmrl-train-world-model: train a frame tokenizer or a world model on a LeRobotDataset.

    lerobot-wmrl-train-world-model --model.type=frame_tokenizer --dataset.root=D \\
        --output_dir=outputs/tokenizer
    lerobot-wmrl-train-world-model --model.type=action_world_model --model.tokenizer_path=outputs/tokenizer \\
        --dataset.root=D --output_dir=outputs/action_world_model

Running the same command again continues from the last checkpoint. `--preset=demo` sets the sizes.
`--model.path=outputs/action_world_model` instead of a type trains a trained model further, on other data say.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import draccus
from accelerate import PartialState
from lerobot.configs import parser
from lerobot.configs.rewards import RewardModelConfig

from lerobot_wmrl.common.command_line import RunConfig, claim_output_dir, require_free, run_command
from lerobot_wmrl.common.distributed import LONGEST_WAIT
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.malloc import keep_freed_memory
from lerobot_wmrl.common.precision import PRECISIONS, training_dtype
from lerobot_wmrl.common.presets import expand_preset
from lerobot_wmrl.data.episodes import TrainingData
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig

TRAINED = ("frame_tokenizer", "action_world_model", "text_world_model")


@dataclass
class TrainWorldModelConfig(RunConfig):
    """Train a tokenizer or world model.

    `--preset=tiny|demo|cpu|gpu|paper` stands for the flags of that size; flags further right override it.

    Args:
        model: `--model.type=frame_tokenizer|action_world_model|text_world_model` and its settings; or
            `--model.path=`, a trained one to begin with, and those of its settings that are to be others.
        dataset: the LeRobotDataset to learn from, or some of its episodes; and `more` of them.
        output_dir: where checkpoints and metrics go; continues if it holds this run already.
        steps, batch_size: optimiser steps, and frames (tokenizer) or clips (world models) a step.
            Under `torchrun --nproc_per_node=N` every process has `batch_size` of them.
        save_freq, log_freq: steps between checkpoints and between lines of metrics.jsonl.
        seed: of initial weights and batches.
        precision: `float32`, `bfloat16` (mixed: weights and losses stay in float32), or `auto`: bfloat16 if
            the device multiplies in it. The checkpoints' train_config.json tells which it was.
    """

    path_fields: ClassVar[list[str]] = ["model"]

    model: RewardModelConfig = field(default_factory=FrameTokenizerConfig)
    dataset: TrainingData = field(default_factory=TrainingData)
    output_dir: Path = Path("outputs/world_model")
    steps: int = 20_000
    batch_size: int = 8
    save_freq: int = 500
    log_freq: int = 20
    seed: int = 0
    precision: str = "auto"


def check_config(cfg: TrainWorldModelConfig) -> None:
    """ValueError names the setting that cannot be."""
    if cfg.model.type not in TRAINED:
        raise ValueError(f"--model.type={cfg.model.type}: this command trains {', '.join(TRAINED)}")
    for name in ("steps", "batch_size", "save_freq", "log_freq"):
        if getattr(cfg, name) < 1:
            raise ValueError(f"--{name}={getattr(cfg, name)}: must be at least 1")
    if cfg.precision not in PRECISIONS:
        raise ValueError(f"--precision={cfg.precision}: choose one of {', '.join(PRECISIONS)}")
    if cfg.model.push_to_hub and not cfg.model.repo_id:
        raise ValueError("--model.push_to_hub=true: give its name on the hub, --model.repo_id=user/name")


def check_processes(cfg: TrainWorldModelConfig, processes: int) -> None:
    """ValueError for what cannot be shared: LFQ's entropy is of the whole batch, and the library's is not."""
    if (
        processes > 1
        and isinstance(cfg.model, FrameTokenizerConfig)
        and cfg.model.tokenizer.quantizer == "lfq"
    ):
        raise FieldError(
            "tokenizer.quantizer", "lfq", "trains in one process only", "leave torchrun out, or take fsq"
        )


def publish(model: Any, cfg: TrainWorldModelConfig) -> None:
    """Upload the trained model if `--model.push_to_hub=true`."""
    if cfg.model.push_to_hub and PartialState().is_main_process:
        model.push_model_to_hub(cfg)
        print(f"{cfg.output_dir}: published as {cfg.model.repo_id}")


def train_world_model(cfg: TrainWorldModelConfig) -> None:
    """Build or reload the model, cache the data, train; a tokenizer's held-out accuracy goes beside it."""
    from lerobot.utils.random_utils import set_seed

    from lerobot_wmrl.common.checkpoints import latest_checkpoint
    from lerobot_wmrl.data.episodes import open_dataset, read_episodes
    from lerobot_wmrl.evaluation.reconstruction import write_reconstruction
    from lerobot_wmrl.world_models.checkpoint import config_to_continue
    from lerobot_wmrl.world_models.training import build_model, make_joint_sampler, train

    if path := parser.get_path_arg("model"):
        cfg.model = config_to_continue(path, parser.get_cli_overrides("model") or [])
    check_config(cfg)
    processes = PartialState(cpu=cfg.model.device == "cpu", timeout=LONGEST_WAIT)
    check_processes(cfg, processes.num_processes)
    table = read_episodes(open_dataset(cfg.dataset.root, cfg.dataset.repo_id))
    given = draccus.encode(cfg)
    checkpoint = latest_checkpoint(cfg.output_dir)
    set_seed(cfg.seed)
    model = build_model(cfg.model, table, cfg.output_dir)
    require_free(cfg.output_dir, given)
    if checkpoint is not None and int(checkpoint.name) >= cfg.steps:
        claim_output_dir(cfg.output_dir, given)
        print(f"{cfg.output_dir}: already trained for {cfg.steps} steps")
    else:
        with processes.main_process_first():
            seed = cfg.seed + processes.process_index
            sampler = make_joint_sampler(model, table, cfg.dataset, cfg.batch_size, seed)
            if processes.is_main_process:
                claim_output_dir(cfg.output_dir, given)
        dtype = training_dtype(cfg.precision, cfg.model.device)
        used = replace(cfg, precision=str(dtype).removeprefix("torch."))
        train(model, sampler, used, used.save_pretrained)
    if isinstance(cfg.model, FrameTokenizerConfig) and processes.is_main_process:
        write_reconstruction(model, table, cfg.output_dir)
    publish(model, cfg)


def main() -> None:
    """Entry point of the console command."""
    keep_freed_memory()
    run_command(train_world_model, TrainWorldModelConfig, partial(expand_preset, command="train-world-model"))
    PartialState().destroy_process_group()


if __name__ == "__main__":
    main()

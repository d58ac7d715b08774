"""lerobot-wmrl-train-world-model: train a frame tokenizer or a world model on a LeRobotDataset.

    lerobot-wmrl-train-world-model --model.type=frame_tokenizer --dataset.root=D \\
        --output_dir=outputs/tokenizer
    lerobot-wmrl-train-world-model --model.type=action_world_model --model.tokenizer_path=outputs/tokenizer \\
        --dataset.root=D --output_dir=outputs/action_world_model

Running the same command again continues from the last checkpoint. `--preset=demo` sets the sizes.
`--model.path=outputs/action_world_model` in place of `--model.type` trains that model further, for example on
new data.
"""

import json
import shlex
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import draccus
from accelerate import PartialState
from lerobot.configs.default import WandBConfig
from lerobot.configs.rewards import RewardModelConfig
from lerobot.utils.random_utils import set_seed

from lerobot_wmrl.common.checkpoints import link_latest, model_folder, newest_checkpoint, require_resumable
from lerobot_wmrl.common.command_line import RunConfig, run_command
from lerobot_wmrl.common.distributed import LONGEST_WAIT, is_first_process, process_seed
from lerobot_wmrl.common.errors import FieldError, renamed, require_at_least, require_choice, within
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.flags import format_flags
from lerobot_wmrl.common.output_folders import RUN_CONFIG_FILE, Claim
from lerobot_wmrl.common.precision import PRECISIONS, keep_freed_memory, training_dtype
from lerobot_wmrl.common.presets import expand_preset
from lerobot_wmrl.common.tracking import make_wandb, read_metrics
from lerobot_wmrl.data.dataset import TrainingData, fingerprint
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.data.ledger import Ledger
from lerobot_wmrl.evaluation.reconstruction import write_reconstruction
from lerobot_wmrl.maniskill.recordings import require_unreported
from lerobot_wmrl.world_models.checkpoint import config_to_continue
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig
from lerobot_wmrl.world_models.training import build_model, held_out_metrics, train
from lerobot_wmrl.world_models.training_data import (
    decide_on_instructions,
    decide_on_range,
    make_joint_sampler,
)

TRAINED = ("frame_tokenizer", "action_world_model", "text_world_model")

MAY_DIFFER = ("resume", "job_name", "log_freq", "wandb")
"""Settings that a continued run may have otherwise than when it began."""

HELD_OUT_FILE = "held_out.json"


@dataclass
class TrainWorldModelConfig(RunConfig):
    """Train a tokenizer or world model.

    Args:
        model: `--model.type=frame_tokenizer|action_world_model|text_world_model` and its settings. Or
            `--model.path=FOLDER`, a trained model to train further, and the settings that change.
        dataset: the LeRobotDataset to learn from.
        budget: ledger of the real episodes that a method may learn from, a JSON file (docs/protocol.md). It
            must know all episodes of `dataset`.
        output_dir: folder of checkpoints and metrics. If it holds this run already, the run continues.
        steps: optimizer steps.
        batch_size: frames (tokenizer) or clips (world models) in a step. Under `torchrun --nproc_per_node=N`
            every process has that many.
        save_freq: steps between checkpoints.
        log_freq: steps between lines of metrics.jsonl.
        seed: seed of the initial weights and of the batches.
        precision: `float32`; `bfloat16`, with weights and losses in float32; or `auto`, which is bfloat16
            where the device has hardware for it. train_config.json says which one was used.
        resume: require a checkpoint in `output_dir` and continue from it, as in lerobot-train. Works with
            `--config_path=outputs/tokenizer/train_config.json`, or that of a checkpoint, in place of all
            other flags too.
        wandb: `--wandb.enable=true` sends the metrics to Weights & Biases too, as lerobot-train does.
        job_name: name of the run in Weights & Biases; by default the name of `output_dir`.
    """

    path_fields: ClassVar[list[str]] = ["model"]
    env: ClassVar[None] = None
    is_reward_model_training: ClassVar[bool] = True

    model: RewardModelConfig = field(default_factory=FrameTokenizerConfig)
    dataset: TrainingData = field(default_factory=TrainingData)
    budget: Path | None = None
    output_dir: Path = Path("outputs/world_model")
    steps: int = 20_000
    batch_size: int = 8
    save_freq: int = 500
    log_freq: int = 20
    seed: int = 0
    precision: str = "auto"
    resume: bool = False
    wandb: WandBConfig = field(default_factory=WandBConfig)
    job_name: str | None = None

    @property
    def reward_model(self) -> RewardModelConfig:
        """The model, by the name that LeRobot's WandBLogger has for it."""
        return self.model

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as LeRobot's WandBLogger asks for them."""
        return draccus.encode(self)

    def validate(self) -> None:
        """Raise FieldError for a setting that cannot be."""
        if self.model.type not in TRAINED:
            raise FieldError("model.type", self.model.type, f"this command trains {', '.join(TRAINED)}")
        require_at_least(self, 1, "steps", "batch_size", "save_freq", "log_freq")
        require_choice(self, "precision", PRECISIONS)
        if isinstance(self.model, FrameTokenizerConfig) and self.model.tokenizer.success:
            require_at_least(self, 2, "batch_size")  # features are normalised over the batch
        if self.model.push_to_hub:
            from lerobot_wmrl.common.hub import check_login

            if not self.model.repo_id:
                raise FieldError("model.push_to_hub", True, "needs a name on the hub", "give `model.repo_id`")
            with within("model"):
                check_login()


def check_processes(cfg: TrainWorldModelConfig, processes: int) -> None:
    """Raise FieldError for LFQ in several processes: its entropy is that of the whole batch."""
    tokenizer = cfg.model.tokenizer if isinstance(cfg.model, FrameTokenizerConfig) else None
    if processes > 1 and tokenizer is not None and tokenizer.quantizer == "lfq":
        raise FieldError(
            "tokenizer.quantizer", "lfq", "trains in one process only", "leave torchrun out, or take fsq"
        )


def check_data(cfg: TrainWorldModelConfig, table: EpisodeTable) -> None:
    """Raise FieldError for an episode that must not be learnt from.

    These are episodes on which results are reported, and, with a budget, those that are not in its ledger.
    """

    def check_table(table: EpisodeTable, chosen: list[int] | None) -> None:
        learnt = table.training(chosen).nonzero()[0]
        require_unreported(table, learnt, "choose others with `dataset.episodes`")
        if cfg.budget is not None:
            Ledger(cfg.budget).require_known(table, table.among(chosen).nonzero()[0])

    check_table(table, cfg.dataset.episodes)
    with renamed("dataset.root", "dataset.more"):
        for further in cfg.dataset.read_more():
            check_table(further, None)


def train_world_model(cfg: TrainWorldModelConfig) -> None:
    """Build or reload the model, train it, measure it on held-out episodes, publish it."""
    path, settings = cfg.given["model"]
    if path:
        cfg.model = config_to_continue(path, settings)
    cfg.validate()
    if cfg.resume:
        require_resumable(cfg.output_dir)
    processes = PartialState(cpu=cfg.model.device == "cpu", timeout=LONGEST_WAIT)
    check_processes(cfg, processes.num_processes)
    table = read_episodes(cfg.dataset.open())
    check_data(cfg, table)
    cfg.precision = precision_of(cfg)
    begun = deepcopy(cfg)  # the model fills in what it takes from the data
    claim = Claim(cfg.output_dir, draccus.encode(begun), MAY_DIFFER, fingerprints(cfg, table))
    checkpoint = newest_checkpoint(cfg.output_dir)
    set_seed(cfg.seed)
    claim.check()
    if is_first_process():
        link_latest(cfg.output_dir)
    if checkpoint is None:
        decide_on_instructions(cfg.model, table, cfg.dataset)
        decide_on_range(cfg.model, table, cfg.dataset.episodes)
    model: Any = build_model(cfg.model, table, cfg.output_dir)
    if checkpoint is not None and int(checkpoint.name) >= cfg.steps:
        print(f"{cfg.output_dir}: already trained for {cfg.steps} steps")
    else:
        run_training(begun, claim, model, table, processes)
    if is_first_process():
        print(f"\n{conclusion(cfg, model, table)}")
        if cfg.model.push_to_hub:
            with within("model"):
                model.push_model_to_hub(begun)
            print(f"Published as {cfg.model.repo_id}.")


def precision_of(cfg: TrainWorldModelConfig) -> str:
    """Return the format to train in. `auto` is what the training in the output folder was begun with, which
    may have been on another machine."""
    begun = cfg.output_dir / RUN_CONFIG_FILE
    if cfg.precision == "auto" and begun.is_file():
        return str(json.loads(begun.read_text()).get("precision", "auto"))
    return str(training_dtype(cfg.precision, cfg.model.device)).removeprefix("torch.")


def fingerprints(cfg: TrainWorldModelConfig, table: EpisodeTable) -> dict[str, str]:
    """Return a digest of each dataset, by the setting that names it."""
    more = {f"dataset.more {root}": root for root in cfg.dataset.more}
    return {name: fingerprint(Path(root)) for name, root in {"dataset": table.dataset.root, **more}.items()}


def run_training(
    cfg: TrainWorldModelConfig, claim: Claim, model: Any, table: EpisodeTable, processes: PartialState
) -> None:
    """Cache the data, in the first process before the others, and train."""
    with ExitStack() as held:
        with processes.main_process_first():
            sampler = make_joint_sampler(model, table, cfg.dataset, cfg.batch_size, process_seed(cfg.seed))
            if is_first_process():
                held.enter_context(claim.held())
        train(model, sampler, cfg, cfg.save_pretrained, make_wandb(cfg))


def conclusion(cfg: TrainWorldModelConfig, model: Any, table: EpisodeTable) -> str:
    """Measure the trained model and say what was made, how good it is and what comes next."""
    size = sum(path.stat().st_size for path in model_folder(cfg.output_dir).glob("*.safetensors"))
    parameters = sum(parameter.numel() for parameter in model.parameters())
    made = f"{parameters:,} parameters, {size / 1e6:.1f} MB"
    return (
        f"{cfg.output_dir}: a {cfg.model.type} of {made}.\n{quality(cfg, model, table)}\n"
        f"Next:\n  {next_command(cfg)}"
    )


def quality(cfg: TrainWorldModelConfig, model: Any, table: EpisodeTable) -> str:
    """Say how good the model is on episodes that are held out, or in training if none is."""
    if isinstance(cfg.model, FrameTokenizerConfig):
        measured = write_reconstruction(model, table, cfg.output_dir, cfg.dataset.episodes)
        psnr = ", ".join(f"{camera} {value:.1f} dB" for camera, value in measured["psnr"].items())
        split = "held-out episodes" if measured["split"] == "validation" else "the episodes it was trained on"
        return f"PSNR on {split}: {psnr}."
    measured = held_out_metrics(model, table, cfg.batch_size, cfg.dataset.episodes)
    if measured:
        write_json(cfg.output_dir / HELD_OUT_FILE, measured)
    where = (
        "held-out episodes" if measured else "the last training batch (none of these episodes is held out)"
    )
    measured = measured or read_metrics(cfg.output_dir)[-1]
    done = ("done_loss",) if table.has_labels else ()
    shown = ("loss", "token_accuracy", "moving_token_accuracy", *done, "state_loss")
    values = ", ".join(f"{name.replace('_', ' ')} {measured[name]:.3f}" for name in shown if name in measured)
    return f"On {where}: {values}."


def next_command(cfg: TrainWorldModelConfig) -> str:
    """Return the command that usually follows."""
    data, folder = format_flags(cfg.dataset.flags()), cfg.output_dir.parent
    evaluate, world_model = "lerobot-wmrl-eval-world-model", folder / "action_world_model"
    if cfg.model.type == "frame_tokenizer":
        kind = ["--model.type=action_world_model", f"--model.tokenizer_path={cfg.output_dir}"]
        learnt = {"dataset.more": cfg.dataset.more, "budget": cfg.budget}
        kind += format_flags({name: value for name, value in learnt.items() if value})
        command, new = ["lerobot-wmrl-train-world-model", *cfg.typed_preset, *kind], world_model
    elif cfg.model.type == "text_world_model":
        models = [f"--model.path={world_model}", f"--text_model.path={cfg.output_dir}"]
        command, new = [evaluate, *models], folder / "check"
    else:
        command, new = [evaluate, f"--model.path={cfg.output_dir}"], folder / "check"
    return shlex.join([*command, *data, f"--output_dir={new}"])


def main() -> None:
    """Entry point of the console command."""
    keep_freed_memory()
    run_command(train_world_model, TrainWorldModelConfig, partial(expand_preset, command="train-world-model"))
    PartialState().destroy_process_group()


if __name__ == "__main__":
    main()

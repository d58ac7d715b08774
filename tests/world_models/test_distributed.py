"""Two processes take the steps that the mean of their gradients gives, each from a seed of its own."""

import json
from pathlib import Path
from typing import Any

import draccus
import pytest
import torch
from lerobot.utils.random_utils import get_rng_state, set_rng_state, set_seed
from safetensors.torch import load_file

from lerobot_wmrl.common.distributed import PROCESS_STRIDE
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig, train_world_model
from lerobot_wmrl.world_models.configuration_frame_tokenizer import cosine_schedule
from lerobot_wmrl.world_models.training import build_model
from lerobot_wmrl.world_models.training_data import make_joint_sampler
from tests.torchrun import torchrun

SCRIPT = Path(__file__).with_name("trainings.py")
TRAINED_WEIGHTS = "checkpoints/last/pretrained_model/model.safetensors"
PROCESSES, STEPS, BATCH = 2, 6, 8
SIZES = {
    "frame_tokenizer": [
        "--model.tokenizer.image_size=32",
        "--model.tokenizer.widths=[8,16]",
        "--model.tokenizer.levels=[5,4]",
    ],
    "action_world_model": [
        "--model.dynamics.type=autoregressive",
        "--model.dynamics.layers=1",
        "--model.dynamics.width=32",
        "--model.dynamics.heads=2",
        "--model.dynamics.code_width=8",
        "--model.clip_length=14",
        "--model.dynamics.self_rollout=0.5",
        "--model.dynamics.keypoint_weight=1",
    ],
    "text_world_model": [
        "--model.dynamics.type=anchored",
        "--model.dynamics.layers=1",
        "--model.dynamics.width=32",
        "--model.dynamics.heads=2",
        "--model.dynamics.code_width=8",
        "--model.clip_length=14",
        "--model.dynamics.dropout=0.1",
        "--model.state_size=0",
    ],
}

RUNNING = ("running_mean", "running_var", "num_batches_tracked")
"""Statistics of the training frames, which batch normalisation keeps."""


def flags(model: str, root: Path, tokenizer: Path, output_dir: Path, batch: int) -> list[str]:
    """Flags of a training in which every process draws `batch` rows a step."""
    source = [] if model == "frame_tokenizer" else [f"--model.tokenizer_path={tokenizer}"]
    return [
        f"--model.type={model}",
        "--model.device=cpu",
        *source,
        *SIZES[model],
        f"--dataset.root={root}",
        f"--output_dir={output_dir}",
        f"--batch_size={batch}",
        f"--steps={STEPS}",
        "--log_freq=1",
        "--save_freq=3",
        "--precision=float32",
    ]


def parsed(*arguments: Any) -> TrainWorldModelConfig:
    return draccus.parse(TrainWorldModelConfig, args=flags(*arguments))


def averaged_training(cfg: TrainWorldModelConfig) -> tuple[dict[str, torch.Tensor], list[float]]:
    """Train in this process as if it were all of them. Return the weights and the mean losses."""
    table = read_episodes(open_dataset(cfg.dataset.root))
    set_seed(cfg.seed)
    model = build_model(cfg.model, table, cfg.output_dir).train()
    preset: Any = model.config.get_optimizer_preset()
    optimizer = preset.build([p for p in model.parameters() if p.requires_grad])
    scheduler = cosine_schedule(preset.lr, cfg.steps).build(optimizer, cfg.steps)
    samplers, states, losses = [], [], []
    for rank in range(PROCESSES):
        samplers.append(
            make_joint_sampler(model, table, cfg.dataset, cfg.batch_size, cfg.seed + PROCESS_STRIDE * rank)
        )
        set_seed(cfg.seed + PROCESS_STRIDE * rank)
        states.append(get_rng_state())
    for step in range(cfg.steps):
        optimizer.zero_grad()
        means = []
        for rank, sampler in enumerate(samplers):
            set_rng_state(states[rank])
            loss, _ = model(sampler(step), step / cfg.steps)
            (loss / PROCESSES).backward()
            states[rank] = get_rng_state()
            means.append(loss.item() / PROCESSES)
        torch.nn.utils.clip_grad_norm_(model.parameters(), preset.grad_clip_norm)
        optimizer.step()
        scheduler.step()
        losses.append(sum(means))
    return model.state_dict(), losses


@pytest.fixture(scope="module")
def trained_by_two(small_dataset, trained_models, tmp_path_factory) -> Path:
    """The folder with every model as two processes trained it."""
    root, tokenizer = Path(small_dataset.root), trained_models["frame_tokenizer"]
    two = tmp_path_factory.mktemp("two")
    runs = [json.dumps(flags(model, root, tokenizer, two / model, BATCH // PROCESSES)) for model in SIZES]
    torchrun(SCRIPT, *runs)
    return two


@pytest.mark.parametrize("model", SIZES)
def test_two_processes_average_their_gradients(
    model, trained_by_two, small_dataset, trained_models, tmp_path
):
    root, tokenizer = Path(small_dataset.root), trained_models["frame_tokenizer"]
    cfg = parsed(model, root, tokenizer, tmp_path / "none", BATCH // PROCESSES)
    expected, losses = averaged_training(cfg)
    logged = read_metrics(trained_by_two / model)
    assert [line["step"] for line in logged] == list(range(1, STEPS + 1))
    assert [line["loss"] for line in logged] == pytest.approx(losses, rel=1e-4)
    weights = load_file(trained_by_two / model / TRAINED_WEIGHTS)
    for name, value in weights.items():
        if not name.endswith(RUNNING):  # those of the first process
            torch.testing.assert_close(value, expected[name], rtol=1e-3, atol=1e-5)
    assert sorted(path.name for path in (trained_by_two / model / "checkpoints").iterdir()) == [
        "000003",
        "000006",
        "last",
    ]


@pytest.mark.parametrize("model", SIZES)
def test_two_processes_have_the_objective_of_one_with_the_whole_batch(
    model, trained_by_two, small_dataset, trained_models, tmp_path
):
    """Other samples, the same loss curve but for their spread."""
    root, tokenizer = Path(small_dataset.root), trained_models["frame_tokenizer"]
    train_world_model(parsed(model, root, tokenizer, tmp_path / "one", BATCH))
    one, two = (
        sum(line["loss"] for line in read_metrics(folder)) / STEPS
        for folder in (tmp_path / "one", trained_by_two / model)
    )
    assert two == pytest.approx(one, rel=0.1)


def test_a_run_goes_on_with_as_many_processes_as_it_began_with(trained_by_two, small_dataset, trained_models):
    folder = trained_by_two / "action_world_model"
    last = folder / "checkpoints" / "000006"
    last.rename(folder / "000006")
    again = parsed(
        "action_world_model",
        Path(small_dataset.root),
        trained_models["frame_tokenizer"],
        folder,
        BATCH // PROCESSES,
    )
    with pytest.raises(FieldError, match=r"began with 2 processes, here are 1; .*--nproc_per_node=2"):
        train_world_model(again)
    (folder / "000006").rename(last)

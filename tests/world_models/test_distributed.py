"""Two processes that each have half of the batch learn what one process learns from all of it."""

import json
from pathlib import Path

import draccus
import pytest
import torch
from safetensors.torch import load_file

from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig, train_world_model
from tests.torchrun import torchrun

SCRIPT = Path(__file__).with_name("trainings.py")
TRAINED_WEIGHTS = "checkpoints/last/pretrained_model/model.safetensors"
STEPS, BATCH = 6, 8
SIZES = {
    "frame_tokenizer": [
        "--model.tokenizer.image_size=32", "--model.tokenizer.widths=[8,16]",
        "--model.tokenizer.levels=[5,4]",
    ],
    "action_world_model": [
        "--model.layers=1", "--model.width=32", "--model.heads=2", "--model.clip_length=14",
        "--model.code_width=8", "--model.token_noise=0.1", "--model.self_rollout=0.5",
        "--model.keypoint_weight=1", "--model.dynamics=autoregressive",
    ],
    "text_world_model": [
        "--model.layers=1", "--model.width=32", "--model.heads=2", "--model.clip_length=14",
        "--model.code_width=8", "--model.state_size=0", "--model.dynamics=anchored",
        "--model.dropout=0.1",
    ],
}  # fmt: skip


def flags(model: str, root: Path, tokenizer: Path, output_dir: Path, processes: int) -> list[str]:
    """Of a training in which `processes` share a batch of `BATCH`."""
    source = [] if model == "frame_tokenizer" else [f"--model.tokenizer_path={tokenizer}"]
    return [
        f"--model.type={model}", "--model.device=cpu", *source, *SIZES[model], f"--dataset.root={root}",
        f"--output_dir={output_dir}", f"--batch_size={BATCH // processes}", f"--steps={STEPS}",
        "--log_freq=1", "--save_freq=3", "--precision=float32",
    ]  # fmt: skip


@pytest.fixture(scope="module")
def trained_twice(small_dataset, trained_models, tmp_path_factory) -> tuple[Path, Path]:
    """Folders with every model as one process, and as two, trained it."""
    root, tokenizer = Path(small_dataset.root), trained_models["frame_tokenizer"]
    one, two = tmp_path_factory.mktemp("one"), tmp_path_factory.mktemp("two")
    for model in SIZES:
        train_world_model(
            draccus.parse(TrainWorldModelConfig, args=flags(model, root, tokenizer, one / model, 1))
        )
    runs = [json.dumps(flags(model, root, tokenizer, two / model, 2)) for model in SIZES]
    torchrun(SCRIPT, *runs)
    return one, two


@pytest.mark.parametrize("model", SIZES)
def test_two_processes_have_the_loss_curve_of_one(model, trained_twice):
    one, two = (read_metrics(folder / model) for folder in trained_twice)
    assert [line["step"] for line in two] == list(range(1, STEPS + 1))
    for name in one[0].keys() - {"step", "steps_per_s", "psnr"}:
        assert [line[name] for line in two] == pytest.approx([line[name] for line in one], rel=1e-4), name


@pytest.mark.parametrize("model", SIZES)
def test_two_processes_write_the_checkpoints_of_one(model, trained_twice):
    folders = [folder / model / "checkpoints" for folder in trained_twice]
    assert [sorted(path.name for path in folder.iterdir()) for folder in folders] == [
        ["000003", "000006", "last"]
    ] * 2
    one, two = (load_file(folder / model / TRAINED_WEIGHTS) for folder in trained_twice)
    learnt = [name for name in one if "whiten" not in name and one[name].is_floating_point()]
    for name in learnt:
        torch.testing.assert_close(two[name], one[name], rtol=1e-3, atol=1e-5)


def test_a_run_goes_on_with_as_many_processes_as_it_began_with(trained_twice, small_dataset, trained_models):
    _, two = trained_twice
    folder, last = two / "action_world_model", two / "action_world_model" / "checkpoints" / "000006"
    last.rename(folder / "000006")
    again = flags(
        "action_world_model", Path(small_dataset.root), trained_models["frame_tokenizer"], folder, 2
    )
    with pytest.raises(ValueError, match=r"began with 2 processes, here are 1; .*--nproc_per_node=2"):
        train_world_model(draccus.parse(TrainWorldModelConfig, args=again))
    (folder / "000006").rename(last)

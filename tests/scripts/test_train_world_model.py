"""Training by the command: further with `--model.path`, resumed, tracked, and concluded."""

import json
import math
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import draccus
import pytest
import torch
from safetensors.torch import load_file

from lerobot_wmrl.common import precision
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.presets import PRESETS
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.dataset import TrainingData
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig, next_command
from lerobot_wmrl.world_models.checkpoint import config_to_continue, load_model, load_model_to_continue
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig
from tests.commands import run_here

TRAINED = "checkpoints/last/pretrained_model"


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_trains_for_two_steps_on_few_small_frames(
    preset: str, small_dataset, tmp_path: Path
) -> None:
    """The world models with the tokenizer of the same preset."""
    few = [f"--preset={preset}", f"--dataset.root={small_dataset.root}", "--steps=2"]
    tokenizer = tmp_path / "frame_tokenizer"
    frames = ["--model.tokenizer.image_size=32", "--model.tokenizer.cameras=[third_view]"]
    kinds: dict[str, list[str]] = {
        "frame_tokenizer": [*frames, "--batch_size=2"],
        "action_world_model": [f"--model.tokenizer_path={tokenizer}", "--batch_size=1"],
        "text_world_model": [f"--model.tokenizer_path={tokenizer}", "--batch_size=1"],
    }
    for kind, flags in kinds.items():
        out = f"--output_dir={tmp_path / kind}"
        run_here("lerobot-wmrl-train-world-model", *few, f"--model.type={kind}", *flags, out)
        (line,) = read_metrics(tmp_path / kind)
        assert (line["step"], math.isfinite(line["loss"])) == (2, True)


@pytest.mark.parametrize("model", ["action_world_model", "text_world_model"])
def test_training_goes_on_with_the_weights_and_settings_of_a_checkpoint(
    model: str,
    trained_models: dict[str, Path],
    small_dataset,
    tmp_path: Path,
) -> None:
    """At a learning rate of next to nothing, one step later they are the same."""
    output_dir = tmp_path / "further"
    run_here(
        "lerobot-wmrl-train-world-model",
        f"--model.path={trained_models[model]}",
        "--precision=float32",
        "--model.learning_rate=1e-12",
        f"--dataset.root={small_dataset.root}",
        "--steps=1",
        "--batch_size=2",
        f"--output_dir={output_dir}",
    )
    before, after = (
        load_file(folder / TRAINED / "model.safetensors") for folder in (trained_models[model], output_dir)
    )
    assert before.keys() == after.keys()
    for name, weights in before.items():
        torch.testing.assert_close(after[name], weights, atol=1e-6, rtol=0)
    settings = json.loads((output_dir / TRAINED / "config.json").read_text())
    assert (settings["type"], settings["dynamics"]["width"], settings["learning_rate"]) == (model, 32, 1e-12)


def test_a_path_without_a_model_is_named(
    tmp_path: Path, small_dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        run_here(
            "lerobot-wmrl-train-world-model",
            f"--model.path={tmp_path}",
            f"--dataset.root={small_dataset.root}",
            f"--output_dir={tmp_path / 'new'}",
        )
    assert stopped.value.code == 1
    assert f"--model.path={tmp_path}: no model can be loaded from it" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["--model.dynamics.layers=3"], r"weights do not fit the settings \(.*Missing key.*leave the sizes"),
        (
            ["--model.dynamics.width=64"],
            r"weights do not fit the settings \(.*size mismatch.*leave the sizes",
        ),
        (["--model.shifts=1"], r"(?s)unrecognized arguments: --shifts=1.*has not all of the settings"),
        (
            ["--model.dynamics.type=autoregressive"],
            r"cannot be trained further with --dynamics\.type=autoreg",
        ),
        (
            [f"--model.embodiment.action_low={[1] * 7}", f"--model.embodiment.action_high={[0] * 7}"],
            r"embodiment\.action_low=.* would range from 1.0 to 0.0; give finite numbers",
        ),
    ],
)
def test_settings_that_do_not_fit_the_weights_are_refused(
    settings: list[str],
    message: str,
    trained_models: dict[str, Path],
    small_dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        run_here(
            "lerobot-wmrl-train-world-model",
            f"--model.path={trained_models['action_world_model']}",
            *settings,
            f"--dataset.root={small_dataset.root}",
            "--batch_size=2",
            f"--output_dir={tmp_path / 'new'}",
        )
    assert re.search(message, capsys.readouterr().err)
    assert not (tmp_path / "new").exists()


def test_weights_that_are_truncated_are_named(
    trained_models: dict[str, Path],
    small_dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    torn = tmp_path / "torn"
    shutil.copytree(trained_models["action_world_model"] / TRAINED, torn)
    weights = torn / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(SystemExit):
        run_here(
            "lerobot-wmrl-train-world-model",
            f"--model.path={torn}",
            f"--dataset.root={small_dataset.root}",
            "--batch_size=2",
            f"--output_dir={tmp_path / 'new'}",
        )
    assert f"{torn}: model.safetensors cannot be read" in capsys.readouterr().err


def test_a_model_of_the_hub_is_continued_from_the_revision_that_is_given(
    trained_models: dict[str, Path], small_dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    source = shutil.copytree(trained_models["frame_tokenizer"] / TRAINED, tmp_path / "published")

    def download(repo_id: str, filename: str, revision: str | None = None, **_: object) -> str:
        asked.append((repo_id, filename, revision))
        return str(source / filename)

    for module in ("lerobot.configs.rewards", "lerobot.rewards.pretrained"):
        monkeypatch.setattr(f"{module}.hf_hub_download", download)
    config = config_to_continue("someone/tokenizer", ["--pretrained_revision=abc"])
    load_model_to_continue(config, small_dataset.meta)
    assert {(name, revision) for name, _, revision in asked} == {("someone/tokenizer", "abc")}
    asked.clear()
    settings = json.loads((source / "config.json").read_text())
    (source / "config.json").write_text(json.dumps({**settings, "pretrained_revision": "abc"}))
    load_model_to_continue(config_to_continue("someone/derived", []), small_dataset.meta)
    assert {(name, revision) for name, _, revision in asked} == {("someone/derived", None)}, "its base's"
    assert {file for _, file, _ in asked} == {"config.json", "model.safetensors"}


def test_frames_have_the_size_of_those_that_were_learnt_last(
    trained_models: dict[str, Path], make_synthetic_dataset, tmp_path: Path
) -> None:
    larger = make_synthetic_dataset(tmp_path / "larger", episodes=4, size=48)
    run_here(
        "lerobot-wmrl-train-world-model",
        f"--model.path={trained_models['action_world_model']}",
        f"--dataset.root={larger.root}",
        "--steps=1",
        "--batch_size=2",
        f"--output_dir={tmp_path / 'further'}",
    )
    model = load_model(tmp_path / "further", "action_world_model")
    assert model.config.observation_shapes["observation.images.third_view"] == (3, 48, 48)


def flags(root: Path, output_dir: Path, *more: str) -> list[str]:
    return [
        "lerobot-wmrl-train-world-model",
        "--model.type=frame_tokenizer",
        "--model.device=cpu",
        "--model.tokenizer.image_size=32",
        "--model.tokenizer.widths=[8,16]",
        "--model.tokenizer.levels=[5,4]",
        f"--dataset.root={root}",
        f"--output_dir={output_dir}",
        "--steps=2",
        "--batch_size=2",
        *more,
    ]


def test_a_training_ends_with_what_it_made_how_good_it_is_and_what_comes_next(
    trained_models: dict[str, Path],
    make_synthetic_dataset,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Of twenty episodes the last is held out."""
    root, tokenizer = (
        Path(make_synthetic_dataset(tmp_path / "data", episodes=20).root),
        tmp_path / "tokenizer",
    )
    run_here(*flags(root, tokenizer))
    said = capsys.readouterr().out
    assert f"{tokenizer}: a frame_tokenizer of 18,304 parameters, 0.1 MB." in said
    psnr = json.loads((tokenizer / "reconstruction.json").read_text())["psnr"]["third_view"]
    assert f"PSNR on held-out episodes: third_view {psnr:.1f} dB." in said
    following = said.strip().splitlines()[-1].split()
    assert following[:2] == ["lerobot-wmrl-train-world-model", "--model.type=action_world_model"]
    assert f"--model.tokenizer_path={tokenizer}" in following
    tiny = ["--preset=tiny", "--steps=1", "--batch_size=2", "--model.device=cpu"]
    run_here(*flags(root, tmp_path / "again"), "--preset", "tiny")
    again = capsys.readouterr().out.strip().splitlines()[-1].split()
    assert again[:3] == [following[0], "--preset=tiny", *following[1:2]]
    run_here(*following, *tiny)
    said = capsys.readouterr().out
    measured = json.loads((tmp_path / "action_world_model" / "held_out.json").read_text())
    assert f"On held-out episodes: loss {measured['loss']:.3f}, " in said
    assert f"lerobot-wmrl-eval-world-model --model.path={tmp_path / 'action_world_model'}" in said


def test_what_comes_next_learns_from_the_same_data_under_the_same_budget(tmp_path: Path) -> None:
    data, ledger = TrainingData("data", more=["new data", "newer"]), tmp_path / "ledger.json"
    cfg = TrainWorldModelConfig(FrameTokenizerConfig(), data, budget=ledger, output_dir=Path("run"))
    following = shlex.split(next_command(cfg))
    again = draccus.parse(TrainWorldModelConfig, args=following[1:])
    assert (again.dataset, again.budget, again.model.tokenizer_path) == (data, ledger, "run")


def test_a_run_is_resumed_where_there_is_one(
    small_dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Unless the data is other than it was."""
    data = shutil.copytree(small_dataset.root, tmp_path / "data")
    given = flags(data, tmp_path / "run")
    with pytest.raises(SystemExit):
        run_here(*given, "--resume=true")
    assert "--resume=true: there is no checkpoint in" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    run_here(*given)
    for stored in (tmp_path / "run", tmp_path / "run" / TRAINED):
        run_here(
            given[0], f"--config_path={stored / 'train_config.json'}", "--resume=true", "--job_name=again"
        )
        assert f"{tmp_path / 'run'}: already trained for 2 steps" in capsys.readouterr().out
    other = not precision.multiplies_bfloat16("cpu")
    monkeypatch.setattr(precision, "multiplies_bfloat16", lambda _: other)  # moved to such a machine
    run_here(*given)
    assert f"{tmp_path / 'run'}: already trained for 2 steps" in capsys.readouterr().out
    statistics = data / "meta" / "stats.json"
    statistics.write_text(json.dumps(json.loads(statistics.read_text()), indent=1))
    with pytest.raises(SystemExit):
        run_here(*given)
    assert "was begun with another content of dataset," in capsys.readouterr().err


def test_wandb_gets_the_metrics_of_the_file(
    small_dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logged = []

    class Logger:
        def __init__(self, cfg: Any) -> None:
            assert (cfg.job_name, cfg.resume, cfg.reward_model.type) == ("run", False, "frame_tokenizer")
            assert cfg.to_dict()["wandb"]["enable"]

        def log_dict(self, metrics: dict[str, float], step: int, mode: str = "train") -> None:
            logged.append({"step": step, **metrics})

    monkeypatch.setattr("lerobot.common.wandb_utils.WandBLogger", Logger)
    given = flags(Path(small_dataset.root), tmp_path / "run", "--wandb.enable=true", "--log_freq=1")
    run_here(*given)
    assert logged == read_metrics(tmp_path / "run")


def test_a_checkpoint_of_an_earlier_version_is_named(
    trained_models: dict[str, Path], tmp_path: Path, small_dataset
) -> None:
    shutil.copytree(trained_models["action_world_model"] / TRAINED, tmp_path / "old")
    path = tmp_path / "old" / "config.json"
    settings = json.loads(path.read_text())
    settings |= {"image_size": 32, "tokenizer_widths": [8, 16], "levels": [5, 4]}
    del settings["tokenizer"]
    path.write_text(json.dumps(settings))
    message = r"^world_model_path=.*of an earlier version of this package .*; train the model again"
    with pytest.raises(FieldError, match=message):
        load_model(tmp_path / "old", "action_world_model")

"""`--model.path`: a trained world model is trained further."""

import json
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from lerobot_wmrl.scripts.train_world_model import main

TRAINED = "checkpoints/last/pretrained_model"


@pytest.mark.parametrize("model", ["action_world_model", "text_world_model"])
def test_training_goes_on_with_the_weights_and_settings_of_a_checkpoint(
    model: str, trained_models: dict[str, Path], small_dataset, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """At a learning rate of next to nothing, one step later they are the same."""
    output_dir = tmp_path / "further"
    monkeypatch.setattr(sys, "argv", [
        "lerobot-wmrl-train-world-model", f"--model.path={trained_models[model]}", "--precision=float32",
        "--model.learning_rate=1e-12", f"--dataset.root={small_dataset.root}", "--steps=1", "--batch_size=2",
        f"--output_dir={output_dir}",
    ])  # fmt: skip
    main()
    before, after = (
        load_file(folder / TRAINED / "model.safetensors") for folder in (trained_models[model], output_dir)
    )
    assert before.keys() == after.keys()
    for name, weights in before.items():
        torch.testing.assert_close(after[name], weights, atol=1e-6, rtol=0)
    settings = json.loads((output_dir / TRAINED / "config.json").read_text())
    assert (settings["type"], settings["width"], settings["learning_rate"]) == (model, 32, 1e-12)


def test_a_path_without_a_model_is_named(
    tmp_path: Path, small_dataset, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [
        "lerobot-wmrl-train-world-model", f"--model.path={tmp_path}", f"--dataset.root={small_dataset.root}",
        f"--output_dir={tmp_path / 'new'}",
    ])  # fmt: skip
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 1
    assert f"--model.path={tmp_path}: no model can be loaded from it" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()

"""Trained models on a hub on the loopback: published by the commands, file by file, and used from there."""

import json
from pathlib import Path

import httpx
import pytest
import torch
from huggingface_hub import HfApi
from lerobot.rewards.factory import get_reward_model_class

from lerobot_wmrl.common.checkpoints import Checkpoint
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.scripts.eval_world_model import EvalWorldModelConfig, eval_world_model
from lerobot_wmrl.world_models.checkpoint import config_to_continue, load_model, read_config
from tests.trained import action_config, run_training, text_config, tokenizer_config


@pytest.mark.parametrize("name", ["frame_tokenizer", "action_world_model", "text_world_model"])
def test_a_published_model_is_the_trained_one(name, hub, small_dataset, trained_models, tmp_path):
    make = {"action_world_model": action_config, "text_world_model": text_config}.get(name)
    config = make(trained_models["frame_tokenizer"]) if make else tokenizer_config()
    config.push_to_hub, config.repo_id = True, f"somebody/{name}"
    folder = run_training(config, Path(small_dataset.root), tmp_path / "run", steps=1)
    published = hub.repos["models", f"somebody/{name}"].head
    local = {
        path.name: path.read_bytes() for path in (folder / "checkpoints/last/pretrained_model").iterdir()
    }
    assert set(published) == {*local, "README.md", ".gitattributes"}
    assert published["model.safetensors"] == local["model.safetensors"]
    assert json.loads(published["config.json"]) == json.loads(local["config.json"])

    card = published["README.md"].decode()
    model_class = get_reward_model_class(name)
    assert model_class.summary in card
    assert "not recognized" not in card
    torch.manual_seed(0)
    batch = {
        **{f"{part}.third_view": torch.rand(2, 3, 32, 32) for part in ("observation.images", "goal")},
        "observation.state": torch.randn(2, 4, 8),
        "action": torch.randn(2, 4, 7),
        "task": ["push", "pull"],
    }
    if name != "frame_tokenizer":
        batch["observation.images.third_view"] = torch.rand(2, 4, 3, 32, 32)
    expected = load_model(folder, name).compute_reward(batch)
    for model in (model_class.from_pretrained(f"somebody/{name}"), load_model(f"somebody/{name}", name)):
        assert torch.equal(model.compute_reward(batch), expected)


def test_a_model_that_is_nowhere_is_named(hub):
    message = r"^world_model_path=somebody/nothing: no action_world_model there, nor on the hub"
    with pytest.raises(FieldError, match=message):
        read_config("somebody/nothing", "action_world_model")


def test_a_model_of_another_type_is_named(hub, small_dataset, tmp_path):
    config = tokenizer_config()
    config.push_to_hub, config.repo_id = True, "somebody/tokenizer"
    run_training(config, Path(small_dataset.root), tmp_path / "run", steps=1)
    message = r"^world_model_path=somebody/tokenizer: is a checkpoint of type 'frame_tokenizer'"
    with pytest.raises(FieldError, match=message):
        read_config("somebody/tokenizer", "action_world_model")


def test_what_was_trained_but_not_published_is_published_by_the_same_command(hub, small_dataset, tmp_path):
    config = tokenizer_config()
    config.push_to_hub, config.repo_id = True, "somebody/later"
    root = Path(small_dataset.root)
    folder = run_training(config, root, tmp_path / "run", steps=1)
    before = hub.repos.pop(("models", "somebody/later"))
    run_training(config, root, folder, steps=1)
    after = hub.repos["models", "somebody/later"]
    assert before.head["model.safetensors"] == after.head["model.safetensors"]


def test_a_model_without_a_name_is_not_trained_in_order_to_be_published(small_dataset, tmp_path):
    config = tokenizer_config()
    config.push_to_hub = True
    with pytest.raises(FieldError, match=r"^model\.push_to_hub=True: .*`model\.repo_id`"):
        run_training(config, Path(small_dataset.root), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_an_evaluation_is_put_on_the_card_and_replaced_by_the_next(
    hub, small_dataset, trained_models, tmp_path
):
    config = action_config(trained_models["frame_tokenizer"])
    config.push_to_hub, config.repo_id = True, "somebody/world_model"
    run_training(config, Path(small_dataset.root), tmp_path / "run", steps=1)
    repo = hub.repos["models", "somebody/world_model"]
    weights, card = repo.head["model.safetensors"], repo.head["README.md"].decode()
    for run, split in enumerate(["all", "train"]):
        evaluation = EvalWorldModelConfig(
            model=Checkpoint("somebody/world_model"),
            dataset=ChosenEpisodes(root=str(small_dataset.root)),
            split=split,
            push_to_hub=True,
            output_dir=tmp_path / f"check{run}",
            device="cpu",
        )
        eval_world_model(evaluation)
        found = repo.head["README.md"].decode()
        assert found.startswith(card.rstrip())
        assert found.count("## What it imagines") == 1
        assert f"({split}), imagined from their first frames" in found
        assert (tmp_path / f"check{run}" / "metrics.md").read_text().strip() in found
        shown = repo.head["evaluation/comparison_success.gif"]
        assert shown == (tmp_path / f"check{run}" / "comparison_success.gif").read_bytes()
        assert str(tmp_path) not in found + repo.head["evaluation/metrics.json"].decode()
    assert "(evaluation/comparison_success.gif)" in found
    assert repo.head["model.safetensors"] == weights


def test_what_is_public_already_is_not_called_private(hub, small_dataset, tmp_path):
    config = tokenizer_config()
    config.push_to_hub, config.repo_id, config.private = True, "somebody/tokenizer", True
    HfApi().create_repo("somebody/tokenizer")
    with pytest.raises(FieldError, match=r"^model\.private=true: somebody/tokenizer is public"):
        run_training(config, Path(small_dataset.root), tmp_path / "run", steps=1)


def test_a_model_that_is_trained_further_is_not_published_over_the_first(hub, small_dataset, tmp_path):
    config = tokenizer_config()
    config.push_to_hub, config.repo_id = True, "somebody/tokenizer"
    folder = run_training(config, Path(small_dataset.root), tmp_path / "run", steps=1)
    assert config_to_continue(str(folder), []).push_to_hub is False
    assert config_to_continue(str(folder), ["--push_to_hub=true", "--repo_id=a/b"]).repo_id == "a/b"


def test_a_training_without_a_login_is_not_begun(hub, small_dataset, tmp_path, monkeypatch):
    monkeypatch.setattr("lerobot_wmrl.common.hub.get_token", lambda: None)
    config = tokenizer_config()
    config.push_to_hub, config.repo_id = True, "somebody/tokenizer"
    with pytest.raises(FieldError, match=r"^model\.push_to_hub=true: nobody is logged in"):
        run_training(config, Path(small_dataset.root), tmp_path / "run", steps=1)
    assert not (tmp_path / "run").exists()


def test_a_hub_that_is_gone_after_the_training_is_named(hub, small_dataset, tmp_path, monkeypatch):
    def gone(*_: object, **__: object) -> None:
        raise httpx.ConnectError("no route to host")

    monkeypatch.setattr("huggingface_hub.HfApi.create_repo", gone)
    config = tokenizer_config()
    config.push_to_hub, config.repo_id = True, "somebody/tokenizer"
    message = r"^model\.push_to_hub=true: .* the hub cannot be reached .*; the model is whole in .*run"
    with pytest.raises(FieldError, match=message):
        run_training(config, Path(small_dataset.root), tmp_path / "run", steps=1)


def test_an_evaluation_without_a_login_is_not_begun(hub, small_dataset, tmp_path, monkeypatch):
    monkeypatch.setattr("lerobot_wmrl.common.hub.get_token", lambda: None)
    evaluation = EvalWorldModelConfig(
        model=Checkpoint("somebody/world_model"),
        dataset=ChosenEpisodes(root=str(small_dataset.root)),
        push_to_hub=True,
        output_dir=tmp_path / "check",
    )
    with pytest.raises(FieldError, match=r"^push_to_hub=true: nobody is logged in"):
        eval_world_model(evaluation)
    assert not (tmp_path / "check").exists()


def test_an_evaluation_of_a_folder_is_not_published(trained_models, small_dataset, tmp_path):
    evaluation = EvalWorldModelConfig(
        model=Checkpoint(str(trained_models["action_world_model"])),
        push_to_hub=True,
        dataset=ChosenEpisodes(root=str(small_dataset.root)),
        output_dir=tmp_path / "check",
    )
    with pytest.raises(FieldError, match=r"^push_to_hub=True: .* is a folder here; publish it by"):
        eval_world_model(evaluation)
    assert not (tmp_path / "check").exists()

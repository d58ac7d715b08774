"""The text world model around its text encoder: what it learns, and checkpoints that travel."""

import json
import os
import shutil
from pathlib import Path

import pytest
import torch
from huggingface_hub import HfApi
from safetensors.torch import load_file
from transformers import BertConfig

from lerobot_wmrl.common.checkpoints import model_folder
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.output_folders import RUN_CONFIG_FILE
from lerobot_wmrl.world_models import losses
from lerobot_wmrl.world_models.checkpoint import config_to_continue, load_model, load_model_to_continue
from lerobot_wmrl.world_models.goal import imagine_goal
from tests.hub_server import WRITE_TOKEN
from tests.trained import run_training, text_config
from tests.world_models.made_up_clips import ARRIVAL, INSTRUCTIONS, fit, made_up_clip, text_model
from tests.world_models.pretrained_t5 import save_t5

LEROBOT_PUBLISHES = (".safetensors", ".json", ".yaml", ".md")
"""Endings of the files that `push_model_to_hub` uploads."""

WEIGHTS = "checkpoints/last/pretrained_model/model.safetensors"


@pytest.fixture(scope="module")
def trained(small_dataset, trained_models, tmp_path_factory) -> Path:
    """Output folder of a training with a frozen T5 whose own folder is gone afterwards."""
    folder = tmp_path_factory.mktemp("frozen")
    config = text_config(trained_models["frame_tokenizer"], text_encoder=str(save_t5(folder / "t5", "byt5")))
    output_dir = run_training(config, Path(small_dataset.root), folder / "run", steps=2)
    shutil.rmtree(folder / "t5")
    return output_dir


@pytest.mark.parametrize("kind", [None, "t5"])
def test_two_instructions_lead_from_one_start_to_two_goals(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(losses, "TOKEN_NOISE", 0.0)
    model = text_model(text_encoder=kind and str(save_t5(tmp_path, kind)))
    clip = made_up_clip()
    fit(model, clip, steps=100)
    for rows in ([0, 1], [1, 0]):
        goal = imagine_goal(model, clip.first()[rows], [INSTRUCTIONS[r] for r in rows])
        assert goal.reached.all()
        right = (goal.tokens == clip.tokens[rows, ARRIVAL]).float().mean(1)
        assert (right > 0.9).all()


def test_training_leaves_a_frozen_t5_as_it_is(tmp_path):
    model = text_model(text_encoder=str(save_t5(tmp_path)))
    before = {name: value.clone() for name, value in model.text_encoder.t5.model.state_dict().items()}
    projection = model.text_encoder.project.weight.clone()
    fit(model, made_up_clip(), steps=3)
    after = model.text_encoder.t5.model.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())
    assert not torch.equal(projection, model.text_encoder.project.weight)


def test_one_instruction_for_two_episodes_is_refused():
    model, clip = text_model(), made_up_clip()
    for wrong in (INSTRUCTIONS[:1], [*INSTRUCTIONS, "push"]):
        with pytest.raises(ValueError, match=f"task: {len(wrong)} instructions for 2 episodes"):
            imagine_goal(model, clip.first(), wrong)
        with pytest.raises(ValueError, match=f"task: {len(wrong)} instructions for 2 episodes"):
            model(clip._replace(instructions=wrong))


def test_a_checkpoint_carries_its_frozen_t5_in_files_that_lerobot_publishes(trained, tmp_path):
    folder = model_folder(trained)
    moved = shutil.copytree(folder, tmp_path / "elsewhere")
    files = [path for path in moved.rglob("*") if path.is_file()]
    assert all(path.suffix in LEROBOT_PUBLISHES for path in files)
    assert moved / "text_encoder" / "model.safetensors" in files
    assert json.loads((moved / "config.json").read_text())["text_encoder"] == "text_encoder"
    first, again = (load_model(path, "text_world_model") for path in (folder, moved))
    assert torch.equal(first.text_encoder(INSTRUCTIONS)[0], again.text_encoder(INSTRUCTIONS)[0])


def test_training_goes_on_where_the_t5s_own_folder_is_gone(trained, small_dataset, tmp_path):
    output_dir = shutil.copytree(trained, tmp_path / "run", symlinks=True)
    shutil.rmtree(output_dir / "checkpoints" / "000002")
    given = json.loads((output_dir / RUN_CONFIG_FILE).read_text())["model"]
    config = text_config(given["tokenizer_path"], text_encoder=given["text_encoder"])
    run_training(config, Path(small_dataset.root), output_dir, steps=2)
    expected, resumed = load_file(trained / WEIGHTS), load_file(output_dir / WEIGHTS)
    assert all(torch.equal(expected[name], resumed[name]) for name in expected)


def test_a_trained_model_keeps_its_text_encoder(trained, small_dataset):
    config = config_to_continue(str(trained), ["--text_encoder=google/flan-t5-small"])
    with pytest.raises(FieldError, match=r"^text_encoder=google/flan-t5-small: a trained model keeps"):
        load_model_to_continue(config, small_dataset.meta)


def test_it_loads_from_the_hub_by_its_id(trained, hub):
    api = HfApi(token=WRITE_TOKEN)
    api.create_repo("somebody/golden")
    published = [f"*{suffix}" for suffix in LEROBOT_PUBLISHES]
    api.upload_folder(repo_id="somebody/golden", folder_path=model_folder(trained), allow_patterns=published)
    here, there = (load_model(path, "text_world_model") for path in (trained, "somebody/golden"))
    assert torch.equal(*(model.encode_instructions(INSTRUCTIONS, 2)[0] for model in (here, there)))


def test_a_checkpoint_that_lost_its_t5_is_named(trained, tmp_path):
    lost = shutil.copytree(model_folder(trained), tmp_path / "lost")
    shutil.rmtree(lost / "text_encoder")
    with pytest.raises(ValueError, match=r"lost: the text encoder in its folder text_encoder cannot be read"):
        load_model(lost, "text_world_model")


def test_what_is_no_t5_is_named_and_nothing_is_written(small_dataset, trained_models, tmp_path):
    root, tokenizer = Path(small_dataset.root), trained_models["frame_tokenizer"]
    BertConfig().save_pretrained(tmp_path / "bert")
    t5 = save_t5(tmp_path / "t5", "byt5")
    no_tokenizer = shutil.copytree(t5, tmp_path / "no_tokenizer")
    for path in no_tokenizer.glob("*token*"):
        path.unlink()
    torn = shutil.copytree(t5, tmp_path / "torn")
    os.truncate(torn / "model.safetensors", 1000)
    for folder, reason in {
        tmp_path / "bert": "it is of type 'bert'",
        no_tokenizer: r"its tokenizer knows \d+ tokens, the encoder 384",
        torn: "header",
        tmp_path / "nowhere": "",
    }.items():
        message = rf"text_encoder={folder}: no T5 encoder .*{reason}.* give the id of one on the hub"
        with pytest.raises(ValueError, match=message):
            run_training(text_config(tokenizer, text_encoder=str(folder)), root, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("task", "message"), [("", "an instruction is empty"), ("x" * 10_000, "at most 512")]
)
def test_a_dataset_with_a_bad_instruction_is_named_and_nothing_is_written(
    task, message, make_synthetic_dataset, trained_models, tmp_path
):
    root = Path(make_synthetic_dataset(tmp_path / "data", episodes=1, instructions=[task]).root)
    with pytest.raises(ValueError, match=message):
        run_training(text_config(trained_models["frame_tokenizer"]), root, tmp_path / "out")
    assert not (tmp_path / "out").exists()

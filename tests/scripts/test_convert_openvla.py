"""lerobot-wmrl-convert-openvla: a folder or the hub in, a folder out, whole or not at all."""

import sys
from pathlib import Path

import pytest
import torch
from huggingface_hub import HfApi
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from safetensors.torch import load_file

from lerobot_policy_openvla.checkpoint import write_openvla
from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
from lerobot_wmrl.common.policies import load_policy, load_processors, read_policy_config
from lerobot_wmrl.scripts.convert_openvla import main
from tests.hub_server import Hub
from tests.lerobot_policy_openvla.small import SMALL_SIZES, observe, small_policy

STATISTICS = {"one": {"action": {"q01": [-2.0] * 3, "q99": [4.0] * 3, "mask": [True, True, False]}}}


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """A small model in OpenVLA's format."""
    policy = small_policy()
    weights = {name: value.to(torch.bfloat16) for name, value in policy.model.state_dict().items()}
    write_openvla(tmp_path / "openvla", weights, SMALL_SIZES, policy.files, STATISTICS)
    return tmp_path / "openvla"


def run(monkeypatch: pytest.MonkeyPatch, *flags: str) -> None:
    monkeypatch.setattr(sys, "argv", ["lerobot-wmrl-convert-openvla", *flags])
    main()


@pytest.mark.parametrize("from_hub", [False, True])
def test_there_and_back_again(
    checkpoint: Path, tmp_path: Path, hub: Hub, from_hub: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = str(checkpoint)
    if from_hub:
        source = HfApi().create_repo("somebody/openvla").repo_id
        HfApi().upload_folder(repo_id=source, folder_path=checkpoint)
    run(monkeypatch, "--direction=import", f"--source={source}", f"--target={tmp_path / 'lerobot'}")
    config = read_policy_config(str(tmp_path / "lerobot"), [])
    ids = load_policy(config).select_action(observe())
    original = OpenVLAPolicy.from_openvla(checkpoint)
    assert torch.equal(ids, original.select_action(observe()))
    action = load_processors(config)[1](ids)
    decoded = original.action_tokens.decode(ids)
    assert torch.allclose(action[:, :2], decoded[:, :2] * 3 + 1, atol=1e-5)
    assert torch.allclose(action[:, 2], decoded[:, 2], atol=1e-6)
    run(
        monkeypatch, "--direction=export", f"--source={tmp_path / 'lerobot'}", f"--target={tmp_path / 'back'}"
    )
    before, after = (load_file(folder / "model.safetensors") for folder in (checkpoint, tmp_path / "back"))
    assert before.keys() == after.keys()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert not list(tmp_path.glob(".*.partial"))


def test_a_published_policy_is_the_same_policy(hub: Hub) -> None:
    """With the card that LeRobot writes."""
    policy = small_policy(repo_id="somebody/small")
    policy.push_model_to_hub(
        TrainPipelineConfig(dataset=DatasetConfig(repo_id="somebody/push"), policy=policy.config)
    )
    published = hub.repos["models", "somebody/small"].head
    assert "openvla" in published["README.md"].decode()
    loaded = OpenVLAPolicy.from_pretrained("somebody/small")
    assert torch.equal(loaded.select_action(observe()), policy.select_action(observe()))


def test_a_model_that_is_nowhere_is_named(hub: Hub) -> None:
    with pytest.raises(ValueError, match="somebody/gone: neither a folder nor a model on the hub"):
        OpenVLAPolicy.from_openvla("somebody/gone")

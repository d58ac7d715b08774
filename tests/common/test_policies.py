"""A checkpoint is loaded whole, or what is wrong with it is named."""

from pathlib import Path

import pytest
import torch

from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.policies import check_fit, check_weights, load_policy, read_policy_config
from tests.rl.checkpoints import save_untrained_policy

IMAGE = "observation.images.third_view"


def test_the_output_folder_of_a_training_is_enough(tmp_path: Path) -> None:
    folder = save_untrained_policy(tmp_path / "checkpoints" / "last" / "pretrained_model")
    policy = load_policy(read_policy_config(str(tmp_path), []))
    saved = CnnPolicy.from_pretrained(folder).state_dict()
    assert all(torch.equal(value, saved[name]) for name, value in policy.state_dict().items())


@pytest.mark.parametrize(("content", "message"), [
    (None, "nothing_here"), ("", "config.json is missing"),
    ('{"type": "action_world_model"}', "no policy can be loaded"),
])  # fmt: skip
def test_what_is_no_policy_is_refused(content: str | None, message: str, tmp_path: Path) -> None:
    folder = tmp_path / "nothing_here"
    if content is not None:
        folder.mkdir()
    if content:
        (folder / "config.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        read_policy_config(str(folder), [])


def test_truncated_weights_are_refused(tmp_path: Path) -> None:
    weights = save_untrained_policy(tmp_path) / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:20_000])
    config = read_policy_config(str(tmp_path), [])
    for read in (load_policy, check_weights):
        with pytest.raises(ValueError, match="truncated or of another version"):
            read(config)


@pytest.mark.parametrize(("camera", "size", "actions", "message"), [
    ("wrist", 32, 3, r"needs observation\.images\.wrist.*cameras: observation\.images\.third_view"),
    ("third_view", 64, 3, r"\(3, 64, 64\), the environment has \(3, 32, 32\)"),
    ("third_view", 32, 5, "5 action components, the environment 3"),
])  # fmt: skip
def test_an_environment_that_does_not_fit_is_refused(
    camera: str, size: int, actions: int, message: str, tmp_path: Path
) -> None:
    config = read_policy_config(str(save_untrained_policy(tmp_path, camera, size, actions)), [])
    with pytest.raises(ValueError, match=message):
        check_fit(config, {IMAGE: (3, 32, 32)}, action_size=3)

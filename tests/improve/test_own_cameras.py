"""Policies that were fine-tuned from a base with other cameras than those of the data."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.policies import copy_checkpoint, load_policy, load_processors, read_policy_config
from lerobot_wmrl.common.policy_checks import check_fit
from lerobot_wmrl.improve.own_cameras import with_own_cameras, without_renaming
from tests.rl.act_checkpoint import IMAGE, small_act
from tests.rl.small_smolvla import save_small_smolvlm, small_smolvla

TOP, WRIST = "observation.images.top", "observation.images.wrist"
CAMERAS = [f"observation.images.camera{number}" for number in (1, 2, 3)]
COLUMNS = {
    **{
        name: {"dtype": "video", "shape": (48, 80, 3), "names": ["height", "width", "channels"]}
        for name in (TOP, WRIST)
    },
    OBS_STATE: {"dtype": "float32", "shape": (7,)},
}
SHOWN = {TOP: (3, 48, 80), WRIST: (3, 48, 80), OBS_STATE: (7,)}


@pytest.fixture
def base(tmp_path: Path) -> SmolVLAPolicy:
    """As lerobot/smolvla_base: three cameras of 256x256, one more that is kept free, and a state of six."""
    inputs = {name: PolicyFeature(FeatureType.VISUAL, (3, 256, 256)) for name in CAMERAS}
    inputs[OBS_STATE] = PolicyFeature(FeatureType.STATE, (6,))
    return small_smolvla(
        save_small_smolvlm(tmp_path / "smolvlm"),
        device="cpu",
        empty_cameras=1,
        input_features=inputs,
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (3,))},
    )


def fine_tuned(policy: Any, folder: Path, renames: dict[str, str]) -> Path:
    """Save a policy as lerobot-train leaves it: with statistics of the dataset's columns by their names."""
    policy.save_pretrained(folder)
    sizes = {TOP: (3, 1, 1), WRIST: (3, 1, 1), OBS_STATE: (7,), ACTION: (3,)}
    stats = {
        name: {"mean": torch.full(size, 0.2), "std": torch.full(size, 0.5)} for name, size in sizes.items()
    }
    before, after = make_pre_post_processors(policy.config, dataset_stats=stats)
    before.steps[0] = replace(before.steps[0], rename_map=renames)
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    return folder


def action(folder: Path) -> Tensor:
    """What a policy does in some state."""
    config = read_policy_config(str(folder), [])
    before, after = load_processors(config)
    policy = load_policy(config)
    torch.manual_seed(0)  # of what it sees, and of what a flow begins at
    observation = {name: torch.rand(1, *shape) for name, shape in SHOWN.items()}
    found: Tensor = after(policy.select_action(before({**observation, "task": ["push"]})))
    return found


def test_a_vla_of_other_cameras_and_sizes_acts_as_before(base: SmolVLAPolicy, tmp_path: Path) -> None:
    original = fine_tuned(base, tmp_path / "tuned", {TOP: CAMERAS[0], WRIST: CAMERAS[1]})
    config = read_policy_config(str(original), [])
    assert len(config.image_features) == 4
    preprocessor, _ = load_processors(config)
    own = with_own_cameras(config, preprocessor, COLUMNS)
    copy_checkpoint(own, tmp_path / "copy", without_renaming(preprocessor, own))
    copied = read_policy_config(str(tmp_path / "copy"), [])
    assert {name: feature.shape for name, feature in copied.input_features.items()} == SHOWN
    check_fit(copied, SHOWN, 3)
    torch.testing.assert_close(action(original), action(tmp_path / "copy"))


def test_a_camera_that_it_was_trained_with_and_the_data_lacks_is_missed(
    base: SmolVLAPolicy, tmp_path: Path
) -> None:
    original = fine_tuned(base, tmp_path / "tuned", {TOP: CAMERAS[0], WRIST: CAMERAS[1]})
    config = read_policy_config(str(original), [])
    own = with_own_cameras(
        config, load_processors(config)[0], {TOP: COLUMNS[TOP], OBS_STATE: {"shape": (7,)}}
    )
    with pytest.raises(ValueError, match=r"the policy needs observation.images.camera2"):
        check_fit(own, {TOP: (3, 48, 80), OBS_STATE: (7,)}, 3)


def test_a_policy_of_the_datasets_cameras_stays_as_it_is(base: SmolVLAPolicy, tmp_path: Path) -> None:
    """And one that sees frames as they are, such as ACT, whatever its preprocessor renames."""
    seen = {name: PolicyFeature(FeatureType.VISUAL, SHOWN[name]) for name in (TOP, WRIST)}
    base.config.input_features = seen | {OBS_STATE: PolicyFeature(FeatureType.STATE, (7,))}
    base.config.empty_cameras = 0
    for policy, renames in ((base, {}), (small_act(), {TOP: IMAGE})):
        config = read_policy_config(str(fine_tuned(policy, tmp_path / policy.name, renames)), [])
        assert with_own_cameras(config, load_processors(config)[0], COLUMNS) is config

"""Policies that were fine-tuned from a base with other cameras than those of the data."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_wmrl.common.policies import (
    check_fit,
    copy_checkpoint,
    load_policy,
    load_processors,
    read_policy_config,
)
from lerobot_wmrl.improve.own_cameras import with_own_cameras, without_renaming
from tests.rl.act_checkpoint import IMAGE, small_act
from tests.rl.small_smolvla import save_small_smolvlm, small_smolvla

TOP = "observation.images.top"
COLUMNS = {
    TOP: {"dtype": "video", "shape": (48, 80, 3), "names": ["height", "width", "channels"]},
    OBS_STATE: {"dtype": "float32", "shape": (4,)},
}


def save(policy: Any, folder: Path, renames: dict[str, str]) -> Path:
    """Save a policy as lerobot-train leaves it with `--rename_map`: it normalises what it renames."""
    policy.save_pretrained(folder)
    sizes = {IMAGE: (3, 1, 1), OBS_STATE: (4,), ACTION: (3,)}
    stats = {
        name: {"mean": torch.full(size, 0.2), "std": torch.full(size, 0.5)} for name, size in sizes.items()
    }
    before, after = make_pre_post_processors(policy.config, dataset_stats=stats)
    before.steps[0] = replace(before.steps[0], rename_map=renames)
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    return folder


def adapted(folder: Path) -> Path:
    """Make a copy for the columns of the dataset."""
    config = read_policy_config(str(folder), [])
    preprocessor, _ = load_processors(config)
    own = with_own_cameras(config, preprocessor, COLUMNS)
    copy = folder.with_name("copy")
    copy_checkpoint(own, copy, without_renaming(preprocessor, own))
    return copy


def action(folder: Path, observation: dict[str, Any]) -> Tensor:
    config = read_policy_config(str(folder), [])
    before, after = load_processors(config)
    torch.manual_seed(0)  # of what a flow begins at
    found: Tensor = after(load_policy(config).select_action(before({**observation})))
    return found


def observed(height: int, width: int) -> dict[str, Any]:
    torch.manual_seed(1)
    return {TOP: torch.rand(1, 3, height, width), OBS_STATE: torch.rand(1, 4), "task": ["push"]}


def test_an_act_of_another_camera_acts_as_before(tmp_path: Path) -> None:
    """Its statistics go by the camera's name too."""
    original = save(small_act(), tmp_path / "act", {TOP: IMAGE})
    copy = adapted(original)
    assert list(read_policy_config(str(copy), []).image_features) == [TOP]
    seen = observed(32, 32)
    assert torch.equal(action(original, seen), action(copy, seen))
    with pytest.raises(ValueError, match=r"the policy needs observation.images.top of shape \(3, 32, 32\)"):
        check_fit(read_policy_config(str(copy), []), {TOP: (3, 48, 80), OBS_STATE: (4,)}, 3)


def test_a_vla_of_other_cameras_and_sizes_acts_as_before(tmp_path: Path) -> None:
    """As after fine-tuning lerobot/smolvla_base, which knows 256x256, with a camera that is kept free."""
    policy = small_smolvla(
        save_small_smolvlm(tmp_path / "smolvlm"), device="cpu", empty_cameras=1,
        input_features={
            IMAGE: PolicyFeature(FeatureType.VISUAL, (3, 256, 256)),
            OBS_STATE: PolicyFeature(FeatureType.STATE, (4,)),
        },
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (3,))},
    )  # fmt: skip
    original = save(policy, tmp_path / "smolvla", {TOP: IMAGE})
    assert len(read_policy_config(str(original), []).image_features) == 2
    copy = adapted(original)
    check_fit(read_policy_config(str(copy), []), {TOP: (3, 48, 80), OBS_STATE: (4,)}, 3)
    seen = observed(48, 80)
    torch.testing.assert_close(action(original, seen), action(copy, seen))


def test_a_policy_of_the_datasets_cameras_stays_as_it_is(tmp_path: Path) -> None:
    """Also one whose preprocessor would rename a column that the dataset lacks."""
    config = read_policy_config(
        str(save(small_act(), tmp_path / "act", {"observation.images.old": IMAGE})), []
    )
    columns = {IMAGE: {**COLUMNS[TOP], "shape": (32, 32, 3)}, OBS_STATE: COLUMNS[OBS_STATE]}
    assert with_own_cameras(config, load_processors(config)[0], columns) is config

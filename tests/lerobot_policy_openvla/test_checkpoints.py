"""OpenVLA's format in and out, bit by bit; what is wrong with a checkpoint is named."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from huggingface_hub import save_torch_state_dict
from safetensors.torch import load_file, save_file

from lerobot_policy_openvla import loading, modeling_openvla
from lerobot_policy_openvla.checkpoint import OpenVLACheckpoint, write_openvla
from lerobot_policy_openvla.modeling_openvla import OpenVLAPolicy
from tests.lerobot_policy_openvla.small import SMALL_SIZES, observe, small_policy

STATISTICS = {
    key: {"action": {"q01": [-1.0] * 3, "q99": [1.0] * 3, "mask": [True] * 3}} for key in ("one", "two")
}
WEIGHT = "language_model.model.layers.1.mlp.up_proj.weight"


def weights_of(policy: OpenVLAPolicy) -> dict[str, torch.Tensor]:
    return {name: value.to(torch.bfloat16) for name, value in policy.model.state_dict().items()}


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """A small model in OpenVLA's format, bfloat16, with statistics of two datasets."""
    policy = small_policy()
    write_openvla(tmp_path / "openvla", weights_of(policy), SMALL_SIZES, policy.files, STATISTICS)
    return tmp_path / "openvla"


def shard(folder: Path) -> None:
    """Split the one file, as the release is split."""
    save_torch_state_dict(load_file(folder / "model.safetensors"), folder, max_shard_size=60_000)


@pytest.mark.parametrize("sharded", [False, True])
def test_weights_come_out_as_they_went_in(checkpoint: Path, tmp_path: Path, sharded: bool) -> None:
    weights = load_file(checkpoint / "model.safetensors")
    if sharded:
        shard(checkpoint)
        assert not (checkpoint / "model.safetensors").exists()
    policy = OpenVLAPolicy.from_openvla(checkpoint, unnorm_key="two", as_stored=True)
    policy.save_pretrained(tmp_path / "lerobot")
    policy = OpenVLAPolicy.from_pretrained(tmp_path / "lerobot", as_stored=True)
    config = policy.config
    write_openvla(tmp_path / "out", policy.model.state_dict(), config.sizes, policy.files, config.norm_stats)
    found = load_file(tmp_path / "out" / "model.safetensors")
    assert found.keys() == weights.keys()
    assert all(found[name].dtype == value.dtype for name, value in weights.items())
    assert all(torch.equal(found[name], value) for name, value in weights.items())
    for name in ("config.json", "dataset_statistics.json", "tokenizer.json", "tiny_vit.json"):
        before, after = ((folder / name).read_text() for folder in (checkpoint, tmp_path / "out"))
        assert json.loads(after) == json.loads(before)


def test_code_that_is_not_exported_is_that_of_the_release(checkpoint: Path, tmp_path: Path) -> None:
    """Transformers looks for the files that auto_map names in the folder, and finds none."""
    for file, code in (("config.json", "modeling.Net"), ("processor_config.json", "some/fork--processing.P")):
        stored = json.loads((checkpoint / file).read_text()) if (checkpoint / file).exists() else {}
        (checkpoint / file).write_text(json.dumps({**stored, "auto_map": {"Auto": code}}))
    policy = OpenVLAPolicy.from_openvla(checkpoint, unnorm_key="two")
    sizes, statistics = policy.config.sizes, policy.config.norm_stats
    write_openvla(tmp_path / "out", policy.model.state_dict(), sizes, policy.files, statistics)
    files = (tmp_path / "out" / name for name in ("config.json", "processor_config.json"))
    found = [json.loads(file.read_text()) for file in files]
    named = ["openvla/openvla-7b--modeling.Net", "some/fork--processing.P"]
    assert [each["auto_map"]["Auto"] for each in found] == named


def test_sizes_and_answers_are_those_of_the_model(checkpoint: Path) -> None:
    assert OpenVLACheckpoint.open(checkpoint).sizes == SMALL_SIZES
    policy = OpenVLAPolicy.from_openvla(checkpoint, unnorm_key="one")
    original = small_policy()
    original.model.load_state_dict(weights_of(original))
    assert torch.equal(policy.select_action(observe()), original.select_action(observe()))


def test_timms_name_of_the_layer_scale_is_understood(checkpoint: Path) -> None:
    """Left alone, it would be left out: features were wrong by 8."""
    weights = load_file(checkpoint / "model.safetensors")
    renamed = {name.replace("scale_factor", "gamma"): value for name, value in weights.items()}
    renamed["language_model.model.layers.0.self_attn.rotary_emb.inv_freq"] = torch.zeros(4)
    save_file(renamed, checkpoint / "model.safetensors")
    loaded = OpenVLAPolicy.from_openvla(checkpoint, as_stored=True).model.state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in weights.items())


def test_statistics_beside_the_weights_replace_the_configurations(checkpoint: Path) -> None:
    (checkpoint / "dataset_statistics.json").write_text(json.dumps({"three": STATISTICS["one"]}))
    assert OpenVLAPolicy.from_openvla(checkpoint).config.unnorm_key == "three"


def test_statistics_that_changed_replace_what_the_checkpoint_came_with(
    checkpoint: Path, tmp_path: Path
) -> None:
    """A dataset of the same name that was recorded anew: the old range would move the robot wrongly."""
    grown = {"action": {"q01": [-2.0] * 3, "q99": [2.0] * 3, "mask": [True] * 3}, "num_trajectories": 9}
    policy = OpenVLAPolicy.from_openvla(checkpoint, unnorm_key="two", as_stored=True)
    stats = {**policy.config.norm_stats, "two": grown}
    write_openvla(tmp_path / "out", policy.model.state_dict(), policy.config.sizes, policy.files, stats)
    beside = json.loads((tmp_path / "out" / "dataset_statistics.json").read_text())
    inside = json.loads((tmp_path / "out" / "config.json").read_text())["norm_stats"]
    assert beside == inside == {"one": STATISTICS["one"], "two": grown}


def test_a_checkpoint_without_statistics_gets_them(checkpoint: Path, tmp_path: Path) -> None:
    (checkpoint / "dataset_statistics.json").unlink()
    set_config(norm_stats=None)(checkpoint)
    policy = OpenVLAPolicy.from_openvla(checkpoint, as_stored=True)
    write_openvla(tmp_path, policy.model.state_dict(), SMALL_SIZES, policy.files, STATISTICS)
    assert json.loads((tmp_path / "config.json").read_text())["norm_stats"] == STATISTICS


def drop_weight(folder: Path) -> None:
    weights = load_file(folder / "model.safetensors")
    del weights[WEIGHT]
    save_file(weights, folder / "model.safetensors")


def drop_shard(folder: Path) -> None:
    shard(folder)
    sorted(folder.glob("model-*.safetensors"))[1].unlink()


def drop_from_shard(folder: Path) -> None:
    shard(folder)
    files = json.loads((folder / "model.safetensors.index.json").read_text())["weight_map"]
    path = folder / files[WEIGHT]
    save_file({name: value for name, value in load_file(path).items() if name != WEIGHT}, path)


def tear(folder: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-1000])


def reshape(folder: Path) -> None:
    weights = load_file(folder / "model.safetensors")
    weights[WEIGHT] = weights[WEIGHT][:-1].contiguous()
    save_file(weights, folder / "model.safetensors")


def add_weight(folder: Path) -> None:
    save_file(
        {**load_file(folder / "model.safetensors"), "extra": torch.ones(1)}, folder / "model.safetensors"
    )


def set_config(**changes: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        config = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps({**config, **changes}))

    return change


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (drop_weight, rf"the weight {WEIGHT} is missing"),
        (drop_shard, r"model-00002-of-\d+\.safetensors: this file of weights is missing"),
        (drop_from_shard, rf"safetensors: lacks {WEIGHT}, which model\.safetensors\.index\.json"),
        (tear, r"model\.safetensors: cannot be read"),
        (reshape, rf"the weight {WEIGHT} is \(47, 32\), expected \(48, 32\)"),
        (add_weight, "the weight extra is unknown"),
        (lambda folder: (folder / "model.safetensors").unlink(), r"model\.safetensors: this file .* missing"),
        (lambda folder: (folder / "config.json").unlink(), r"config\.json is missing"),
        (lambda folder: (folder / "tokenizer.json").unlink(), r"tokenizer\.json is missing"),
        (set_config(image_resize_strategy="letterbox"), "image_resize_strategy=letterbox: only resize-naive"),
        (set_config(use_fused_vision_backbone=False), "use_fused_vision_backbone=False: only True"),
        (set_config(n_action_bins=128), "n_action_bins=128: only 256"),
        (
            set_config(image_sizes=[40, 40]),
            r"image_sizes=\[40, 40\]: the weights are for pictures of 32 pixels",
        ),
    ],
)
def test_a_damaged_checkpoint_is_refused(
    checkpoint: Path, damage: Callable[[Path], None], message: str
) -> None:
    damage(checkpoint)
    with pytest.raises(ValueError, match=message):
        OpenVLAPolicy.from_openvla(checkpoint)


def test_an_unknown_key_lists_the_known_ones(checkpoint: Path) -> None:
    with pytest.raises(ValueError, match=r"unnorm_key=nope: .* choose one of one, two"):
        OpenVLAPolicy.from_openvla(checkpoint, unnorm_key="nope")


def test_without_a_key_nothing_is_acted(checkpoint: Path) -> None:
    policy = OpenVLAPolicy.from_openvla(checkpoint)
    for act in (policy.select_action, policy.sample):
        with pytest.raises(ValueError, match=r"unnorm_key=None: .* one of: one, two"):
            act(observe())


@pytest.mark.parametrize("on_hub", [False, True])
def test_a_key_is_not_changed_behind_the_processors_back(
    checkpoint: Path, on_hub: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, folder = OpenVLAPolicy.from_openvla(checkpoint, unnorm_key="one"), tmp_path / "lerobot"
    policy.save_pretrained(folder)
    if on_hub:
        monkeypatch.setattr(modeling_openvla, "resolve_folder", lambda *_: folder)
    source = Path("me/openvla") if on_hub else folder
    policy.config.pretrained_path, policy.config.unnorm_key = source, "two"
    with pytest.raises(ValueError, match=rf"unnorm_key=two: the processors in {source} are for one"):
        OpenVLAPolicy.from_pretrained(source, config=policy.config)


def test_unknown_heads_are_guessed_aloud(checkpoint: Path, caplog: pytest.LogCaptureFixture) -> None:
    (checkpoint / "tiny_vit.json").unlink()
    sizes = OpenVLACheckpoint.open(checkpoint).sizes
    assert (sizes.dino.heads, sizes.siglip.heads) == (1, 2)
    assert "number of heads, 2 are assumed" in caplog.text


def test_too_little_memory_is_said_before_anything_is_read(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loading, "free_memory", lambda device: 20_000)
    with pytest.raises(
        ValueError, match=r"weights take 0\.\d GB on cpu, 0\.0 GB are free; set `dtype` to bfloat16"
    ):
        OpenVLAPolicy.from_openvla(checkpoint)


def test_a_conversion_needs_room_for_the_weights_as_they_are_stored(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of what they take in float32, in which this machine would compute."""
    stored = (checkpoint / "model.safetensors").stat().st_size
    monkeypatch.setattr(loading, "free_memory", lambda device: stored)
    OpenVLAPolicy.from_openvla(checkpoint, as_stored=True)
    with pytest.raises(ValueError, match="are free"):
        OpenVLAPolicy.from_openvla(checkpoint)
    monkeypatch.setattr(loading, "free_memory", lambda device: stored - 1)
    with pytest.raises(ValueError, match="are free; end other programs"):
        OpenVLAPolicy.from_openvla(checkpoint, as_stored=True)

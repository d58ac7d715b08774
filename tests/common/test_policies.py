"""A checkpoint is loaded whole, or what is wrong with it is named."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lerobot.configs.default import PeftConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.processor import PolicyProcessorPipeline, UnnormalizerProcessorStep
from safetensors.torch import load_file, save_model

from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.checkpoints import link_checkpoint
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.hub import published_name
from lerobot_wmrl.common.policies import (
    check_weights,
    copy_checkpoint,
    load_policy,
    load_trained_weights,
    read_policy_config,
    with_new_adapters,
)
from lerobot_wmrl.common.policy_checks import check_fit, check_units
from tests.hub_server import Hub, Repo
from tests.rl.checkpoints import save_untrained_policy

IMAGE = "observation.images.third_view"


def test_the_output_folder_of_a_training_is_enough(tmp_path: Path) -> None:
    folder = save_untrained_policy(tmp_path / "checkpoints" / "last" / "pretrained_model")
    policy = load_policy(read_policy_config(str(tmp_path), []))
    saved = CnnPolicy.from_pretrained(folder).state_dict()
    assert all(torch.equal(value, saved[name]) for name, value in policy.state_dict().items())


def test_the_checkpoint_that_was_the_last_one_stays_the_one_that_is_meant(tmp_path, monkeypatch) -> None:
    """Adapters that are trained on it name it, and a longer training moves the link on."""
    checkpoints = tmp_path / "sft" / "checkpoints"
    save_untrained_policy(checkpoints / "000100" / "pretrained_model")
    link_checkpoint(checkpoints / "000100", "last")
    monkeypatch.chdir(tmp_path)
    given = "sft", f"{tmp_path}/sft/checkpoints/last"
    found = [read_policy_config(path, []).pretrained_path for path in given]
    assert found == [folder / "sft/checkpoints/000100/pretrained_model" for folder in (Path(), tmp_path)]


def test_of_a_revision_on_the_hub_all_is_loaded_from_there(hub: Hub, tmp_path: Path) -> None:
    repo, saved = Repo(private=False), []
    for seed in range(2):
        torch.manual_seed(seed)
        saved.append(save_untrained_policy(tmp_path / str(seed)))
        repo.commit({file.name: file.read_bytes() for file in saved[-1].iterdir()})
    hub.repos["models", "someone/policy"] = repo
    first, second = repo.commits
    for flags, folder in (([f"--pretrained_revision={first}"], saved[0]), ([], saved[1])):
        loaded = load_policy(read_policy_config("someone/policy", flags)).state_dict()
        wanted = CnnPolicy.from_pretrained(folder).state_dict()
        assert all(torch.equal(value, wanted[name]) for name, value in loaded.items())
    assert second == repo.refs["main"]
    pinned = load_policy(read_policy_config("someone/policy", [f"--pretrained_revision={first}"]))
    settings = PeftConfig(method_type="LORA", target_modules=["project"], r=2)
    adapters = with_new_adapters(pinned, settings).peft_config["default"]
    assert (adapters.base_model_name_or_path, adapters.revision) == ("someone/policy", first)
    assert published_name(str(pinned.config.pretrained_path)) == ("someone/policy", first)
    assert published_name("someone/policy") == ("someone/policy", None)
    assert published_name(str(saved[0])) is None
    with pytest.raises(FieldError, match=r"^policy\.pretrained_revision=abc: .* is a folder"):
        read_policy_config(str(saved[0]), ["--pretrained_revision=abc"])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "nothing_here"),
        ("", "config.json is missing"),
        ('{"type": "action_world_model"}', "no policy can be loaded"),
    ],
)
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


def test_images_may_be_described_with_their_channels_last(tmp_path: Path) -> None:
    """As LeRobot does it where a dataset calls them `rgb`."""
    config = read_policy_config(str(save_untrained_policy(tmp_path, size=(48, 64))), [])
    assert config.input_features
    config.input_features[IMAGE] = PolicyFeature(FeatureType.VISUAL, (48, 64, 3))
    check_fit(config, {IMAGE: (3, 48, 64)}, action_size=3)
    with pytest.raises(ValueError, match=r"shape \(3, 48, 64\), the environment has \(3, 64, 48\)"):
        check_fit(config, {IMAGE: (3, 64, 48)}, action_size=3)


@pytest.mark.parametrize(
    ("camera", "size", "actions", "message"),
    [
        ("wrist", 32, 3, r"needs observation\.images\.wrist.*cameras: observation\.images\.third_view"),
        ("third_view", 64, 3, r"\(3, 64, 64\), the environment has \(3, 32, 32\)"),
        ("third_view", 32, 5, "5 action components, the environment 3"),
    ],
)
def test_an_environment_that_does_not_fit_is_refused(
    camera: str, size: int, actions: int, message: str, tmp_path: Path
) -> None:
    config = read_policy_config(str(save_untrained_policy(tmp_path, camera, size, actions)), [])
    with pytest.raises(ValueError, match=message):
        check_fit(config, {IMAGE: (3, 32, 32)}, action_size=3)


def test_what_is_not_of_images_is_told_so(tmp_path: Path) -> None:
    """Such as a column that no world model imagines, and another robot's state."""
    config = read_policy_config(str(save_untrained_policy(tmp_path)), [])
    shown = {IMAGE: (3, 32, 32), "observation.state": (14,)}
    config.input_features["observation.state"] = PolicyFeature(FeatureType.STATE, (6,))
    with pytest.raises(ValueError, match=r"of shape \(6,\), .* has \(14,\); use the robot"):
        check_fit(config, shown, action_size=3)
    config.input_features = {"observation.effort": PolicyFeature(FeatureType.STATE, (14,))}
    with pytest.raises(ValueError, match=r"needs observation\.effort, and a policy is shown cameras and"):
        check_fit(config, shown, action_size=3)


@pytest.mark.parametrize(
    ("mean", "refused"), [((0.1, 0.0), False), ((-0.9, 1.9), False), ((0.0, 45.0), True)]
)
def test_a_policy_whose_actions_are_in_other_units_is_refused(
    mean: tuple[float, float], refused: bool, tmp_path: Path
) -> None:
    config = read_policy_config(str(save_untrained_policy(tmp_path)), [])
    stats = {"action": {"mean": torch.tensor(mean), "std": torch.ones(2)}}
    feature, norm = PolicyFeature(FeatureType.ACTION, (2,)), {FeatureType.ACTION: NormalizationMode.MEAN_STD}
    step = UnnormalizerProcessorStep({"action": feature}, norm, stats)
    pipeline = PolicyProcessorPipeline(steps=[step], name="postprocessor")
    names, low, high = ["shoulder", "elbow"], torch.zeros(2), torch.ones(2)
    if not refused:
        check_units(config, pipeline, names, low, high)
        return
    with pytest.raises(ValueError, match="elbow is 45 on average, in the environment it is between 0 and 1"):
        check_units(config, pipeline, names, low, high)


def test_a_policy_of_targets_is_refused_where_actions_are_displacements(tmp_path: Path) -> None:
    """Their means may be alike. A component that is constant here may vary where the policy was trained."""
    config = read_policy_config(str(save_untrained_policy(tmp_path)), [])
    step = SimpleNamespace(stats={"action": {"mean": torch.zeros(3), "std": torch.tensor([35.0, 43.0, 0.1])}})
    names, low = ["shoulder", "elbow", "gripper"], torch.tensor([-6.0, -6.0, 0.0])
    with pytest.raises(ValueError, match=r"shoulder has a standard deviation of 35, in .* between -6 and 6"):
        check_units(config, SimpleNamespace(steps=[step]), names, low, -low)
    step.stats["action"]["std"] = torch.tensor([6.0, 10.0, 0.5])
    check_units(config, SimpleNamespace(steps=[step]), names, low, -low)
    step.stats["action"]["std"] = torch.tensor([30.0, 3.0, 0.5])
    check_units(config, SimpleNamespace(steps=[step]), names, low, -low)  # one of two
    step.stats["action"]["std"] = torch.tensor([2.0, 3e-3, 2e-7])
    at_rest = torch.tensor([-6.0, 1.185, 30.0])
    step.stats["action"]["mean"] = at_rest
    check_units(config, SimpleNamespace(steps=[step]), names, at_rest, torch.tensor([6.0, 1.185, 30.0]))


def test_the_rounded_mean_of_a_constant_component_is_in_its_range(tmp_path: Path) -> None:
    config = read_policy_config(str(save_untrained_policy(tmp_path)), [])
    held = torch.tensor([0.3])
    step = SimpleNamespace(stats={"action": {"mean": held.nextafter(torch.zeros(1))}})
    check_units(config, SimpleNamespace(steps=[step]), ["gripper"], held, held)
    step.stats = {"action": {"mean": held + 0.01}}
    with pytest.raises(ValueError, match=r"gripper is 0\.31 on average"):
        check_units(config, SimpleNamespace(steps=[step]), ["gripper"], held, held)


def test_a_copy_acts_as_it_is_told_and_its_original_stays(tmp_path: Path) -> None:
    original, copy = save_untrained_policy(tmp_path / "original", size=32), tmp_path / "copies" / "one"
    copy_checkpoint(read_policy_config(str(original), ["--max_shift=0"]), copy)
    assert [read_policy_config(str(path), []).max_shift for path in (original, copy)] == [2, 0]
    weights = (load_policy(read_policy_config(str(path), [])).state_dict() for path in (original, copy))
    assert all(torch.equal(*pair) for pair in zip(*(each.values() for each in weights), strict=True))
    assert {path.name for path in copy.iterdir()} == {path.name for path in original.iterdir()}
    copy_checkpoint(read_policy_config(str(original), ["--max_shift=1"]), copy)
    assert read_policy_config(str(copy), []).max_shift == 0, "it is there already"


def test_weights_with_two_names_are_loaded_where_a_checkpoint_holds_one(tmp_path: Path) -> None:
    def tied() -> torch.nn.ModuleDict:
        layers = torch.nn.ModuleDict({name: torch.nn.Linear(2, 2) for name in ("words", "scores", "other")})
        layers["scores"].weight = layers["words"].weight
        return layers

    saved, loaded = tied(), tied()
    save_model(saved, str(tmp_path / "model.safetensors"))
    weights = load_file(tmp_path / "model.safetensors")
    assert len(weights) == 5
    load_trained_weights(loaded, weights)
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in saved.state_dict().items())
    del weights["other.weight"]
    with pytest.raises(RuntimeError, match=r"Missing key.*other\.weight"):
        load_trained_weights(loaded, weights)

"""LeRobot's own reward models in the place of ours: its success classifier, with the normalisation it has."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from huggingface_hub import HfApi
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.rewards.classifier.configuration_classifier import RewardClassifierConfig
from lerobot.rewards.classifier.modeling_classifier import Classifier
from lerobot.rewards.classifier.processor_classifier import make_classifier_processor
from lerobot.rewards.sarm.configuration_sarm import SARMConfig
from transformers import ResNetConfig, ResNetModel

from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig

IMAGE = "observation.images.third_view"
MEAN, STD = 0.4, 0.2


@pytest.fixture(scope="module")
def classifier(tmp_path_factory) -> Path:
    """A checkpoint as lerobot-train writes it: weights, configuration, preprocessor. Its backbone's maps have
    the 4x4 places that LeRobot's head wants."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("classifier")
    backbone = ResNetModel(
        ResNetConfig(embedding_size=8, hidden_sizes=[8, 16], depths=[1, 1], layer_type="basic")
    )
    backbone.save_pretrained(folder / "backbone")
    config = RewardClassifierConfig(
        model_name=str(folder / "backbone"),
        num_cameras=1,
        num_classes=3,
        device="cpu",
        input_features={IMAGE: PolicyFeature(FeatureType.VISUAL, (3, 32, 32))},
    )
    Classifier(config).save_pretrained(folder / "trained")
    statistics = {IMAGE: {"mean": torch.full((3, 1, 1), MEAN), "std": torch.full((3, 1, 1), STD)}}
    make_classifier_processor(config, statistics)[0].save_pretrained(folder / "trained")
    return folder / "trained"


@pytest.fixture
def config(classifier, trained_models, small_dataset) -> WorldModelEnv:
    return WorldModelEnv(
        world_model_path=str(trained_models["action_world_model"]),
        dataset=StartFrames(root=str(Path(small_dataset.root))),
        reward=RewardClassifierConfig(device="cpu", pretrained_path=str(classifier)),
        episode_length=3,
        device="cpu",
    )


def test_the_environment_pays_what_lerobots_classifier_says_of_prepared_frames(config, classifier):
    env = config.create_tensor_env(4)
    env.reset(seed=0)
    model = env.reward.reward
    asked = []
    predict = model.predict
    model.predict = lambda images: asked.append(images[0]) or predict(images)
    observation, reward, *_ = env.step(torch.full((4, 7), 0.02))
    torch.testing.assert_close(asked[0], (observation[IMAGE] - MEAN) / STD, atol=1e-4, rtol=1e-4)
    expected = Classifier.from_pretrained(classifier).eval().compute_reward({IMAGE: asked[0]})
    assert torch.equal(reward, expected)


def test_a_classifier_on_the_hub_brings_its_preprocessor(config, classifier, hub, tmp_path):
    HfApi().create_repo("somebody/classifier")
    HfApi().upload_folder(repo_id="somebody/classifier", folder_path=classifier)
    published = RewardClassifierConfig(device="cpu", pretrained_path="somebody/classifier")
    env = replace(config, reward=published).create_tensor_env(4)
    image = torch.rand(4, 3, 32, 32)
    prepared = env.reward.preprocessor({IMAGE: image})
    torch.testing.assert_close(prepared[IMAGE], (image - MEAN) / STD)

    bare = tmp_path / "bare"
    shutil.copytree(classifier, bare)
    for file in bare.glob("*preprocessor.json"):
        file.unlink()
    reward = RewardClassifierConfig(device="cpu", pretrained_path=str(bare))
    with pytest.raises(ValueError, match=r"^reward\.pretrained_path=.*bare: has no preprocessor"):
        replace(config, reward=reward).create_tensor_env(1)


def test_what_an_environment_cannot_show_is_refused(config, classifier, tmp_path):
    several = r"^reward\.type=\w+: looks at earlier or later frames"
    for reward in (SARMConfig(device="cpu"), ActionWorldModelConfig(device="cpu")):
        with pytest.raises(ValueError, match=several):
            replace(config, reward=reward).create_tensor_env(1)
    text = (classifier / "config.json").read_text().replace("third_view", "top")
    elsewhere = tmp_path / "trained"
    elsewhere.mkdir()
    (elsewhere / "config.json").write_text(text)
    reward = RewardClassifierConfig(device="cpu", pretrained_path=str(elsewhere))
    with pytest.raises(ValueError, match=r"looks at observation\.images\.top, the world model imagines"):
        replace(config, reward=reward).create_tensor_env(1)

"""The two learned rewards, trained by LeRobot's own trainer and paid by the environment."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lerobot.scripts import lerobot_train

from lerobot_wmrl.common.checkpoints import weights_digest
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.rewards.configuration_rewards import EmbeddingConfig, ProxyConfig
from lerobot_wmrl.rewards.modeling_rewards import EmbeddingRewardModel, ProxyRewardModel
from lerobot_wmrl.world_models.checkpoint import load_model

IMAGE = "observation.images.third_view"
STEPS = 100


@pytest.fixture(scope="module")
def trained(small_dataset, trained_models, tmp_path_factory) -> Callable[..., Path]:
    """Trains a reward on the small dataset, → its output folder."""

    def train(kind: str, *flags: str, steps: int = STEPS) -> Path:
        folder = tmp_path_factory.mktemp("rewards") / kind
        root = Path(small_dataset.root)
        given = [
            f"--reward_model.type={kind}",
            "--reward_model.device=cpu",
            "--reward_model.hidden=32",
            "--dataset.repo_id=local/synthetic",
            f"--dataset.root={root}",
            f"--output_dir={folder}",
            "--batch_size=8",
            "--num_workers=0",
            f"--steps={steps}",
            f"--save_freq={steps}",
            *flags,
        ]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["lerobot-train", *given])
            lerobot_train.main()
        return folder

    return train


@pytest.fixture(scope="module")
def proxy(trained) -> Path:
    return trained("proxy", "--reward_model.width=16", "--reward_model.learning_rate=3e-3")


@pytest.fixture(scope="module")
def embedding(trained, trained_models) -> Path:
    path = trained_models["action_world_model"]
    return trained("embedding", f"--reward_model.world_model_path={path}", steps=4)


def environment(trained_models, small_dataset, kind: str, path: Path | None) -> WorldModelEnv:
    config = {"proxy": ProxyConfig, "embedding": EmbeddingConfig}[kind]
    return WorldModelEnv(
        world_model_path=str(trained_models["action_world_model"]),
        dataset=StartFrames(root=str(Path(small_dataset.root))),
        reward=config(device="cpu", pretrained_path=path and str(path)),
        episode_length=3,
        device="cpu",
    )


def test_the_proxy_learns_what_frames_were_worth(proxy, small_dataset):
    """`next.reward` of row t is about frame t + 1: the trained network tells successes from the rest."""
    model = load_model(proxy, "proxy")
    rows = [small_dataset[index] for index in range(len(small_dataset))]
    image = torch.stack([row[IMAGE] for row in rows])
    reward = torch.stack([row["next.reward"] for row in rows]).flatten()
    episode = torch.stack([row["episode_index"] for row in rows]).flatten()
    same = episode[1:] == episode[:-1]
    with torch.no_grad():
        found = model.compute_reward({IMAGE: image[1:][same]})
    earned = reward[:-1][same]
    assert found[earned == 1].mean() > found[earned == 0].mean() + 0.3


@pytest.mark.parametrize("kind", ["proxy", "embedding"])
def test_the_environment_pays_what_the_trained_reward_says(kind, request, trained_models, small_dataset):
    """Without goal frames, so without a text world model."""
    path = request.getfixturevalue(kind)
    env = environment(trained_models, small_dataset, kind, path).create_tensor_env(3)
    env.reset(seed=0)
    asked = []
    compute = env.reward.compute_reward
    env.reward.compute_reward = lambda batch: asked.append(batch) or compute(batch)
    observation, reward, *_, info = env.step(torch.full((3, 7), 0.01))
    key = {"proxy": IMAGE, "embedding": "hidden"}[kind]
    assert torch.equal(reward, load_model(path, kind).compute_reward({key: asked[0][key]}))
    assert torch.equal(asked[0][IMAGE], observation[IMAGE])
    assert "similarity" not in info["reward_parts"]


def test_windows_and_imagination_meet_the_same_hidden_states(embedding, trained_models, small_dataset):
    """lerobot-train shows the head windows padded at the front; imagination begins at a first frame."""
    reward = load_model(embedding, "embedding")
    reward.config.world_model_path = str(trained_models["action_world_model"])
    model = reward.world_model
    rows = [small_dataset[index] for index in range(3)]
    length = model.config.clip_length
    order = [0] * (length - 3) + [0, 1, 2]
    batch = {
        name: torch.stack([rows[index][name] for index in order])[None]
        for name in (IMAGE, "observation.state", "action")
    }
    batch["observation.images.third_view_is_pad"] = torch.arange(length)[None] < length - 3
    whole = reward.compute_reward({**batch, "task": [""]})
    images = batch[IMAGE][:, -3:]
    tokens = model.tokenizer.encode(images[:, 0][:, None])
    imagination = model.start(Frames(tokens, batch["observation.state"][:, -3]))
    steps = [model.step(imagination, action) for action in batch["action"][:, -3:].unbind(1)]
    stepped = torch.cat([reward.compute_reward({"hidden": step.hidden}) for step in steps])
    batch["next.reward"] = torch.arange(length)[None].float()
    loss, _ = reward({**batch, "task": [""]})
    torch.testing.assert_close(loss, (stepped - batch["next.reward"][0, -3:]).square().mean())
    torch.testing.assert_close(stepped[-1:], whole, atol=1e-4, rtol=1e-4)


def test_the_world_model_is_no_part_of_the_heads_checkpoint(embedding, trained_models):
    reward = load_model(embedding, "embedding")
    assert all(name.startswith("head.") for name in reward.state_dict())
    assert reward.config.world_model == weights_digest(
        load_model(trained_models["action_world_model"], "action_world_model").state_dict()
    )


def test_a_reward_of_another_world_model_is_refused(embedding, trained_models, small_dataset, tmp_path):
    from tests.trained import action_config, run_training

    root = Path(small_dataset.root)
    other = run_training(action_config(trained_models["frame_tokenizer"]), root, tmp_path / "other", steps=1)
    config = environment({"action_world_model": other}, small_dataset, "embedding", embedding)
    with pytest.raises(ValueError, match="hidden states of another world model"):
        config.create_tensor_env(1)


def test_a_reward_for_another_camera_is_refused(trained_models, small_dataset, tmp_path):
    """Before an episode begins."""
    reward = ProxyRewardModel(ProxyConfig(device="cpu", cameras=["wrist"], image_size=32))
    reward.save_pretrained(tmp_path)
    config = environment(trained_models, small_dataset, "proxy", tmp_path)
    with pytest.raises(ValueError, match=r"looks at wrist, the world model imagines third_view;"):
        config.create_tensor_env(1)


def test_bad_settings_name_the_field_and_the_remedy(trained_models, small_dataset, proxy):
    with pytest.raises(ValueError, match=r"^reward\.pretrained_path=None: .*lerobot-train"):
        environment(trained_models, small_dataset, "proxy", None).create_tensor_env(1)
    with pytest.raises(ValueError, match="'embedding' is needed here"):
        environment(trained_models, small_dataset, "embedding", proxy).create_tensor_env(1)
    with pytest.raises(ValueError, match=r"^world_model_path=None: .*give the action world model"):
        EmbeddingRewardModel(EmbeddingConfig(device="cpu"))
    with pytest.raises(ValueError, match=r"hidden=0: must be at least 1"):
        ProxyConfig(device="cpu", hidden=0)
    with pytest.raises(ValueError, match=r"image_size=0: must be at least 8"):
        ProxyRewardModel(ProxyConfig(device="cpu"))
    model = ProxyRewardModel(ProxyConfig(device="cpu", image_size=32))
    images = {IMAGE: torch.zeros(2, 3, 32, 32)}
    with pytest.raises(ValueError, match=r"next\.reward: the dataset has none"):
        model(images)
    with pytest.raises(ValueError, match=r"next\.reward: contains NaN"):
        model({**images, "next.reward": torch.tensor([0.0, torch.nan])})

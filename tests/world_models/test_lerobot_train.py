"""LeRobot's own trainer on LeRobotDatasets that this project did not record."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file

from lerobot_wmrl.data.clips import clip_from_windows
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.world_models import losses
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig
from lerobot_wmrl.world_models.processor_world_model import make_pass_through_processors

SIZE, ACTIONS, LENGTHS = 32, 3, (9, 14, 2)
LAST = Path("checkpoints") / "last" / "pretrained_model"
SMALL = [
    "--reward_model.dynamics.layers=1",
    "--reward_model.dynamics.width=32",
    "--reward_model.dynamics.heads=2",
    "--reward_model.dynamics.code_width=8",
    "--reward_model.clip_length=6",
]


@pytest.fixture(scope="module")
def foreign_dataset(tmp_path_factory) -> Path:
    """Two cameras with names of their own, stored as images, one channels first; no state, no labels."""
    first = {"dtype": "image", "shape": (3, SIZE, SIZE), "names": ["channels", "height", "width"]}
    last = {"dtype": "image", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]}
    action = {"dtype": "float32", "shape": (ACTIONS,), "names": None}
    features: dict[str, Any] = {
        "observation.images.top": last,
        "observation.images.left.fisheye": first,
        "action": action,
    }
    root, rng = tmp_path_factory.mktemp("foreign") / "dataset", np.random.default_rng(0)
    dataset = LeRobotDataset.create("somebody/foreign", 10, features, root=root, use_videos=False)
    for length in LENGTHS:
        for _ in range(length):
            picture = rng.integers(0, 255, (SIZE, SIZE, 3), dtype=np.uint8)
            dataset.add_frame(
                {
                    "observation.images.top": picture,
                    "observation.images.left.fisheye": picture.transpose(2, 0, 1),
                    "action": rng.normal(size=ACTIONS).astype(np.float32),
                    "task": "stir",
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root


def lerobot_trained(monkeypatch: pytest.MonkeyPatch, output_dir: Path, *flags: str) -> Path:
    """What `lerobot-train` with these flags and a few more leaves in `output_dir`."""
    settings = ["--reward_model.device=cpu", "--batch_size=4", "--num_workers=0", "--log_freq=1"]
    settings += [f"--output_dir={output_dir}", "--save_freq=2"]
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *settings, *flags])
    lerobot_train.main()
    return output_dir


def on(root: Path, steps: int) -> list[str]:
    return [f"--dataset.repo_id=local/{root.name}", f"--dataset.root={root}", f"--steps={steps}"]


@pytest.fixture(scope="module")
def foreign_tokenizer(foreign_dataset, tmp_path_factory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        return lerobot_trained(
            patch,
            tmp_path_factory.mktemp("tokenizer") / "run",
            *on(foreign_dataset, 2),
            "--reward_model.type=frame_tokenizer",
            f"--reward_model.tokenizer.image_size={SIZE}",
            "--reward_model.tokenizer.cameras=[top,left.fisheye]",
            "--reward_model.tokenizer.widths=[8,16]",
            "--reward_model.tokenizer.levels=[5,4]",
        )


def test_a_world_model_of_any_dataset_goes_on_bit_for_bit(
    foreign_dataset, foreign_tokenizer, monkeypatch, tmp_path
):
    """As `lerobot-train --resume=true` continues it: with its samples, but not with its random numbers."""
    monkeypatch.setattr(losses, "TOKEN_NOISE", 0.0)
    flags = [
        "--reward_model.type=action_world_model",
        f"--reward_model.tokenizer_path={foreign_tokenizer}",
        "--reward_model.dynamics.type=autoregressive",
        "--reward_model.dynamics.self_forcing=0",
    ]
    whole = lerobot_trained(monkeypatch, tmp_path / "run", *on(foreign_dataset, 4), *flags, *SMALL)
    expected = load_file(whole / LAST / "model.safetensors")
    (whole / "checkpoints" / "000004").rename(tmp_path / "lost")
    link = whole / "checkpoints" / "last"
    link.unlink()
    link.symlink_to("000002")
    lerobot_trained(
        monkeypatch, whole, "--resume=true", f"--config_path={whole / LAST / 'train_config.json'}"
    )
    resumed = load_file(whole / LAST / "model.safetensors")
    assert (link.resolve().name, expected.keys()) == ("000004", resumed.keys())
    assert all(torch.equal(expected[name], resumed[name]) for name in expected)
    model = load_model(whole, "action_world_model")
    assert model.config.tokenizer.cameras == ["top", "left.fisheye"]
    assert (model.config.action_size, model.config.state_size) == (ACTIONS, 0)
    first = torch.zeros(2, model.tokenizer.tokens_per_frame, dtype=torch.long)
    ahead = model.open_loop(Frames(first, torch.empty(2, 0)), torch.randn(2, 5, ACTIONS))
    assert (ahead.done_logit.sigmoid() < 0.01).all(), "the dataset does not say what success is"


def test_a_text_world_model_of_a_dataset_with_videos_states_and_labels(
    small_dataset, trained_models, monkeypatch, tmp_path
):
    model = [
        "--reward_model.type=text_world_model",
        "--reward_model.goal_horizon=3",
        f"--reward_model.tokenizer_path={trained_models['frame_tokenizer']}",
    ]
    folder = lerobot_trained(monkeypatch, tmp_path / "run", *on(Path(small_dataset.root), 2), *model, *SMALL)
    before = load_file(folder / "checkpoints" / "000002" / "pretrained_model" / "model.safetensors")
    assert all(torch.isfinite(value).all() for value in before.values())
    assert load_model(folder, "text_world_model").config.state_size == 8


def windows(length: int, padded: list[int]) -> dict[str, Any]:
    """Windows of which so many rows lie before their episode and repeat its first one, as LeRobot's do."""
    row = torch.stack([(torch.arange(length) - before).clamp(min=0) for before in padded]).float()
    return {
        "action": row[..., None],
        "observation.state": row[..., None] + 100,
        "task": ["stir"] * len(padded),
        "next.done": torch.tensor([True, False, True]),
        "camera_is_pad": torch.stack([torch.arange(length) < before for before in padded]),
    }


def test_a_window_that_begins_before_its_episode_becomes_a_clip_from_its_start():
    batch = windows(5, [2, 1, 0])
    tokens = batch["action"].long()
    clip = clip_from_windows(tokens, batch, "camera", state_size=1)
    assert clip.action[..., 0].tolist() == [[0, 1, 2, 2, 2], [0, 1, 2, 3, 3], [0, 1, 2, 3, 4]]
    assert torch.equal(clip.tokens, clip.action.long())
    assert torch.equal(clip.state, clip.action + 100)
    assert clip.valid.sum(1).tolist() == [3, 4, 5]
    assert clip.valid[:, 0].all()


def test_only_windows_that_hold_their_episodes_start_have_a_done_label_and_it_is_the_last_rows():
    batch = windows(5, [2, 1, 0])
    clip = clip_from_windows(batch["action"].long(), batch, "camera", state_size=0)
    assert clip.done_known.nonzero().tolist() == [[0, 2], [1, 3]]
    assert clip.done[clip.done_known].tolist() == [1, 0]
    row = torch.arange(-1, 5) - torch.tensor([[2], [1], [0]])
    more = {"action": row.clamp(min=0)[..., None].float(), "action_is_pad": row < 0}
    clip = clip_from_windows(batch["action"].long(), {**batch, **more}, "camera", state_size=0)
    assert clip.action[..., 0].tolist() == [[0, 1, 2, 2, 2], [0, 1, 2, 3, 3], [0, 1, 2, 3, 4]]
    assert clip.done_known.nonzero().tolist() == [[0, 2], [1, 3], [2, 4]]
    unlabelled = clip_from_windows(
        batch["action"].long(), {**batch, "next.done": False}, "camera", state_size=0
    )
    assert not unlabelled.done_known.any()


@pytest.mark.parametrize(
    ("labels", "expected"),
    [
        ({"next.done": [[True], [True]], "next.success": [[False], [True]]}, [[False], [True]]),
        ({"next.done": [[True], [False]]}, [[True], [False]]),
        ({}, False),
    ],
)
def test_done_is_success_where_a_dataset_tells_them_apart(labels, expected):
    preprocess, _ = make_pass_through_processors(ActionWorldModelConfig(device="cpu"))
    batch = {name: torch.tensor(values) for name, values in labels.items()}
    done = preprocess({"action": torch.zeros(2, 4, 3), **batch})["next.done"]
    assert (done.tolist() if labels else done) == expected


def test_vectors_of_one_component_are_vectors(tmp_path):
    """LeRobot stores them as scalars."""
    one = {"dtype": "float32", "shape": (1,), "names": None}
    dataset = LeRobotDataset.create(
        "somebody/slider",
        10,
        {"action": one, "observation.state": one},
        root=tmp_path / "dataset",
        use_videos=False,
    )
    for row in np.arange(4, dtype=np.float32):
        dataset.add_frame({"action": row[None], "observation.state": row[None] + 100, "task": "slide"})
    dataset.save_episode()
    dataset.finalize()
    table = read_episodes(open_dataset(tmp_path / "dataset"))
    assert table.action.tolist() == [[0], [1], [2], [3]]
    assert (table.state == table.action + 100).all()
    batch = {"action": torch.arange(6.0).view(2, 3), "observation.state": torch.arange(6.0).view(2, 3)}
    clip = clip_from_windows(torch.zeros(2, 3, 4), batch, "camera", state_size=1)
    assert clip.action.tolist() == clip.state.tolist() == [[[0], [1], [2]], [[3], [4], [5]]]


def test_the_reward_of_a_window_does_not_depend_on_what_pads_it(small_dataset, trained_models):
    model = load_model(trained_models["action_world_model"], "action_world_model")
    torch.manual_seed(0)
    images, state, action = torch.rand(1, 4, 3, 32, 32), torch.randn(1, 4, 8), torch.randn(1, 4, 7)
    key = "observation.images.third_view"
    whole = {key: images, "observation.state": state, "action": action}
    first = {name: torch.cat([value[:, :1]] * 3 + [value], 1) for name, value in whole.items()}
    padded = {**first, f"{key}_is_pad": torch.arange(7)[None] < 3}
    torch.testing.assert_close(model.compute_reward(padded), model.compute_reward(whole))

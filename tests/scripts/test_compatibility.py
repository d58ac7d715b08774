"""Datasets as people have them: the whole way for each, at tiny size. The page "own data" lists them."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.configs.types import FeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_wmrl.common.checkpoints import Checkpoint
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.checks import camera_names
from lerobot_wmrl.data.dataset import ChosenEpisodes, open_dataset
from lerobot_wmrl.scripts.eval_world_model import EvalWorldModelConfig, eval_world_model
from lerobot_wmrl.world_models.checkpoint import read_config
from tests.scripts.test_train import improve
from tests.trained import action_config, run_training, tokenizer_config

PAGE = Path(__file__).parents[2] / "docs" / "supported_data.md"


@dataclass(frozen=True)
class Data:
    """A dataset.

    Args:
        cameras: key and size (height, width) of each.
        video: whether frames are stored as videos, else as images.
        fps: frames a second.
        state: components of the state, 0 for none.
        action: components of the action.
        control: `joints in degrees`, absolute, or `displacements`.
        constant: components of the action that never change.
        labels: columns that say when the task is solved.
        lengths: frames of each episode.
    """

    cameras: dict[str, tuple[int, int]]
    video: bool
    fps: int
    state: int
    action: int
    control: str = "joints in degrees"
    constant: int = 0
    labels: tuple[str, ...] = ("next.success",)
    lengths: tuple[int, ...] = (8, 8, 8)

    def row(self) -> list[str]:
        """Return the cells of the page's table."""
        sizes = dict.fromkeys(f"{width}x{height}" for height, width in self.cameras.values())
        longest, shortest = max(self.lengths), min(self.lengths)
        return [
            f"{len(self.cameras)}: {', '.join(sizes)}",
            "video" if self.video else "images",
            f"{self.fps}",
            f"{self.state or 'none'}",
            f"{self.action}, {self.control}" + (f", {self.constant} constant" if self.constant else ""),
            ", ".join(f"`{name}`" for name in self.labels) or "none",
            f"{longest}" if shortest == longest else f"{shortest} to {longest}",
        ]


TOP, WRIST, FRONT = (f"observation.images.{name}" for name in ("top", "wrist", "front"))
WORKS = {
    "pusht": Data({OBS_IMAGE: (96, 96)}, False, 10, 2, 2, lengths=(30, 30)),
    "webcams": Data({TOP: (480, 640), WRIST: (480, 640)}, True, 30, 6, 6, labels=("next.done",)),
    "mixed": Data({TOP: (480, 640), WRIST: (64, 64), FRONT: (720, 1280)}, False, 5, 0, 4, "displacements", 2),
    "bimanual": Data({TOP: (48, 64), WRIST: (48, 64)}, True, 50, 14, 14, lengths=(300, 250)),
    "humanoid": Data({FRONT: (64, 64)}, False, 30, 32, 32),
    "short": Data(
        {TOP: (32, 32)}, False, 25, 8, 7, "displacements", 4, ("next.success", "next.done"), (1, 2, 9)
    ),
    "long": Data({TOP: (32, 32)}, False, 50, 1, 1, lengths=(2000,)),
}


SMALL = Data({TOP: (32, 32)}, False, 10, 2, 2, lengths=(8, 8))


def record(root: Path, data: Data) -> Path:
    """Record such a dataset with LeRobot's own functions; all but the first episode succeed at their end."""
    rng = np.random.default_rng(0)
    features: dict[str, Any] = {ACTION: {"dtype": "float32", "shape": (data.action,), "names": None}}
    if data.state:
        features[OBS_STATE] = {"dtype": "float32", "shape": (data.state,), "names": None}
    for key, size in data.cameras.items():
        kind = "video" if data.video else "image"
        features[key] = {"dtype": kind, "shape": (*size, 3), "names": ["height", "width", "channels"]}
    features |= {name: {"dtype": "bool", "shape": (1,), "names": None} for name in data.labels}
    dataset = LeRobotDataset.create("local/own", data.fps, features, root=root, use_videos=data.video)
    for episode, length in enumerate(data.lengths):
        pose = rng.uniform(-30, 30, data.action)
        for frame in range(length):
            change = rng.uniform(-2, 2, data.action)
            change[: data.constant] = 0
            pose += change
            action = pose if data.control.startswith("joints") else change / 40
            row = {ACTION: action.astype(np.float32), "task": "do it"}
            if data.state:
                row[OBS_STATE] = np.resize(pose, data.state).astype(np.float32)
            for key, size in data.cameras.items():
                row[key] = np.full((*size, 3), frame % 250, np.uint8)
            solved = frame >= length - 3 and (episode > 0 or len(data.lengths) == 1)
            row |= {name: np.array([solved]) for name in data.labels}
            dataset.add_frame(row)
        dataset.save_episode()
    dataset.finalize()
    return root


def save_policy(root: Path, folder: Path) -> Path:
    """Save an untrained policy that fits the dataset, as lerobot-train would make it."""
    meta = open_dataset(root).meta
    features = dataset_to_policy_features(meta.features)
    seen = {
        key: each for key, each in features.items() if each.type in (FeatureType.VISUAL, FeatureType.STATE)
    }
    config = CnnConfig(device="cpu", input_features=seen, output_features={ACTION: features[ACTION]})
    CnnPolicy(config).save_pretrained(folder)
    for processor in make_pre_post_processors(config, dataset_stats=meta.stats):
        processor.save_pretrained(folder)
    return folder


def learn(root: Path, folder: Path) -> Path:
    """Train a tokenizer and a world model for a step each."""
    cameras = camera_names(open_dataset(root).meta.camera_keys)
    config = tokenizer_config(cameras=cameras, context=True)
    tokenizer = run_training(config, root, folder / "tokenizer", steps=1)
    return run_training(action_config(tokenizer), root, folder / "world_model", steps=1)


def reinforce(
    monkeypatch: pytest.MonkeyPatch, root: Path, world_model: Path, folder: Path
) -> dict[str, float]:
    """Train a policy in imagination for one iteration; return its metrics."""
    improve(
        monkeypatch,
        f"--policy.path={save_policy(root, folder / 'policy')}",
        "--algorithm.type=ppo",
        "--num_envs=2",
        "--iterations=1",
        "--algorithm.value_iterations=1",
        "--env.type=world_model",
        f"--env.world_model_path={world_model}",
        f"--env.dataset.root={root}",
        "--env.episode_length=6",
        "--env.reward.type=general",
        "--env.reward.alpha=1",
        "--gate.action=off",
        f"--output_dir={folder / 'rl'}",
    )
    return read_metrics(folder / "rl")[-1]


@pytest.mark.parametrize("name", WORKS)
def test_a_world_model_and_a_policy_learn_from_it(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = record(tmp_path / "data", WORKS[name])
    world_model = learn(root, tmp_path)
    eval_world_model(
        EvalWorldModelConfig(
            model=Checkpoint(str(world_model)),
            dataset=ChosenEpisodes(str(root)),
            output_dir=tmp_path / "check",
        )
    )
    metrics = reinforce(monkeypatch, root, world_model, tmp_path)
    assert metrics["step"] == 1
    assert math.isfinite(metrics["policy_loss"])


def set_statistics(root: Path, key: str, **statistics: object) -> None:
    """Write other statistics of a feature; none of it if nothing is given."""
    path = root / "meta" / "stats.json"
    stats = json.loads(path.read_text())
    stats[key] = {**stats[key], **statistics} if statistics else {}
    path.write_text(json.dumps(stats))


def change_rows(root: Path, key: str, change: Callable[[int, Any], Any]) -> None:
    """Replace a column's values by what `change` makes of row and value."""
    path = next((root / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    changed = [change(row, value) for row, value in enumerate(table[key].to_pylist())]
    kind = pa.list_(pa.float32())
    pq.write_table(table.drop_columns(key).append_column(key, pa.array(changed, kind)), path)


NAN = float("nan")
SPOILED: dict[str, tuple[Callable[[Path], None], str]] = {
    "NaN in the statistics": (
        lambda root: set_statistics(root, ACTION, mean=[NAN, 0.0]),
        r"the mean of action is \[nan, 0\.0\], where 2 finite numbers.*recompute_stats",
    ),
    "statistics of another width": (
        lambda root: set_statistics(root, OBS_STATE, std=[1.0] * 3),
        r"the std of observation\.state is \[1\.0",
    ),
    "no statistics": (lambda root: set_statistics(root, ACTION), r"the mean of action is \[\]"),
    "NaN in a frame": (
        lambda root: change_rows(root, ACTION, lambda row, each: [NAN] * 2 if row == 9 else each),
        r"action of episode 1, frame 1, is \[nan, nan\]; remove the episode: lerobot-edit-dataset",
    ),
    "a feature that ends midway": (
        lambda root: change_rows(root, OBS_STATE, lambda row, each: None if row > 11 else each),
        r"observation\.state of episode 1, frame 4, is missing",
    ),
    "a feature that grows midway": (
        lambda root: change_rows(root, ACTION, lambda row, each: [*each, 1.0] if row > 11 else each),
        r"cannot be opened|action of episode 1, frame 4",
    ),
}


@pytest.mark.parametrize("name", SPOILED)
def test_what_is_wrong_with_a_dataset_is_said_before_anything_is_made(name: str, tmp_path: Path) -> None:
    root, models = record(tmp_path / "data", SMALL), tmp_path / "models"
    tokenizer = run_training(tokenizer_config(cameras=["top"]), root, tmp_path / "tokenizer", steps=1)
    spoil, message = SPOILED[name]
    spoil(root)
    before = sorted(root.rglob("*"))
    with pytest.raises(FieldError, match=message):
        run_training(action_config(tokenizer), root, models, steps=1)
    assert not models.exists()
    assert sorted(root.rglob("*")) == before


def test_constants_and_one_outlier_do_no_harm(tmp_path: Path) -> None:
    root = record(tmp_path / "data", SMALL)
    set_statistics(root, OBS_STATE, std=[0.0, 0.0])
    change_rows(root, ACTION, lambda row, each: [1e6, 1e6] if row == 5 else each)
    trained = read_config(learn(root, tmp_path), "action_world_model")
    assert max(trained.embodiment.action_high) < 1e6


def test_the_page_lists_them() -> None:
    page = PAGE.read_text()
    for data in WORKS.values():
        assert f"| {' | '.join(data.row())} |" in page


def test_without_labels_a_world_model_is_trained_but_does_not_reward(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    root = record(tmp_path / "data", replace(SMALL, labels=()))
    world_model = learn(root, tmp_path)
    assert "no episode is known to succeed" in caplog.text
    with pytest.raises(SystemExit):
        reinforce(monkeypatch, root, world_model, tmp_path)
    said = capsys.readouterr().err
    assert (
        f"--env.world_model_path={world_model}: has learnt from no episode that is known to succeed" in said
    )
    assert "lerobot-wmrl-label" in said
    assert not (tmp_path / "rl").exists()


def test_without_failures_it_says_what_no_gate_can_tell(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = record(tmp_path / "data", replace(SMALL, lengths=(8,)))
    learn(root, tmp_path)
    assert "no episode is known to fail" in caplog.text

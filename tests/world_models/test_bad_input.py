"""What is wrong with a dataset, a checkpoint or a setting is named, and nothing is written."""

import os
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from lerobot_wmrl.common.checkpoints import Checkpoint
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import ChosenEpisodes, DatasetSource, open_dataset
from lerobot_wmrl.data.episodes import choose_episodes, read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.scripts import train_world_model
from lerobot_wmrl.scripts.eval_world_model import EvalWorldModelConfig, eval_world_model
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.training_data import make_sampler
from tests.trained import (
    action_config,
    run_training,
    small_tokenizer,
    text_config,
    tokenizer_config,
    train_tokenizer,
)


def test_wrong_input_is_named(small_dataset, trained_models, tmp_path):
    tokenizer, root = trained_models["frame_tokenizer"], Path(small_dataset.root)
    with pytest.raises(ValueError, match="type 'frame_tokenizer', but 'action_world_model' is needed"):
        load_model(tokenizer, "action_world_model")
    with pytest.raises(ValueError, match="no LeRobotDataset there"):
        run_training(action_config(tokenizer), tmp_path / "nothing", tmp_path / "a")
    config = action_config(tokenizer)
    config.tokenizer_path = None
    for config.tokenizer in (None, small_tokenizer()):  # settings alone make no trained tokenizer
        with pytest.raises(FieldError, match=r"^tokenizer_path=None: is missing"):
            run_training(config, root, tmp_path / "b")
    with pytest.raises(FieldError, match=r"^batch_size=1: must be at least 2"):
        run_training(tokenizer_config(success=True, context=True), root, tmp_path / "c", batch_size=1)
    with pytest.raises(ValueError, match="type=general: this command trains frame_tokenizer"):
        run_training(GeneralConfig(device="cpu"), root, tmp_path / "d")
    assert not (tmp_path / "a").exists()
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.txt").write_text("precious")
    with pytest.raises(ValueError, match="holds something else"):
        train_tokenizer(root, tmp_path / "foreign")
    assert (tmp_path / "foreign" / "thesis.txt").read_text() == "precious"


def test_imagined_frames_have_the_size_of_the_world_models_dataset(
    make_synthetic_dataset, trained_models, tmp_path
):
    """Which may be another than that of the tokenizer's."""
    root = Path(make_synthetic_dataset(tmp_path / "larger", episodes=2, size=48).root)
    folder = run_training(action_config(trained_models["frame_tokenizer"]), root, tmp_path / "model")
    config = load_model(folder, "action_world_model").config
    assert config.observation_shapes["observation.images.third_view"] == (3, 48, 48)


def test_another_dataset_than_the_tokenizers_is_named(make_synthetic_dataset, trained_models, tmp_path):
    """In training, in replays and where imagined episodes begin, and nothing is written."""
    root = Path(make_synthetic_dataset(tmp_path / "other", episodes=2, cameras=("top",)).root)
    message = r"no observation\.images\.third_view \(its cameras: observation\.images\.top\)"
    with pytest.raises(ValueError, match=message):
        run_training(action_config(trained_models["frame_tokenizer"]), root, tmp_path / "out")
    source, model = ChosenEpisodes(str(root)), Checkpoint(str(trained_models["action_world_model"]))
    with pytest.raises(ValueError, match=message):
        eval_world_model(EvalWorldModelConfig(model=model, dataset=source, output_dir=tmp_path / "out"))
    env = WorldModelEnv(
        world_model_path=model.path,
        text_world_model_path=str(trained_models["text_world_model"]),
        dataset=StartFrames(str(root)),
    )
    with pytest.raises(ValueError, match=message):
        env.create_tensor_env(2)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"patch": 3}, r"dynamics\.patch=3: must divide"),
        ({"heads": 3}, r"dynamics\.width=32: must be"),
        ({"clip_length": 1}, r"clip_length=1: must be"),
        ({"state_size": -1}, r"state_size=-1: must be"),
    ],
)
def test_impossible_sizes_are_named(setting, message, small_dataset, trained_models, tmp_path):
    with pytest.raises(ValueError, match=message):
        run_training(
            action_config(trained_models["frame_tokenizer"], **setting),
            Path(small_dataset.root),
            tmp_path / "out",
        )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["steps", "batch_size", "save_freq", "log_freq"])
def test_impossible_schedules_are_named(name, small_dataset, tmp_path):
    with pytest.raises(FieldError, match=f"^{name}=0: must be at least 1"):
        train_tokenizer(Path(small_dataset.root), tmp_path / "out", **{name: 0})


def test_a_truncated_configuration_is_named(trained_models, tmp_path):
    source = trained_models["frame_tokenizer"] / "checkpoints" / "last" / "pretrained_model"
    shutil.copytree(source, tmp_path / "copy")
    os.truncate(tmp_path / "copy" / "config.json", 40)
    with pytest.raises(ValueError, match=r"config\.json: is truncated"):
        load_model(tmp_path / "copy", "frame_tokenizer")


def test_a_truncated_checkpoint_is_named(trained_models, tmp_path):
    source = trained_models["frame_tokenizer"] / "checkpoints" / "last" / "pretrained_model"
    for path in source.iterdir():
        content = path.read_bytes()
        (tmp_path / path.name).write_bytes(
            content[: len(content) // 2 if path.suffix == ".safetensors" else None]
        )
    with pytest.raises(ValueError, match="truncated"):
        load_model(tmp_path, "frame_tokenizer")


def test_a_corrupted_episode_file_is_named_and_may_be_copied_again(small_dataset, tmp_path):
    root = tmp_path / "dataset"
    shutil.copytree(small_dataset.root, root)
    video = next(root.rglob("*.mp4"))
    os.truncate(video, video.stat().st_size // 3)
    with pytest.raises(ValueError, match=rf"episode \d+: .*{video.name} cannot be decoded .*record it again"):
        train_tokenizer(root, tmp_path / "run", steps=1)
    assert not (tmp_path / "run").exists()
    shutil.copy(Path(small_dataset.root) / video.relative_to(root), video)
    train_tokenizer(root, tmp_path / "run", steps=1)
    keys = ["observation.images.third_view"]
    frames = [cached_frames(open_dataset(each), keys, 32) for each in (root, small_dataset.root)]
    np.testing.assert_array_equal(*frames)


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("*.mp4", r"1 files are missing, the first is videos/.*mp4"),
        ("data/**/*.parquet", r"1 files are missing, the first is data/.*parquet"),
    ],
)
def test_a_missing_file_is_named_and_not_downloaded(pattern, message, small_dataset, tmp_path):
    root = tmp_path / "dataset"
    shutil.copytree(small_dataset.root, root)
    next(root.rglob(pattern)).unlink()
    with pytest.raises(ValueError, match=message):
        train_tokenizer(root, tmp_path / "run", steps=1)
    assert not (tmp_path / "run").exists()


def test_a_table_that_lacks_episodes_is_named_and_nothing_is_downloaded(small_dataset, tmp_path):
    root = tmp_path / "dataset"
    shutil.copytree(small_dataset.root, root)
    table = next((root / "meta" / "episodes").rglob("*.parquet"))
    pq.write_table(pq.read_table(table).slice(1), table)
    with pytest.raises(ValueError, match=r"cannot be opened \(meta/episodes has 5 of 6 episodes\)"):
        train_tokenizer(root, tmp_path / "run", steps=1)


def test_truncated_numbers_are_named(small_dataset, tmp_path):
    root = tmp_path / "dataset"
    shutil.copytree(small_dataset.root, root)
    table = next((root / "data").rglob("*.parquet"))
    os.truncate(table, table.stat().st_size // 2)
    with pytest.raises(ValueError, match=r"dataset\.root=.*cannot be opened .*record it again"):
        train_tokenizer(root, tmp_path / "run", steps=1)
    assert not (tmp_path / "run").exists()


def with_value(source: Path, root: Path, column: str, row: int, value: float) -> Path:
    """A copy of a dataset with another number in the first place of a row's column."""
    shutil.copytree(source, root)
    path = next((root / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    rows = [np.asarray(cell, np.float32) for cell in table[column].to_pylist()]
    rows[row][0] = value
    kind = table.schema.field(column).type
    cells = pa.array([cell.tolist() for cell in rows], kind)
    pq.write_table(table.set_column(table.column_names.index(column), column, cells), path)
    return root


@pytest.mark.parametrize(("column", "value"), [("action", np.nan), ("observation.state", -np.inf)])
def test_numbers_that_are_none_are_named_with_their_episode(column, value, small_dataset, tmp_path):
    row = int(read_episodes(small_dataset).start[2]) + 4
    root = with_value(Path(small_dataset.root), tmp_path / "dataset", column, row, value)
    with pytest.raises(
        ValueError, match=rf"{column} of episode 2, frame 4, is \[.*{value}.*episode_indices=\[2\]"
    ):
        train_tokenizer(root, tmp_path / "run", steps=1)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("build", [action_config, text_config])
def test_episodes_of_one_frame_are_named(build, make_synthetic_dataset, trained_models, tmp_path):
    root = Path(make_synthetic_dataset(tmp_path / "dataset", episodes=3, length=1).root)
    with pytest.raises(
        ValueError,
        match="3 episodes to learn from, of 3 frames in all; a world model learns from episodes of",
    ):
        run_training(build(trained_models["frame_tokenizer"]), root, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_chosen_episodes_of_one_frame_are_named(small_dataset, trained_models):
    """Others of the dataset may be longer."""
    table = read_episodes(small_dataset)
    table.length[[1, 3]] = 1
    model = load_model(trained_models["action_world_model"], "action_world_model")
    with pytest.raises(FieldError, match=r"^dataset\.root=.*: 2 episodes to learn from, of 2 frames in all"):
        make_sampler(model, table, [1, 3], batch_size=2, seed=0)
    assert len(make_sampler(model, table, [1, 2], batch_size=2, seed=0).episodes) == 2


def test_a_recording_that_was_stopped_is_named_as_such(small_dataset, tmp_path):
    """LeRobot writes the table of episodes at the end, and looks for one that is missing on the hub."""
    root = tmp_path / "stopped"
    shutil.copytree(small_dataset.root, root)
    shutil.rmtree(root / "meta" / "episodes")
    for source in (DatasetSource(str(root)), DatasetSource(str(root), "somebody/else")):
        with pytest.raises(FieldError, match=r"^dataset\.root=.*stopped: its recording was not finished"):
            source.open()


def test_a_camera_that_a_further_dataset_lacks_is_named_with_it(
    small_dataset, make_synthetic_dataset, tmp_path, capsys, monkeypatch
):
    other = make_synthetic_dataset(tmp_path / "other", episodes=2, length=5, cameras=("wrist",)).root
    monkeypatch.setattr(
        "sys.argv",
        [
            "lerobot-wmrl-train-world-model",
            "--model.type=frame_tokenizer",
            "--model.device=cpu",
            "--model.tokenizer.cameras=[third_view]",
            "--model.tokenizer.image_size=32",
            f"--dataset.root={small_dataset.root}",
            f"--dataset.more=[{other}]",
            f"--output_dir={tmp_path / 'run'}",
        ],
    )
    with pytest.raises(SystemExit):
        train_world_model.main()
    assert (
        f"--dataset.more={other}: the dataset has no observation.images.third_view" in capsys.readouterr().err
    )


def test_a_split_without_episodes_is_named(small_dataset):
    with pytest.raises(FieldError, match=r"^split=validation: .* has no episode in it"):
        choose_episodes(read_episodes(small_dataset), "validation", 5)


def test_episodes_that_are_not_there_are_named(small_dataset):
    with pytest.raises(
        FieldError, match=r"^dataset\.episodes=\[0, 6\]: there is no episode 6 in .*episodes 0 to 5"
    ):
        read_episodes(small_dataset).among([0, 6])


def test_a_second_tokenizer_is_refused(small_dataset, trained_models, tmp_path):
    """A run goes on with the codes it began with, and a trained model keeps those it has learnt."""
    root, tokenizer = Path(small_dataset.root), trained_models["frame_tokenizer"]
    other = train_tokenizer(root, tmp_path / "other", steps=1, seed=1)
    run = run_training(action_config(tokenizer), root, tmp_path / "run", steps=2)
    with pytest.raises(ValueError, match=r"was begun with other settings \(model"):
        run_training(action_config(other), root, run, steps=3)
    trained = str(run / "checkpoints" / "last" / "pretrained_model")
    with pytest.raises(FieldError, match=r"^tokenizer_path=.*other: the world model at .* carries the tok"):
        run_training(action_config(other, pretrained_path=trained), root, tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_a_trained_model_does_not_go_on_with_actions_of_another_width(
    small_dataset, trained_models, tmp_path
):
    root = Path(small_dataset.root)
    trained = trained_models["action_world_model"] / "checkpoints" / "last" / "pretrained_model"
    config = load_model(trained, "action_world_model").config
    config.pretrained_path, config.action_size = str(trained), 5
    with pytest.raises(
        FieldError,
        match=r"^dataset\.root=.*: action: the world model was trained with 5 components, .* has 7",
    ):
        run_training(config, root, tmp_path / "run")


def test_batches_that_do_not_fit_are_named(trained_models):
    tokenizer = load_model(trained_models["frame_tokenizer"], "frame_tokenizer")
    key, state, action = "observation.images.third_view", torch.zeros(1, 3, 8), torch.zeros(1, 3, 7)
    with pytest.raises(
        ValueError, match=r"third_view: frames of shape \(48, 48, 3\); give them as \(3, H, W\)"
    ):
        tokenizer({key: torch.zeros(2, 48, 48, 3)})
    model, images = (
        load_model(trained_models["action_world_model"], "action_world_model"),
        torch.zeros(1, 3, 3, 32, 32),
    )
    batch = {key: images, "observation.state": state, "action": action}
    with pytest.raises(ValueError, match=r"action: shape \(1, 7\), but the batch has windows of 3 frames"):
        model({**batch, "action": action[:, 0]})
    with pytest.raises(ValueError, match="action: 5 components, but the world model was trained with 7"):
        model({**batch, "action": action[..., :5]})
    with pytest.raises(ValueError, match=r"observation\.state: holds NaN or infinity"):
        model({**batch, "observation.state": state / 0})


def test_another_precision_is_named(small_dataset, tmp_path):
    with pytest.raises(FieldError, match=r"^precision=half: choose one of auto, float32, bfloat16"):
        run_training(tokenizer_config(), Path(small_dataset.root), tmp_path / "run", precision="half")

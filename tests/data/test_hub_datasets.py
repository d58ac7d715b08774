"""A dataset that is named by its name on the hub alone."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.datasets import dataset_metadata, feature_utils, lerobot_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.data import dataset as own_datasets
from lerobot_wmrl.data import frame_cache
from lerobot_wmrl.data.dataset import ChosenEpisodes, DatasetSource, TrainingData, open_dataset
from lerobot_wmrl.data.decoding import decode, rows_of
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames
from lerobot_wmrl.evaluation.evidence import learnt_digests
from lerobot_wmrl.improve.configuration_improve import ImproveConfig
from lerobot_wmrl.improve.plan import Plan
from lerobot_wmrl.scripts.train_world_model import TrainWorldModelConfig, train_world_model
from tests.hub_server import Hub
from tests.rl.checkpoints import save_untrained_policy
from tests.trained import tokenizer_config

NAME = "somebody/episodes"


@pytest.fixture
def empty_cache(hub: Hub, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An empty cache of LeRobot's, and a hub."""
    for module in (dataset_metadata, lerobot_dataset, frame_cache, own_datasets):
        for name in ("HF_LEROBOT_HOME", "HF_LEROBOT_HUB_CACHE"):
            if hasattr(module, name):
                monkeypatch.setattr(module, name, tmp_path / "home" / ("hub" if "HUB" in name else ""))


@pytest.fixture
def published(empty_cache: None, small_dataset: LeRobotDataset) -> LeRobotDataset:
    """The small dataset on the hub."""
    LeRobotDataset(NAME, root=small_dataset.root).push_to_hub()
    return small_dataset


@pytest.fixture
def in_many_files(
    empty_cache: None,
    make_synthetic_dataset: Callable[..., LeRobotDataset],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> LeRobotDataset:
    """Four episodes on the hub, each in a video and a table of its own, as those of a large dataset are."""
    monkeypatch.setattr(feature_utils, "DEFAULT_VIDEO_FILE_SIZE_IN_MB", 1e-6)
    monkeypatch.setattr(feature_utils, "DEFAULT_DATA_FILE_SIZE_IN_MB", 1e-6)
    root = make_synthetic_dataset(tmp_path / "own", 4).root
    (own := LeRobotDataset(NAME, root=root)).push_to_hub()
    assert [len(list(Path(root).glob(f"{folder}/**/file-*"))) for folder in ("data", "videos")] == [4, 4]
    return own


def test_it_is_downloaded_once(published: LeRobotDataset, hub: Hub) -> None:
    source = DatasetSource(repo_id=NAME)
    assert (source.given, source.name, source.flags()) == (True, NAME, {"dataset.repo_id": NAME})
    first, second = source.open(), source.open()
    assert Path(first.root) == Path(second.root) != Path(published.root)
    table, own = read_episodes(first), read_episodes(published)
    assert (table.action == own.action).all()
    assert table.success.tolist() == own.success.tolist()


def test_it_is_downloaded_to_a_new_folder(published: LeRobotDataset, hub: Hub, tmp_path: Path) -> None:
    source = DatasetSource(str(tmp_path / "mine"), NAME, "main")
    assert read_episodes(source.open()).action.shape == read_episodes(published).action.shape
    assert (tmp_path / "mine" / "meta" / "info.json").is_file()
    hub.requests.clear()
    source.open()
    assert not hub.requests, "it is there"
    next((tmp_path / "mine" / "data").rglob("*.parquet")).unlink()  # as a download that was stopped leaves it
    next((tmp_path / "mine" / "meta" / "episodes").rglob("*.parquet")).unlink()
    assert read_episodes(source.open()).action.shape == read_episodes(published).action.shape


def test_a_folder_that_lacks_files_and_is_on_no_hub_says_what_it_lacks(
    published: LeRobotDataset, tmp_path: Path
) -> None:
    shutil.copytree(published.root, tmp_path / "torn")
    next((tmp_path / "torn" / "data").rglob("*.parquet")).unlink()
    with pytest.raises(ValueError, match=r"1 files are missing, the first is data/"):
        DatasetSource(str(tmp_path / "torn"), "somebody/nothing").open()


def test_what_was_recorded_here_under_the_name_goes_before_the_hub(
    published: LeRobotDataset, hub: Hub, caplog: pytest.LogCaptureFixture
) -> None:
    """As LeRobot has it; that it is of no revision is said."""
    own = own_datasets.HF_LEROBOT_HOME / NAME
    shutil.copytree(published.root, own)
    assert Path(DatasetSource(repo_id=NAME, revision="0123").open().root) == own
    assert f"dataset.revision=0123: {own} holds a whole dataset" in caplog.text
    shutil.rmtree(own / "meta" / "episodes")
    with pytest.raises(FieldError, match="its recording was not finished"):
        DatasetSource(repo_id=NAME).open()


def test_what_was_downloaded_stays_what_is_learnt_from(published: LeRobotDataset, hub: Hub) -> None:
    """Also where the name on the hub has moved on."""
    source = ChosenEpisodes(repo_id=NAME, episodes=[0, 1])
    root = Path(source.open().root)
    pinned = source.pinned(root)
    assert pinned.flags() == {
        "dataset.repo_id": NAME,
        "dataset.revision": root.name,
        "dataset.episodes": [0, 1],
    }
    assert Path(pinned.open().root) == root
    on_disk = ChosenEpisodes(root=str(published.root))
    assert on_disk.pinned(Path(published.root)) == on_disk


def test_all_stages_of_an_improvement_learn_from_what_was_downloaded_first(
    published: LeRobotDataset, hub: Hub, tmp_path: Path
) -> None:
    policy = save_untrained_policy(tmp_path / "policy", actions=7)
    config = ImproveConfig(
        policy=read_policy_config(str(policy), []),
        dataset=ChosenEpisodes(repo_id=NAME),
        check=ChosenEpisodes(repo_id=NAME),
        output_dir=tmp_path / "improve",
    )
    plan, commit = Plan.of(config), Path(config.dataset.open().root).name
    for source in (plan.data, plan.config.check):
        assert source.flags() == {"dataset.repo_id": NAME, "dataset.revision": commit}
    assert config.dataset.revision is None, "so that the same command is recognised"


@pytest.mark.parametrize("folder", ["", "mine"])
def test_of_chosen_episodes_alone_videos_are_downloaded(
    folder: str, in_many_files: LeRobotDataset, hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = str(tmp_path / folder) if folder else ""
    for wrong, message in (
        ([1, 9], "there is no episode 9 in"),
        ([9], "there is no"),
        ([], "chooses no episode"),
    ):
        with pytest.raises(ValueError, match=rf"^dataset\.episodes={re.escape(str(wrong))}: {message}"):
            ChosenEpisodes(root, NAME, episodes=wrong).open()
    source = ChosenEpisodes(root, NAME, episodes=[1, 3, 3])
    dataset = source.open()
    videos = sorted(path.name for path in Path(dataset.root).glob("videos/**/*.mp4"))
    assert videos == ["file-001.mp4", "file-003.mp4"]
    key, own = "observation.images.third_view", read_episodes(in_many_files)
    table = read_episodes(dataset)
    assert (table.action == own.action).all(), "which episodes are held out is decided among all of them"
    for episode in (1, 3):
        rows = rows_of(dataset, episode)
        frames = decode(dataset, episode, key, rows)
        assert (frames == decode(in_many_files, episode, key, rows)).all()
    caches = [cached_frames(dataset, [key], 32)]
    assert caches[0][rows_of(dataset, 1)].any()
    monkeypatch.setattr(frame_cache, "decode", None)
    caches.append(cached_frames(ChosenEpisodes(root, NAME, episodes=[0]).open(), [key], 32))
    assert bool(folder) or (caches[1][rows_of(dataset, 1)] == caches[0][rows_of(dataset, 1)]).all()
    next(Path(dataset.root).glob("videos/**/file-000.mp4")).unlink()
    hub.requests.clear()
    assert len(open_dataset(dataset.root, episodes=[3])) == len(in_many_files)
    source.open()
    assert not [path for _, path in hub.requests if "resolve" in path], "they are there"
    assert len(learnt_digests(Path(dataset.root), [1, 3])) == 2, "a world model's rollouts are recognised"
    with pytest.raises(ValueError, match=r"2 files are missing, the first is videos/.*file-000\.mp4"):
        open_dataset(dataset.root)
    assert len(list(Path(DatasetSource(root, NAME).open().root).glob("videos/**/*.mp4"))) == 4


def test_a_tokenizer_trains_on_it(published: LeRobotDataset, tmp_path: Path) -> None:
    train_world_model(
        TrainWorldModelConfig(
            model=tokenizer_config(),
            dataset=TrainingData(repo_id=NAME),
            output_dir=tmp_path / "run",
            steps=1,
            batch_size=2,
        )
    )
    assert list((tmp_path / "home" / "frames").iterdir()), "the hub's cache holds nothing of ours"
    snapshots = next((tmp_path / "home" / "hub").glob("datasets--*/snapshots"))
    assert len(list(snapshots.iterdir())) == 1


def test_a_name_that_is_not_there_is_refused(published: LeRobotDataset) -> None:
    with pytest.raises(ValueError, match=r"dataset\.repo_id=somebody/other: cannot be downloaded"):
        DatasetSource(repo_id="somebody/other").open()
    with pytest.raises(ValueError, match=r"cannot be downloaded"):
        DatasetSource(repo_id=NAME, revision="v9").open()


def test_a_revision_is_one_on_the_hub_and_no_whole_folder_is_replaced_by_it(
    published: LeRobotDataset, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(ValueError, match=r"dataset\.revision=v9: .* give `dataset\.repo_id`"):
        DatasetSource(root=str(published.root), revision="v9").open()
    assert DatasetSource(str(published.root), NAME, "v9").open().root == published.root
    assert "holds a whole dataset, which is used as it is" in caplog.text


@pytest.mark.parametrize("version", ["v2.1", "v2.0"])
def test_an_older_format_is_refused_with_the_command_that_converts_it(
    version: str, published: LeRobotDataset, hub: Hub, tmp_path: Path
) -> None:
    """It is sound data: nobody is told to remove it."""
    old = tmp_path / "old"
    shutil.copytree(published.root, old)
    info = json.loads((old / "meta" / "info.json").read_text())
    (old / "meta" / "info.json").write_text(json.dumps({**info, "codebase_version": version}))
    with pytest.raises(
        ValueError, match=r"before LeRobotDataset v3.0; convert it .*: `python -m .*v21_to_v30 "
    ) as e:
        open_dataset(old)
    assert f"--repo-id=old --root={old} --push-to-hub=false" in str(e.value)
    repo = hub.dataset(NAME)
    repo.refs = {"main": repo.refs["main"], version: repo.refs["main"]}
    with pytest.raises(
        ValueError, match=rf"dataset\.repo_id={NAME}: is in a format before .*--root=data/episodes"
    ):
        DatasetSource(repo_id=NAME).open()

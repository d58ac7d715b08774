"""Rollouts in an environment of LeRobot's, recorded so that they can be merged with demonstrations."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.dataset_tools import remove_feature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import PushtEnv
from lerobot.utils.constants import DEFAULT_FEATURES, OBS_IMAGE

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.merging import merge_folders
from lerobot_dataset_maniskill.recorder import record
from lerobot_dataset_maniskill.rollouts import Rollouts
from lerobot_wmrl.common.command_line import GivenPath
from lerobot_wmrl.common.constants import START_SEED
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.images import to_pixels
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.common.seeds import EVALUATION_SEED, GATE_SEED
from lerobot_wmrl.data.dataset import DatasetSource, open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.features import matched, row_in
from lerobot_wmrl.data.ledger import Ledger, Limits
from lerobot_wmrl.envs.rollout_recorder import RolloutRecorder
from tests.pusht import record_pusht
from tests.rl.checkpoints import save_untrained_policy

STEPS = 6


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pusht") / "demonstrations"
    return record_pusht(root, "--num_episodes=1", f"--steps={STEPS}", "--noise", "2")


@pytest.fixture
def config(demonstrations: Path, tmp_path: Path) -> RecordConfig:
    """Three episodes in parts of two."""
    policy = save_untrained_policy(tmp_path / "policy", OBS_IMAGE, size=96, actions=2, constant=250.0)
    return RecordConfig(
        output_dir=tmp_path / "rollouts",
        env=PushtEnv(episode_length=STEPS),
        num_episodes=3,
        part_episodes=2,
        policy=read_policy_config(str(policy), []),
        like=DatasetSource(str(demonstrations)),
    )


def test_they_have_the_columns_of_the_demonstrations_and_can_be_merged(
    config: RecordConfig, demonstrations: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(config)
    assert "3 episodes, 18 frames" in capsys.readouterr().out
    table, given = (read_episodes(open_dataset(root)) for root in (config.root, demonstrations))
    assert table.dataset.features == given.dataset.features
    assert table.length.tolist() == [STEPS] * 3
    assert np.allclose(table.action, 250.0), "the environment says how large actions are"
    assert len({tuple(table.state[start]) for start in table.start}) == 3
    merge_folders([demonstrations, config.root], tmp_path / "merged", "local/merged")
    assert len(read_episodes(open_dataset(tmp_path / "merged")).length) == 4


def test_they_can_be_merged_with_a_dataset_that_is_described_in_other_words(
    config: RecordConfig, demonstrations: Path, tmp_path: Path
) -> None:
    """Of a robot that has a name, converted from an earlier version, which noted the frame rate twice."""
    older = tmp_path / "older"
    shutil.copytree(demonstrations, older)
    info = json.loads((older / "meta" / "info.json").read_text())
    info["robot_type"] = "pusher"
    for feature in info["features"].values():
        feature["fps"] = info["fps"]
    (older / "meta" / "info.json").write_text(json.dumps(info))
    config.like = DatasetSource(str(older))
    record(config)
    merge_folders([older, config.root], tmp_path / "merged", "local/merged")
    merged = read_episodes(open_dataset(tmp_path / "merged"))
    assert len(merged.length) == 4
    assert merged.dataset.meta.robot_type == "pusher"


@pytest.mark.parametrize(("codec", "key"), [("h264", "info"), ("libsvtav1", "video_info")])
def test_videos_are_encoded_as_those_of_the_dataset(
    config: RecordConfig, demonstrations: Path, tmp_path: Path, codec: str, key: str
) -> None:
    """An earlier version described them under another name."""
    given = open_dataset(demonstrations)
    own = {name: dict(each) for name, each in given.features.items() if name not in DEFAULT_FEATURES}
    own[OBS_IMAGE]["dtype"] = "video"
    videos = LeRobotDataset.create(
        "local/videos", given.fps, own, root=tmp_path / "videos", rgb_encoder=RGBEncoderConfig(vcodec=codec)
    )
    for row in range(2):
        frame = {name: value for name, value in given[row].items() if name in {*own, "task"}}
        frame |= {name: value.reshape(1) for name, value in frame.items() if name.startswith("next.")}
        videos.add_frame({**frame, OBS_IMAGE: to_pixels(frame[OBS_IMAGE])})
    videos.save_episode()
    videos.finalize()
    file = videos.root / "meta" / "info.json"
    info = json.loads(file.read_text())
    info["features"][OBS_IMAGE][key] = info["features"][OBS_IMAGE].pop("info")
    file.write_text(json.dumps(info))
    config.like = DatasetSource(str(videos.root))
    record(config)
    merge_folders([videos.root, config.root], tmp_path / "merged", "local/merged")
    assert len(read_episodes(open_dataset(tmp_path / "merged")).length) == 4


def test_numbers_are_recorded_in_the_types_of_the_dataset(
    config: RecordConfig, demonstrations: Path, tmp_path: Path
) -> None:
    """Actions in double precision, labels as whole numbers: LeRobot merges no datasets of other types."""
    given = open_dataset(demonstrations)
    own = {name: dict(each) for name, each in given.features.items() if name not in DEFAULT_FEATURES}
    own["action"]["dtype"], own["next.success"]["dtype"] = "float64", "int64"
    precise = LeRobotDataset.create("local/precise", given.fps, own, root=tmp_path / "precise")
    for row in range(2):
        frame = {name: value.numpy() for name, value in given[row].items() if name in own}
        frame |= {name: value.reshape(1) for name, value in frame.items() if name.startswith("next.")}
        frame[OBS_IMAGE] = np.moveaxis(frame[OBS_IMAGE], 0, -1)
        precise.add_frame(row_in(own, frame) | {"task": given[row]["task"]})
    precise.save_episode()
    precise.finalize()
    config.like = DatasetSource(str(precise.root))
    record(config)
    merge_folders([precise.root, config.root], tmp_path / "merged", "local/merged")
    merged = open_dataset(tmp_path / "merged")
    assert len(read_episodes(merged).length) == 4
    assert [merged.features[name]["dtype"] for name in ("action", "next.success")] == ["float64", "int64"]


def test_a_dataset_of_another_rate_is_refused(
    config: RecordConfig, demonstrations: Path, tmp_path: Path
) -> None:
    shutil.copytree(demonstrations, tmp_path / "faster")
    file = tmp_path / "faster" / "meta" / "info.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"fps": 20}))
    config.like = DatasetSource(str(tmp_path / "faster"))
    with pytest.raises(ValueError, match="has 20 frames a second, the environment 10"):
        record(config)


@pytest.mark.parametrize(("limit", "frames"), [(4, 4), (STEPS + 1, STEPS)])
def test_an_episode_ends_at_the_lower_limit(config: RecordConfig, limit: int, frames: int) -> None:
    config.max_frames = limit
    record(config)
    assert read_episodes(open_dataset(config.root)).length.tolist() == [frames] * 3


def test_where_next_done_is_taken_for_success_it_says_success(
    config: RecordConfig, demonstrations: Path, tmp_path: Path
) -> None:
    """A dataset without next.success: its next.done must not call failures successes."""
    bare = tmp_path / "bare"
    remove_feature(open_dataset(demonstrations), "next.success", output_dir=bare)
    config.like = DatasetSource(str(bare))
    record(config)
    table = read_episodes(open_dataset(config.root))
    assert "next.success" not in table.dataset.features
    assert not table.success.any(), "none of these episodes succeeds"


def test_names_and_range_can_be_taken_without_the_columns(config: RecordConfig, tmp_path: Path) -> None:
    config.like_columns = False
    record(config)
    features = open_dataset(config.root).features
    given = config.like.open().features
    assert features["action"]["names"] == given["action"]["names"]
    assert START_SEED in features
    assert START_SEED not in given


def test_tasks_take_turns_across_the_parts_of_a_recording() -> None:
    """An environment of several tasks, as stand-ins that note what is asked of them."""
    recorder = RolloutRecorder.__new__(RolloutRecorder)
    recorder.envs = [SimpleNamespace(num_envs=1, name=name) for name in "abc"]
    asked: list[str] = []

    def noted(env: Any, seeds: Sequence[int]) -> None:
        asked.append(env.name)
        raise StopIteration

    recorder._roll_out = noted  # type: ignore[method-assign, assignment]
    for seed in range(5):  # parts of one episode each
        with pytest.raises(StopIteration):
            recorder.record(Path("nowhere"), [seed], lambda success: None)
    assert asked == ["a", "b", "c", "a", "b"]


def test_tasks_share_out_fewer_episodes_than_environments() -> None:
    """Else some would never be visited, and a gate over them passed unseen."""
    recorder = RolloutRecorder.__new__(RolloutRecorder)
    recorder.envs = [SimpleNamespace(num_envs=2, name=name) for name in "abc"]
    batches = [(env.name, list(seeds)) for env, seeds in recorder._batches(range(7, 15))]
    assert batches == [("a", [9, 12]), ("b", [7, 10]), ("b", [13]), ("c", [8, 11]), ("c", [14])]
    recorder.envs = [SimpleNamespace(num_envs=8, name=name) for name in "abc"]
    assert [env.name for env, _ in recorder._batches(range(7, 10))] == ["a", "b", "c"]


def test_an_interrupted_recording_continues_and_a_whole_one_is_left_alone(
    config: RecordConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record_part, parts = RolloutRecorder.record, []

    def interrupted(self: RolloutRecorder, folder: Path, *args: Any) -> None:
        if len(parts) == 1:
            raise KeyboardInterrupt
        parts.append(folder.name)
        record_part(self, folder, *args)

    monkeypatch.setattr(RolloutRecorder, "record", interrupted)
    with pytest.raises(KeyboardInterrupt):
        record(config)
    assert not config.root.exists()
    parts.clear()
    record(config)
    assert parts == ["part-00001"]
    record(config)
    assert "already recorded: 3 episodes" in capsys.readouterr().out
    config.exploration = 0.5
    with pytest.raises(ValueError, match=r"other settings \(exploration 0\.0 → 0\.5\)"):
        record(config)
    config.exploration, config.like = 0.0, DatasetSource()
    with pytest.raises(ValueError, match=r"other settings \(like\.root .* → "):
        record(config)


def test_where_resets_choose_the_start_none_comes_twice(
    config: RecordConfig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Here the first of two parts is recorded already."""
    monkeypatch.setattr("lerobot_wmrl.envs.rollout_recorder.counts_resets", lambda _: True)
    reset, seeds = SyncVectorEnv.reset, []

    def noted(self: SyncVectorEnv, *, seed: Any = None, options: Any = None) -> Any:
        seeds.append(seed)
        return reset(self, seed=seed, options=options)

    source = Rollouts(config, {})
    monkeypatch.setattr(SyncVectorEnv, "reset", noted)
    source.record(tmp_path, ["part-00001"])
    begun = [each[0] if isinstance(each, list) else each for each in seeds]
    assert begun[-3:] == [None, None, 2], "the starts of two episodes are passed over"


def test_a_recording_goes_on_with_the_policy_that_it_was_begun_with_alone(
    config: RecordConfig,
) -> None:
    """Neither with other settings of it, nor with what a longer training has made of it."""
    record(config)
    assert config.policy is not None
    config.given["policy"] = GivenPath(str(config.policy.pretrained_path), ["--optimizer_lr=1"])
    with pytest.raises(ValueError, match=r"\(policy_settings \[\] → \['--optimizer_lr=1'\]\)"):
        record(config)
    del config.given
    config.policy.pretrained_path = save_untrained_policy(
        config.root.with_name("longer"), OBS_IMAGE, size=96, actions=2, constant=250.0
    )
    with pytest.raises(ValueError, match=r"other settings \(.*policy '.*policy' → '.*longer'"):
        record(config)


def test_rollouts_are_charged_as_such_although_their_columns_do_not_say_it(
    config: RecordConfig, tmp_path: Path
) -> None:
    ledger = Ledger.create(tmp_path / "budget.json", Limits(rollouts=3))
    config.budget, config.exploration = ledger.path, 0.5
    record(config)
    assert "start.kind" not in open_dataset(config.root).features
    assert ledger.read().spent()["rollouts"] == 3


def test_under_a_budget_no_seed_of_evaluation_selection_or_gate_is_recorded(
    config: RecordConfig, tmp_path: Path
) -> None:
    config.budget = Ledger.create(tmp_path / "budget.json", Limits(rollouts=9)).path
    for seed in (EVALUATION_SEED, GATE_SEED):
        config.seed = seed
        with pytest.raises(ValueError, match=rf"seed={seed}: under a budget"):
            record(config)


def test_a_part_that_a_killed_call_left_damaged_is_recorded_again(
    config: RecordConfig, caplog: pytest.LogCaptureFixture
) -> None:
    work = config.root.with_name(f".{config.root.name}.recording")
    for name in ("part-00000", ".part-00001.partial"):
        (work / name / "meta").mkdir(parents=True)
    write_json(work / "recording.json", config.recorded_content())
    record(config)
    assert "part-00000 is recorded again: corrupted" in caplog.text
    assert not work.exists()
    assert open_dataset(config.root).num_episodes == 3


def test_without_demonstrations_the_environment_says_what_the_actions_are(
    config: RecordConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    far = save_untrained_policy(tmp_path / "far", OBS_IMAGE, size=96, actions=2, constant=600.0)
    config.policy = read_policy_config(str(far), [])
    config.like, config.video = DatasetSource(), False
    record(config)
    assert "the range is that of the action space of pusht; if the environment takes more" in caplog.text
    features = open_dataset(config.root).features
    assert features["action"]["info"] == {"low": [0.0, 0.0], "high": [512.0, 512.0]}
    assert features[OBS_IMAGE]["dtype"] == "image"


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("policy", None, "env.type=pusht: needs a policy"),
        ("depth", True, "depth=True: can be chosen in ManiSkill alone"),
        ("shard", "0/2", "shard=0/2: divides recordings in ManiSkill alone"),
        ("max_frames", 0, "max_frames=0: must be at least 1"),
        ("like", DatasetSource("nowhere"), r"^like\.root=nowhere: no LeRobotDataset there"),
    ],
)
def test_bad_settings_are_named_and_nothing_is_left(
    setting: str, value: object, message: str, config: RecordConfig
) -> None:
    setattr(config, setting, value)
    with pytest.raises(ValueError, match=message):
        record(config)
    assert not list(config.root.parent.glob("*rollouts*"))


def test_columns_that_a_rollout_lacks_are_named(
    config: RecordConfig, make_synthetic_dataset, tmp_path
) -> None:
    """And so is a dataset of another robot."""
    panda = make_synthetic_dataset(tmp_path / "panda", episodes=1)
    config.like = DatasetSource(str(panda.root))
    with pytest.raises(ValueError, match="its actions have 7 components, the environment's 2"):
        record(config)
    with pytest.raises(ValueError, match=r"third_view: the dataset has it as images of .* has none"):
        matched({"action": {"dtype": "float32", "shape": (7,)}}, panda.meta.features)
    whole = {"action": {"dtype": "int64", "shape": (2,)}}
    with pytest.raises(ValueError, match=r"action: the dataset has it as int64 .*, a rollout has float32"):
        matched({"action": {"dtype": "float32", "shape": (2,)}}, whole)

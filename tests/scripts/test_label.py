"""lerobot-wmrl-label: the copy has `next.success` as the rule says, everything else as it was."""

import re
import shutil
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.dataset_tools import add_features, remove_feature
from lerobot.datasets.io_utils import load_info, write_info
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.rewards.factory import make_reward_pre_post_processors
from lerobot.rewards.sarm.configuration_sarm import SARMConfig

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.dataset import fingerprint, open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.rewards.configuration_rewards import ProxyConfig
from lerobot_wmrl.rewards.modeling_rewards import ProxyRewardModel
from lerobot_wmrl.rewards.success_rules import longest_run
from lerobot_wmrl.scripts.label import main

IMAGE = "observation.images.third_view"


@pytest.fixture(scope="module")
def unlabelled(small_dataset: LeRobotDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The six synthetic episodes, of which every third fails, without what says so."""
    root = tmp_path_factory.mktemp("label") / "unlabelled"
    remove_feature(small_dataset, ["next.success", "next.done"], output_dir=root, repo_id="local/unlabelled")
    return root


def label(monkeypatch: pytest.MonkeyPatch, root: Path, target: Path, *flags: str) -> list[list[bool]]:
    """Run the command; return the labels of each episode of the copy."""
    monkeypatch.setattr("sys.argv", ["label", f"--dataset.root={root}", f"--output_dir={target}", *flags])
    main()
    table = read_episodes(open_dataset(target))
    return [table.done[a : a + n].tolist() for a, n in zip(table.start, table.length, strict=True)]


def lengths(root: Path) -> list[int]:
    return [int(n) for n in read_episodes(open_dataset(root)).length]


def test_demonstrations_succeed_at_their_ends(
    unlabelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The last three frames are solved, so the last four rows succeed: the first of them leads to these
    frames, and what the last leads to is not recorded."""
    found = label(monkeypatch, unlabelled, tmp_path / "labelled", "--success.type=ends")
    assert found == [[False] * (n - 4) + [True] * 4 for n in lengths(unlabelled)]
    said = capsys.readouterr().out
    assert "6 episodes, of which 6 succeed and 0 fail" in said
    assert "There is no failure" in said
    assert "Every episode was taken for a success" in said
    before, after = LeRobotDataset("a", unlabelled), LeRobotDataset("b", tmp_path / "labelled")
    assert {*after.features} == {*before.features, "next.success"}
    for row in (0, len(before) - 1):
        np.testing.assert_array_equal(before[row][IMAGE], after[row][IMAGE])
        np.testing.assert_array_equal(before[row]["action"], after[row]["action"])


def test_copies_have_the_notes_of_today(
    unlabelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot merges no datasets of which one has those of an earlier version."""
    earlier = shutil.copytree(unlabelled, tmp_path / "earlier")
    info = load_info(earlier)
    notes = info.features[IMAGE]["info"]
    notes["video.is_depth_map"] = notes.pop("is_depth_map")
    write_info(info, earlier)
    for name, root in (("now", unlabelled), ("then", earlier)):
        label(monkeypatch, root, tmp_path / name, "--success.type=ends")
    now, then = (load_info(tmp_path / name).features for name in ("now", "then"))
    assert now == then


def test_other_labels_are_other_data(
    unlabelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot keeps no statistics of the column: `meta` is the same."""
    found = []
    for name, episodes in {"some": "[0,1]", "others": "[2,3]", "again": "[0,1]"}.items():
        label(
            monkeypatch,
            unlabelled,
            tmp_path / name / "labelled",
            "--success.type=ends",
            f"--success.episodes={episodes}",
        )
        found.append(fingerprint(tmp_path / name / "labelled"))
    assert found[0] == found[2] != found[1]


def test_numbers_in_the_place_of_labels_are_named_and_become_labels(
    small_dataset: LeRobotDataset, unlabelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = np.linspace(0, 1, small_dataset.num_frames, dtype=np.float32)[:, None]
    column = {"next.success": (numbers, {"dtype": "float32", "shape": (1,), "names": None})}
    add_features(open_dataset(unlabelled), column, output_dir=tmp_path / "numbers", repo_id="local/numbers")
    where, remedy = (
        r"next\.success of episode 0, frame 1, is 0\.\d+",
        r"--success\.type=column --success\.column=",
    )
    with pytest.raises(FieldError, match=rf"{where}, neither .*{remedy}next\.success"):
        read_episodes(open_dataset(tmp_path / "numbers"))
    flags = ["--success.type=column", "--success.column=next.success", "--success.threshold=0.5"]
    found = label(monkeypatch, tmp_path / "numbers", tmp_path / "labelled", *flags)
    assert [*chain(*found)] == (numbers[:, 0] >= 0.5).tolist()
    assert {path.name for path in tmp_path.iterdir()} == {"numbers", "labelled"}


def test_the_others_fail_where_successes_are_named(
    unlabelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--success.episodes=[0,4]", "--success.last=1"]
    found = label(monkeypatch, unlabelled, tmp_path / "labelled", "--success.type=ends", *flags)
    assert [sum(episode) for episode in found] == [2, 0, 0, 0, 2, 0]
    said = capsys.readouterr().out
    assert "2 of them for fewer than 3: these count with --env.done_frames=2" in said
    assert "There is no failure" not in said
    assert "Every episode was taken" not in said


@pytest.mark.parametrize(
    "flags",
    [
        ["--success.type=ends", "--success.episodes=[]"],
        ["--success.type=first_frames", "--success.first={}"],
    ],
)
def test_all_may_fail_where_that_is_said(
    flags: list[str],
    unlabelled: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = label(monkeypatch, unlabelled, tmp_path / "labelled", *flags)
    assert not any(chain(*found))
    assert "There is no success" in capsys.readouterr().out


def test_success_may_begin_at_a_frame(
    unlabelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A row says what its action leads to, so it succeeds where the next frame is solved."""
    flags = ["--success.type=first_frames", "--success.first={0: 5, 3: 2}"]
    found = label(monkeypatch, unlabelled, tmp_path / "labelled", *flags)
    expected = [
        [frame + 1 >= {0: 5, 3: 2}.get(e, n + 1) for frame in range(n)]
        for e, n in enumerate(lengths(unlabelled))
    ]
    assert found == expected


def test_a_reward_may_say_it(
    small_dataset: LeRobotDataset, unlabelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The synthetic reward is 1 where the task is solved."""
    flags = ["--success.type=column", "--success.column=next.reward", "--success.threshold=1"]
    found = label(monkeypatch, unlabelled, tmp_path / "labelled", *flags)
    assert [*chain(*found)] == read_episodes(small_dataset).done.tolist()


def test_frames_in_a_row_are_what_counts() -> None:
    assert [longest_run(np.array(frames, bool)) for frames in ([1, 0, 1, 0, 1], [0, 1, 1, 0, 1], [0, 0])] == [
        1,
        2,
        0,
    ]


def test_a_reward_model_of_whole_episodes_is_refused(
    unlabelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    SARMConfig(device="cpu").save_pretrained(tmp_path / "reward")
    with pytest.raises(SystemExit):
        label(
            monkeypatch,
            unlabelled,
            tmp_path / "labelled",
            "--success.type=reward_model",
            f"--success.path={tmp_path / 'reward'}",
        )
    assert "a reward model of type sarm does not judge frames one by one" in capsys.readouterr().err


def test_a_reward_model_may_say_it(unlabelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An untrained network stands for a trained one: it is asked about the frame after every action."""
    config = ProxyConfig(device="cpu", cameras=["third_view"], image_size=32)
    model = ProxyRewardModel(config)
    model.save_pretrained(tmp_path / "reward")
    dataset = open_dataset(unlabelled)
    prepare = make_reward_pre_post_processors(config, dataset_stats=dataset.meta.stats)[0]
    prepare.save_pretrained(tmp_path / "reward")
    table = read_episodes(dataset)
    ends = np.repeat(table.start + table.length - 1, table.length)
    after = np.minimum(np.arange(len(ends)) + 1, ends)  # of these frames its training makes the reward
    rewards = [float(model.compute_reward(prepare({IMAGE: dataset[row][IMAGE][None]}))) for row in after]
    ordered = np.sort(rewards)
    widest = int(np.argmax(np.diff(ordered)))
    threshold = float(ordered[widest : widest + 2].mean())
    flags = ["--success.type=reward_model", f"--success.path={tmp_path / 'reward'}", "--success.device=cpu"]
    found = label(monkeypatch, unlabelled, tmp_path / "labelled", *flags, f"--success.threshold={threshold}")
    assert [*chain(*found)] == pytest.approx([reward >= threshold for reward in rewards])
    assert 0 < np.sum([*chain(*found)]) < len(dataset)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--success.type=ends", "--success.episodes=[6]"], "no episode 6 in .*; it has episodes 0 to 5"),
        (["--success.type=ends", "--success.last=0"], "--success.last=0: must be at least 1"),
        (["--success.type=first_frames"], "--success.first: names no episode that succeeds"),
        (["--success.type=first_frames", "--success.first={1:3}"], "write a space after each colon"),
        (["--success.type=first_frames", "--success.first={1:45}"], "write a space after each colon"),
        (["--success.type=first_frames", "--success.first={0: 5.5}"], "0: 5.5 is not .*give whole numbers"),
        (["--success.type=first_frames", "--success.first={a: 5}"], "a: 5.0 is not .*give whole numbers"),
        (
            ["--success.type=first_frames", "--success.first={1: 99}"],
            "episode 1 has no frame 99; its frames are",
        ),
        (["--success.type=column", "--success.column=score"], "no column of one number .*next.reward"),
        (
            ["--success.type=column", "--success.threshold=7"],
            "--success.threshold=7.0: no frame reaches it.*every episode fails: --success.type=ends",
        ),
        (["--success.type=reward_model"], "--success.path.*: no reward model of LeRobot there"),
    ],
)
def test_mistakes_are_named_and_nothing_is_written(
    flags: list[str],
    message: str,
    unlabelled: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        label(monkeypatch, unlabelled, tmp_path / "labelled", *flags)
    assert list(tmp_path.iterdir()) == []
    assert re.search(message, capsys.readouterr().err)


def test_labels_are_not_replaced(
    small_dataset: LeRobotDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        label(monkeypatch, Path(small_dataset.root), tmp_path / "labelled")
    assert "has a column next.success already; train with it, or remove it first" in capsys.readouterr().err


def test_a_copy_that_was_cut_off_is_made_again(
    unlabelled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    torn = tmp_path / ".labelled.partial"
    torn.mkdir()
    (torn / "half").write_text("")
    label(monkeypatch, unlabelled, tmp_path / "labelled")
    assert not torn.exists()
    assert not (tmp_path / "labelled" / "half").exists()
    with pytest.raises(SystemExit):
        label(monkeypatch, unlabelled, tmp_path / "labelled")
    assert "labelled: there is something already; choose a new folder" in capsys.readouterr().err

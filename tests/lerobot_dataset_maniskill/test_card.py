"""The card says what the files hold, and its pictures show an episode from start to success."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from huggingface_hub import DatasetCard
from PIL import Image

from lerobot_dataset_maniskill.card import (
    FRAMES,
    KIND_MEANINGS,
    WIDTH,
    chosen_examples,
    name_card,
    scene_rows,
)
from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_wmrl.common.constants import KINDS, START_KIND, START_SCENE, START_TASK
from lerobot_wmrl.common.frame_strips import GAP
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.maniskill.scenes import SCENES
from tests.lerobot_dataset_maniskill.made_up import BRIGHTER, NOISE, SUCCESS_ROW, record_made_up

SIZE = 32


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight episodes of two tasks in two scenes; six are optimal."""
    config = RecordConfig(
        output_dir=tmp_path_factory.mktemp("card") / "dataset",
        num_episodes=8,
        part_episodes=4,
        tasks=["push", "move_to_aim"],
        kinds={"optimal": 3.0, "near_miss": 1.0},
        env=WmrlManiSkillEnv(scenes=[2, 5], cameras=["third_view", "wrist"], image_size=SIZE),
    )
    record_made_up(config)
    return config.root


def table_rows(root: Path, head: str) -> list[list[str]]:
    """Cells of the card's table whose first column is called `head`."""
    lines = (root / "README.md").read_text().splitlines()
    first = next(index for index, line in enumerate(lines) if line.startswith(f"| {head} |"))
    body = lines[first + 2 :]
    end = next(index for index, line in enumerate(body) if not line.startswith("|"))
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in body[:end]]


def test_the_front_matter_is_what_the_hub_reads(root: Path) -> None:
    data = DatasetCard.load(root / "README.md").data
    assert data.license == "apache-2.0"
    assert "LeRobot" in data.tags
    assert data.task_categories == ["robotics"]
    assert data.configs == [{"config_name": "default", "data_files": "data/*/*.parquet"}]


def test_success_is_counted_by_task_and_kind(root: Path) -> None:
    rows = table_rows(root, "task")
    counts = {(task, kind): (int(total), int(wins)) for task, kind, total, wins, _ in rows}
    assert {task for task, _ in counts} == {"push", "move_to_aim"}
    assert sum(total for total, _ in counts.values()) == 8
    assert sum(total for (_, kind), (total, _) in counts.items() if kind == "optimal") == 6
    for (_, kind), (total, wins) in counts.items():
        assert wins == (total if kind == "optimal" else 0)
    assert all(rate.startswith(("100% (", "0% (0%–")) for *_, rate in rows)


def test_only_recorded_scenes_are_listed(root: Path) -> None:
    rows = table_rows(root, "scene")
    scene = SCENES[5]
    assert [row[0] for row in rows] == ["2", "5"]
    assert rows[1] == ["5", scene.object, scene.container, scene.table, scene.split, "4"]


def test_scenes_are_counted_by_episode() -> None:
    table = SimpleNamespace(columns={START_SCENE: np.array([3, 0, 3])})
    assert [row[0::5] for row in scene_rows(table, [vars(scene) for scene in SCENES])] == [(0, 1), (3, 2)]


def test_every_kind_is_explained() -> None:
    assert list(KIND_MEANINGS) == list(KINDS)


@pytest.mark.parametrize("task", ["push", "move_to_aim"])
def test_a_picture_runs_from_the_start_to_success(root: Path, task: str) -> None:
    assert f"![{task}](media/{task}.png)" in (root / "README.md").read_text()
    factor = WIDTH // SIZE
    picture = np.asarray(Image.open(root / "media" / f"{task}.png"))[::factor, ::factor].astype(float)
    assert picture.shape == (2 * SIZE, FRAMES * SIZE + (FRAMES - 1) * GAP, 3)
    frames = [picture[:, left : left + SIZE] for left in range(0, picture.shape[1], SIZE + GAP)]
    rows = np.linspace(0, SUCCESS_ROW + 1, FRAMES).round()  # success shows in the frame after its row
    expected = rows * BRIGHTER + (NOISE - 1) / 2
    assert np.allclose([frame[:SIZE, :, 0].mean() for frame in frames], expected, atol=4)
    assert np.allclose([frame[SIZE:, :, 1].mean() for frame in frames], expected, atol=4)
    assert max(frame[..., 2].mean() for frame in frames) < NOISE


def test_an_example_is_a_success_if_there_is_one_and_optimal_if_possible() -> None:
    near_miss, policy = KINDS.index("near_miss"), KINDS.index("policy")
    columns = {
        START_TASK: np.array([0, 0, 0, 0, 3, 3]),
        START_KIND: np.array([0, policy, 0, 0, near_miss, policy]),
    }
    table = SimpleNamespace(columns=columns, success=np.array([False, True, True, True, False, False]))
    shown = {example.task: (example.episode, example.success) for example in chosen_examples(table)}
    assert shown == {"push": (2, True), "move_to_aim": (4, False)}


def test_a_card_of_this_name_is_kept_another_is_written_again(root: Path) -> None:
    card = root / "README.md"
    recorded = card.read_text()
    card.write_text(recorded + "\nMeasured on a Tuesday.\n")
    name_card(root, "local/dataset")
    assert "Tuesday" in card.read_text()
    name_card(root, "somebody/pushes")
    assert card.read_text() == recorded.replace("local/dataset", "somebody/pushes")
    name_card(root, "local/dataset")
    assert card.read_text() == recorded

"""The whole loop at the size `tiny`: real commands, killed once on the way, and what they leave behind."""

import html
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.constants import START_SEED
from lerobot_wmrl.common.presets import preset_settings
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.demo.stages import Demo, DemoConfig
from lerobot_wmrl.improve.configuration_improve import ROLLOUT_SEED_OFFSET
from lerobot_wmrl.improve.progress import CLONED, DISTILLED, PPO, SFT

ROOT = Path(__file__).parents[2]
KILLED_STAGE = "improve/rollouts"
STAGES = [stage.name for stage in Demo(DemoConfig()).stages()]
IMPROVED = (
    "rollouts",
    "merged",
    "cloned",
    "tokenizer",
    "world_model",
    "check",
    "start",
    "rl",
    "distilled",
    "comparison",
)
PLACES = ("in known scenes", "in unseen scenes", "in imagination, from frames of the dataset")
HEADINGS = (
    "Success",
    "The data",
    "Can the world model be trusted?",
    "Recorded beside imagined",
    "Goal frames",
    "The reward along recorded episodes",
    "Drive it",
)
FOLDED = ("Training", "Time and memory", "The commands")


def start_demo(folder: Path) -> subprocess.Popen[str]:
    command = [Path(sys.executable).with_name("lerobot-wmrl-demo"), "--preset=tiny", "--output_dir=demo"]
    return subprocess.Popen(command, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def stage_record(demo: Path, name: str) -> dict[str, object]:
    """Return what is known of a stage, `improve/<name>` of those of the improvement."""
    *folder, name = name.split("/")
    path = Path(demo, *folder, "stages", f"{name}.json")
    return json.loads(path.read_text()) if path.exists() else {}


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The finished folder, and what the second of two calls printed: the first was killed in a stage."""
    folder = tmp_path_factory.mktemp("loop")
    first = start_demo(folder)
    end = time.monotonic() + 600
    while not stage_record(folder / "demo", KILLED_STAGE).get("seconds"):
        assert first.poll() is None, first.communicate()[0][-3000:]
        assert time.monotonic() < end, "the stage did not start in time"
        time.sleep(0.2)
    first.send_signal(signal.SIGKILL)
    first.communicate()
    printed, _ = (second := start_demo(folder)).communicate()
    assert second.returncode == 0, printed[-5000:]
    return folder / "demo", printed


def all_stages() -> list[str]:
    return [*STAGES, *(f"improve/{name}" for name in IMPROVED)]


def test_a_killed_run_continues_after_its_last_finished_stage(outputs: tuple[Path, str]) -> None:
    """Within the improvement too."""
    demo, printed = outputs
    number = STAGES.index("improve") + 1
    assert re.search(rf"^\[{number - 1}/{len(STAGES)}\] .*: done in \d+ s$", printed, re.MULTILINE)
    assert re.search(rf"^\[{number}/{len(STAGES)}\] [^:]*$", printed, re.MULTILINE)
    assert f"[1/{len(IMPROVED)}] Record rollouts of the policy\n" in printed
    assert all(stage_record(demo, name)["finished"] for name in all_stages())


def test_a_finished_run_does_nothing_again(outputs: tuple[Path, str]) -> None:
    demo, _ = outputs
    before = written(demo)
    printed, _ = start_demo(demo.parent).communicate()
    assert printed.count(": done in") == len(STAGES)
    assert "$ lerobot" not in printed
    assert written(demo) == before


def written(demo: Path) -> dict[Path, int]:
    """When each model and each part of the data was last written (ns)."""
    kept = (".safetensors", ".parquet")
    return {path: path.stat().st_mtime_ns for path in demo.rglob("*") if path.suffix in kept}


def test_the_dataset_reopens_and_holds_successes_and_failures(outputs: tuple[Path, str]) -> None:
    demo, _ = outputs
    root = demo / "improve" / "merged"
    dataset = LeRobotDataset("local/merged", root=root)
    frame = dataset[len(dataset) - 1]
    assert frame["observation.images.third_view"].shape[0] == 3
    assert frame["observation.state"].shape == (8,)
    assert frame["action"].shape == (7,)
    given = preset_settings("tiny", "demo")
    success = read_episodes(open_dataset(root)).success
    assert len(success) == dataset.num_episodes == given["demonstrations"] + given["rollouts"]
    assert 0 < success.sum() < len(success)


def test_no_held_out_seed_is_trained_on(outputs: tuple[Path, str]) -> None:
    demo, _ = outputs
    table = read_episodes(open_dataset(demo / "improve" / "merged"))
    assert table.columns[START_SEED].max() < EVALUATION_SEED
    for stage in ("improve/comparison", "unseen", "imagined"):
        assert f"--seed={EVALUATION_SEED} " in str(stage_record(demo, stage)["command"])


def test_all_policies_meet_the_same_starts_everywhere(outputs: tuple[Path, str]) -> None:
    demo, _ = outputs
    commands = [
        str(stage_record(demo, stage)["command"]).split()
        for stage in ("improve/comparison", "unseen", "imagined")
    ]
    (policies,) = {flag for command in commands for flag in command if "--policies" in flag}
    assert policies.count(",") == 3
    summary = json.loads((demo / "summary.json").read_text())
    n = preset_settings("tiny", "demo")["eval_episodes"]
    assert [*summary["places"]] == [*PLACES]
    for place in summary["places"].values():
        assert [*place["policies"]] == [SFT, CLONED, PPO, DISTILLED]
        assert {rate["n"] for rate in place["policies"].values()} == {n}
    assert summary["peak_memory_bytes"] < 8e9


def test_training_left_metrics_and_whole_checkpoints(outputs: tuple[Path, str]) -> None:
    demo, _ = outputs
    improved = ("tokenizer", "world_model", "rl", "distilled")
    models = ("text_world_model", *(f"improve/{name}" for name in improved))
    for folder in models:
        assert read_metrics(demo / folder), f"{folder} has no metrics"
    whole = {"config.json", "model.safetensors", "train_config.json"}
    for folder in (*models, "cloned", "improve/cloned"):
        checkpoint = demo / folder / "checkpoints" / "last" / "pretrained_model"
        assert whole <= {path.name for path in checkpoint.iterdir()}


def test_what_the_docs_say_of_the_demos_folders_is_there(outputs: tuple[Path, str]) -> None:
    demo, _ = outputs
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    named = {path for page in pages for path in re.findall(r"outputs/demo/([\w/.]+)", page.read_text())}
    assert "improve/world_model" in named
    assert not [path for path in named if not (demo / path).exists()]


def test_the_page_stands_alone_and_shows_every_part(outputs: tuple[Path, str]) -> None:
    demo, printed = outputs
    page = (demo / "report.html").read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", page), "the page needs other files"
    for place in PLACES:
        assert f"<th>{place}</th>" in page
    for heading in HEADINGS:
        assert f"<h2>{heading}</h2>" in page
    for heading in FOLDED:
        assert f"<summary>{heading}</summary>" in page
    assert page.count("data:image/") >= 12
    for name in all_stages():
        assert str(stage_record(demo, name)["command"]) in html.unescape(page)
    summary = json.loads((demo / "summary.json").read_text())
    seconds = [stage_record(demo, name)["seconds"] for name in STAGES]
    assert summary["seconds"] == pytest.approx(sum(seconds)), "those of the improvement are within its stage"
    assert "The report: demo/report.html" in printed


@pytest.mark.parametrize(
    "flags",
    [
        {"seed": -1},
        {"seed": 10},
        {"eval_episodes": 0},
        {"rollouts": 0},
        {"rollouts": 50_001},
        {"rollouts": 11, "demonstrations": 8},
    ],
)
def test_impossible_settings_are_named(flags: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(flags))}="):
        DemoConfig(**flags).validate()


def test_training_and_evaluation_seeds_are_disjoint(tmp_path: Path) -> None:
    """Whatever the demo's seed, at a distance that no stage's number of episodes bridges."""
    trained = set()
    for seed in range(10):
        for stage in Demo(DemoConfig(tmp_path, seed)).stages():
            if stage.name not in ("unseen", "imagined"):  # they need a dataset, and have the evaluation's
                seeds = [
                    int(flag.partition("=")[2]) for flag in stage.command() if flag.startswith("--seed=")
                ]
                trained.update(seeds)
    assert trained == {100_000 * seed for seed in range(10)}
    assert EVALUATION_SEED - max(trained) >= 2 * ROLLOUT_SEED_OFFSET

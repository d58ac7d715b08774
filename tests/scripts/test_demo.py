"""The whole loop at the size `tiny`: real commands, killed once on the way, and what they leave behind."""

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wmrl.common.constants import EVALUATION_SEED
from lerobot_wmrl.common.presets import preset_settings
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.demo.stages import MEASURED, DemoConfig, demo_stages
from lerobot_wmrl.maniskill.recordings import recorded_episodes

KILLED_STAGE = "rollouts"
STAGES = [stage.name for stage in demo_stages(DemoConfig())]
HEADINGS = (
    "Success on the same data",
    "Can the world model be trusted?",
    "Recorded beside imagined",
    "Goal frames",
    "The reward along recorded episodes",
    "Drive it",
)
FOLDED = ("Training", "The data", "Time and memory", "The commands")


def start_demo(folder: Path) -> subprocess.Popen[str]:
    command = [Path(sys.executable).with_name("lerobot-wmrl-demo"), "--preset=tiny", "--output_dir=demo"]
    return subprocess.Popen(command, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def stage_record(demo: Path, name: str) -> dict[str, object]:
    path = demo / "stages" / f"{name}.json"
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


def test_a_killed_run_continues_after_its_last_finished_stage(outputs: tuple[Path, str]) -> None:
    demo, printed = outputs
    number = STAGES.index(KILLED_STAGE) + 1
    assert re.search(rf"^\[{number - 1}/{len(STAGES)}\] .*: done in \d+ s$", printed, re.MULTILINE)
    assert re.search(rf"^\[{number}/{len(STAGES)}\] [^:]*$", printed, re.MULTILINE)
    assert all(stage_record(demo, name)["finished"] for name in STAGES)


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
    dataset = LeRobotDataset("local/demo", root=demo / "dataset")
    frame = dataset[len(dataset) - 1]
    assert frame["observation.images.third_view"].shape[0] == 3
    assert frame["observation.state"].shape == (8,)
    assert frame["action"].shape == (7,)
    success = recorded_episodes(demo / "dataset")["success"]
    assert len(success) == dataset.num_episodes
    assert 0 < success.sum() < len(success)


def test_no_held_out_seed_is_trained_on(outputs: tuple[Path, str]) -> None:
    demo, _ = outputs
    for dataset in ("demonstrations", "rollouts", "dataset"):
        assert recorded_episodes(demo / dataset)["seed"].max() < EVALUATION_SEED
    for policy in ("filtered", "distilled"):
        rollouts = recorded_episodes(demo / f"checked_{policy}")["seed"]
        evaluated = range(
            EVALUATION_SEED, EVALUATION_SEED + int(preset_settings("tiny", "demo")["eval_episodes"])
        )
        assert rollouts.min() >= EVALUATION_SEED
        assert not set(rollouts.tolist()) & set(evaluated)


@pytest.mark.parametrize("where", ["known", "unseen"])
def test_all_policies_meet_the_same_held_out_starts(outputs: tuple[Path, str], where: str) -> None:
    demo, _ = outputs
    commands = [
        {*str(stage_record(demo, f"eval_{where}_{policy}")["command"]).split()} for policy in MEASURED
    ]
    for other in commands[1:]:
        assert {flag.partition("=")[0] for flag in commands[0] ^ other} == {"--policy.path", "--output_dir"}


def test_everything_learns_from_the_demonstrations_and_the_rollouts(outputs: tuple[Path, str]) -> None:
    demo, _ = outputs
    given = preset_settings("tiny", "demo")
    table = recorded_episodes(demo / "dataset")
    assert len(table["episode"]) == given["demonstrations"] + given["rollouts"]
    for stage in ("filtered", "frame_tokenizer", "action_world_model", "text_world_model", "rl", "distilled"):
        assert "dataset.root=demo/dataset" in str(stage_record(demo, stage)["command"])


def test_the_summary_counts_what_was_evaluated(outputs: tuple[Path, str]) -> None:
    demo, _ = outputs
    summary = json.loads((demo / "summary.json").read_text())
    n = preset_settings("tiny", "demo")["eval_episodes"]
    for policy in MEASURED:
        assert {row["n"] for row in summary["policies"][policy].values()} == {n}
    for policy in ("filtered", "distilled"):
        replayed = summary["replayed"][policy]
        assert replayed["false_positive_rate"]["n"] + replayed["recall"]["n"] == len(
            recorded_episodes(demo / f"checked_{policy}")["episode"]
        )
    assert summary["peak_memory_bytes"] < 8e9


def test_training_left_metrics_and_whole_checkpoints(outputs: tuple[Path, str]) -> None:
    demo, _ = outputs
    for folder in ("frame_tokenizer", "action_world_model", "text_world_model", "rl", "distilled"):
        assert read_metrics(demo / folder), f"{folder} has no metrics"
    whole = {"config.json", "model.safetensors", "train_config.json"}
    for folder in ("frame_tokenizer", "action_world_model", "text_world_model", *MEASURED):
        checkpoint = demo / folder / "checkpoints" / "last" / "pretrained_model"
        assert whole <= {path.name for path in checkpoint.iterdir()}


def test_the_page_stands_alone_and_shows_every_part(outputs: tuple[Path, str]) -> None:
    demo, _ = outputs
    page = (demo / "report.html").read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", page), "the page needs other files"
    for heading in HEADINGS:
        assert f"<h2>{heading}</h2>" in page
    for heading in FOLDED:
        assert f"<summary>{heading}</summary>" in page
    assert page.count("data:image/") >= 12
    for name in STAGES:
        assert str(stage_record(demo, name)["title"]) in page

"""A policy's rollouts outside ManiSkill: in LeRobot's environments, and in world models of other robots.

They are recorded in parts, so that an interruption costs one part, and merged by LeRobot's own function.
"""

import json
import shutil
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from tqdm import tqdm

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.merging import merge_folders, require_same
from lerobot_dataset_maniskill.recorder import claimed
from lerobot_dataset_maniskill.writer import find_damage
from lerobot_wmrl.common.constants import EVALUATION_SEED, POLICY
from lerobot_wmrl.common.errors import FieldError, within
from lerobot_wmrl.common.files import write_json, writing
from lerobot_wmrl.common.policies import check_weights
from lerobot_wmrl.data.budget import Ledger, spending
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.features import describe_alike
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.envs.start_frames import check_starts
from lerobot_wmrl.rl.recorders import RolloutRecorder

SETTINGS_FILE: Final = Path("meta/rollouts.json")
"""The settings that decide the episodes."""


def record_elsewhere(config: RecordConfig) -> None:
    """Record everything that is missing, then merge; or report that the recording is complete."""
    config.validate()
    assert config.policy is not None
    root, content = config.root, config.recorded_content()
    imagined = isinstance(config.env, WorldModelEnv)
    ledger = None if config.budget is None else Ledger(config.budget)
    if ledger is not None:
        check_budget(config, ledger)
    if not already_recorded(root, content, config.num_episodes):
        if ledger is not None and not imagined:
            ledger.require_left({spending(POLICY): config.num_episodes})
        check_weights(config.policy)
        work = root.parent / f".{root.name}.recording"
        with writing("output_dir", root), claimed(work, content):
            record_parts(config, work)
            merge(config, work, content)
        shutil.rmtree(work, ignore_errors=True)
    if ledger is not None:
        ledger.charge(read_episodes(open_dataset(root)), imagined=imagined)


def check_budget(config: RecordConfig, ledger: Ledger) -> None:
    """Raise FieldError for episodes from which a method under a budget must not learn."""
    if isinstance(config.env, WorldModelEnv):
        with within("env"):
            check_starts(config.env.dataset, ledger)
    elif config.seed + config.num_episodes > EVALUATION_SEED:
        raise FieldError(
            "seed", config.seed, f"under a budget, seeds from {EVALUATION_SEED} on are for evaluation",
            "choose a smaller one",
        )  # fmt: skip


def already_recorded(root: Path, content: Mapping[str, Any], episodes: int) -> bool:
    """Whether `root` holds exactly this recording. FieldError if it holds anything else."""
    if not root.exists() or (root.is_dir() and not any(root.iterdir())):
        return False
    if not (root / SETTINGS_FILE).is_file():
        raise FieldError("output_dir", root, "holds something else", "choose a new folder")
    require_same(json.loads((root / SETTINGS_FILE).read_text()), content, root)
    if problem := find_damage(root, episodes):
        raise FieldError("output_dir", root, problem, "remove the folder and record again")
    print(f"{root} is already recorded: {episodes} episodes")
    return True


def part_seeds(config: RecordConfig) -> list[range]:
    """Return the seeds of the episodes, part by part."""
    last = config.seed + config.num_episodes
    firsts = range(config.seed, last, config.part_episodes)
    return [range(first, min(last, first + config.part_episodes)) for first in firsts]


def record_parts(config: RecordConfig, work: Path) -> None:
    """Record the parts that are not there, or not whole, with a progress bar."""
    parts = {work / f"part-{index:05d}": seeds for index, seeds in enumerate(part_seeds(config))}
    missing = {
        folder: seeds
        for folder, seeds in parts.items()
        if not folder.exists() or find_damage(folder, len(seeds))
    }
    if not missing:
        return
    with within("like"):
        like = config.like.open().meta if config.like.given else None
    episodes = min(config.part_episodes, config.num_episodes)
    assert config.policy is not None
    recorder = RolloutRecorder(
        config.env, config.policy, None, config.exploration, like,
        num_envs=episodes if isinstance(config.env, WorldModelEnv) else 1, video=config.video,
        like_columns=config.like_columns, max_frames=config.max_frames,
    )  # fmt: skip
    won: list[bool] = []
    done = config.num_episodes - sum(map(len, missing.values()))
    with (
        closing(recorder),
        tqdm(total=config.num_episodes, initial=done, desc="record", unit="episode") as bar,
    ):

        def report(success: bool) -> None:
            won.append(success)
            bar.set_postfix(success=f"{sum(won) / len(won):.0%}", refresh=False)
            bar.update()

        for folder, seeds in missing.items():
            shutil.rmtree(folder, ignore_errors=True)
            recorder.record(folder, seeds, report)


def merge(config: RecordConfig, work: Path, content: Mapping[str, Any]) -> None:
    """Merge the parts, move the whole into place at once, and say what there is."""
    merged = work / "merged"
    shutil.rmtree(merged, ignore_errors=True)
    merge_folders(sorted(work.glob("part-*")), merged, config.dataset_id)
    if problem := find_damage(merged, config.num_episodes):
        raise ValueError(f"{work}: merging failed: {problem}; remove the folder and record again")
    if config.like.given and config.like_columns:
        with within("like"):
            describe_alike(merged, config.like.open().features)
    write_json(merged / SETTINGS_FILE, dict(content))
    merged.replace(config.root)
    print(summary(config.root))


def summary(root: Path) -> str:
    """Return what was recorded, how often it succeeds, and the next command."""
    table = read_episodes(open_dataset(root))
    episodes, frames, fps = len(table.length), int(table.length.sum()), table.dataset.fps
    return (
        f"{root}: {episodes} episodes, {frames} frames ({frames / fps / 60:.1f} minutes)\n"
        f"successful: {int(table.success.sum())}/{episodes}\n"
        f"next: lerobot-wmrl-train-world-model --model.type=frame_tokenizer --dataset.root={root} "
        "--output_dir=outputs/frame_tokenizer"
    )

"""Records what a configuration asks for in parts, resumes after an interruption, and merges the parts."""

import json
import logging
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Protocol

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.merging import already_recorded, merge_folders
from lerobot_dataset_maniskill.rollouts import Rollouts
from lerobot_dataset_maniskill.simulated import ManiSkillEpisodes
from lerobot_dataset_maniskill.writer import find_damage
from lerobot_wmrl.common.errors import FieldError, within
from lerobot_wmrl.common.files import foreign_files, write_json, writing
from lerobot_wmrl.common.output_folders import hold_lock, require_same
from lerobot_wmrl.common.policies import check_weights
from lerobot_wmrl.common.seeds import EVALUATION_SEED, GATE_SEED
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.ledger import IMAGINED, ROLLOUTS, Ledger
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv

RECORDING_FILE: Final = "recording.json"
LOCK: Final = "lock"


class Source(Protocol):
    """Where the episodes of a recording come from."""

    @property
    def parts(self) -> Mapping[str, int]:
        """The sub-datasets that are recorded at a time, in order: the name of each folder, its episodes."""

    @property
    def spent(self) -> Counter[str]:
        """What the episodes cost of a budget (`data.ledger.spending`), if they are real."""

    def check(self) -> None:
        """Raise ValueError where nothing can be recorded."""

    def record(self, work: Path, missing: Sequence[str]) -> None:
        """Record these parts into folders in `work`, with a progress bar."""

    def describe(self, merged: Path) -> str:
        """Add to the merged episodes their settings, and what describes the dataset.

        Returns:
            What was recorded, how often it succeeds, and the next command.
        """

    def settings(self, root: Path) -> dict[str, Any] | None:
        """Return the settings that a dataset says it was recorded with; None if it does not."""


def record(config: RecordConfig) -> None:
    """Record everything that is missing, then merge; or report that the recording is complete."""
    config.validate()
    root = config.root
    work = root.parent / f".{root.name}.recording"
    # as typed: an environment of the hub tells its configuration of its actions when it is made
    content = config.recorded_content()
    source: Source = (ManiSkillEpisodes if config.in_maniskill else Rollouts)(config, content)
    imagined = isinstance(config.env, WorldModelEnv)
    ledger = None if config.budget is None else Ledger(config.budget)
    if ledger is not None:
        check_budget(config, ledger)
    if already_recorded(root, source.settings(root), content, sum(source.parts.values())):
        discard(work, content)
    else:
        if ledger is not None and not imagined:
            ledger.require_left(source.spent)
        if config.policy is not None:
            check_weights(config.policy)
        source.check()
        with writing("output_dir", root), claimed(root, work, content):
            if missing := missing_parts(work, source.parts):
                source.record(work, missing)
            merge(source, work, root, config.dataset_id)
        shutil.rmtree(work, ignore_errors=True)
    if ledger is not None:
        # columns `like` another dataset's may not say who acted
        acted = ROLLOUTS if config.policy is not None else None
        ledger.charge(read_episodes(open_dataset(root)), IMAGINED if imagined else acted)


def check_budget(config: RecordConfig, ledger: Ledger) -> None:
    """Raise FieldError for episodes from which a method under a budget must not learn.

    The gate's rollouts in ManiSkill have seeds of their own, on which nothing is reported.
    """
    if isinstance(config.env, WorldModelEnv):
        from lerobot_wmrl.envs.start_frames import check_starts

        with within("env"):
            check_starts(config.env.dataset, ledger)
        return
    if config.in_maniskill and config.maniskill.split == "ood":
        raise FieldError(
            "env.split", "ood", "under a budget, nothing is recorded in unseen scenes", "choose ind"
        )
    end = config.seed + config.num_episodes
    if end > EVALUATION_SEED and not (config.in_maniskill and config.seed >= GATE_SEED):
        raise FieldError(
            "seed",
            config.seed,
            f"under a budget, seeds from {EVALUATION_SEED} on are for evaluation; these reach {end - 1}",
            "choose a smaller one",
        )


def discard(work: Path, content: Mapping[str, Any]) -> None:
    """Remove the work folder that a command left that was killed just after finishing."""
    stored = work / RECORDING_FILE
    if stored.is_file() and json.loads(stored.read_text()) == content:
        shutil.rmtree(work, ignore_errors=True)


@contextmanager
def claimed(root: Path, work: Path, content: Mapping[str, Any]) -> Iterator[None]:
    """Lock the folder of unfinished work for `root`. It belongs to one configuration and one running command.

    A command that fails before a part is recorded leaves no folder behind.
    """
    work.mkdir(parents=True, exist_ok=True)
    with hold_lock(root, work / LOCK):
        stored = work / RECORDING_FILE
        if stored.is_file() and has_parts(work):
            require_same(root, json.loads(stored.read_text()), content)
        else:
            if not stored.is_file() and foreign_files(work, LOCK, RECORDING_FILE):
                raise FieldError(
                    "output_dir",
                    root,
                    f"{work} beside it, for what is unfinished, holds something else",
                    "move that away, or choose another folder",
                )
            write_json(stored, dict(content))
        try:
            yield
        except BaseException:
            if not has_parts(work):
                shutil.rmtree(work, ignore_errors=True)
            raise


def has_parts(work: Path) -> bool:
    """Return whether a part has been recorded in the folder of unfinished work."""
    return any(work.glob("part-*"))


def missing_parts(work: Path, parts: Mapping[str, int]) -> list[str]:
    """Return the parts without a whole sub-dataset, and remove damaged sub-datasets."""
    for torn in work.glob(".part-*.partial"):
        shutil.rmtree(torn, ignore_errors=True)
    missing = []
    for name, episodes in parts.items():
        folder = work / name
        problem = find_damage(folder, episodes) if folder.exists() else "not recorded yet"
        if problem and folder.exists():
            logging.warning("%s is recorded again: %s", name, problem)
            shutil.rmtree(folder)
        if problem:
            missing.append(name)
    return missing


def merge(source: Source, work: Path, root: Path, repo_id: str) -> None:
    """Merge the parts, move the whole into place at once, and report it."""
    merged = work / "merged"
    shutil.rmtree(merged, ignore_errors=True)
    merge_folders([work / name for name in source.parts], merged, repo_id)
    if problem := find_damage(merged, sum(source.parts.values())):
        raise ValueError(
            f"{work}: merging failed: {problem}; run the same command again: it records damaged parts anew"
        )
    report = source.describe(merged)
    merged.replace(root)
    print(report)

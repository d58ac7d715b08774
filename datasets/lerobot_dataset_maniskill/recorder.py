"""Runs the workers, resumes after an interruption, and merges the sub-datasets into one dataset."""

import fcntl
import json
import logging
import queue
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.imagined import ImaginedPartRecorder
from lerobot_dataset_maniskill.integrity import whole_dataset
from lerobot_dataset_maniskill.manifest import Part, planned_parts
from lerobot_dataset_maniskill.merging import finish, merge_folders
from lerobot_dataset_maniskill.worker import EpisodeResult, PartRecorder, Report, serve_parts
from lerobot_dataset_maniskill.writer import VOCABULARY_FILE
from lerobot_wmrl.common.constants import ACTION_NAMES, KINDS
from lerobot_wmrl.common.files import foreign_files, write_json, writing
from lerobot_wmrl.common.policy_checkpoints import check_fit, check_weights
from lerobot_wmrl.maniskill.backend import render_backend, simulating_context

CONTENT_FILE = "recording.json"
POLL_SECONDS = 1.0
GRACE_SECONDS = 10.0
"""How long a worker may take to leave when its work is done."""


def record(config: RecordConfig) -> None:
    """Record everything that is missing, then merge. Complete already: says so."""
    config.validate()
    root, content = config.root, config.recorded_content()
    work, parts = root.parent / f".{root.name}.recording", planned_parts(config)
    if already_recorded(root, content, count_episodes(parts)):
        discard(work, content)
    else:
        if config.policy is not None:
            check_weights(config.policy)
        if config.imagination is None:
            check_simulation(config)
        with writing("output_dir", root), claimed(work, content):
            record_parts(config, work, parts)
            merge(config, work, parts)
        shutil.rmtree(work, ignore_errors=True)


def check_simulation(config: RecordConfig) -> None:
    """ValueError unless there is a renderer, and it shows what the policy looks at."""
    render_backend()
    if config.policy is not None:
        check_fit(config.policy, config.maniskill.observation_shapes(), len(ACTION_NAMES))


def already_recorded(output_dir: Path, content: Mapping[str, Any], episodes: int) -> bool:
    """Whether `output_dir` holds exactly this recording. ValueError if it holds anything else."""
    if not output_dir.exists() or (output_dir.is_dir() and not any(output_dir.iterdir())):
        return False
    vocabulary = output_dir / VOCABULARY_FILE
    if not vocabulary.is_file():
        raise ValueError(f"--output_dir={output_dir} holds something else; choose a new folder")
    require_same(json.loads(vocabulary.read_text())["recording"], content, output_dir)
    problem = whole_dataset(output_dir, episodes)
    if problem:
        raise ValueError(f"--output_dir={output_dir}: {problem}; remove the folder and record again")
    print(f"{output_dir} is already recorded: {episodes} episodes")
    return True


def discard(work: Path, content: Mapping[str, Any]) -> None:
    """Remove what a command that was killed between finishing and tidying up has left."""
    stored = work / CONTENT_FILE
    if stored.is_file() and json.loads(stored.read_text()) == content:
        shutil.rmtree(work, ignore_errors=True)


def require_same(stored: Mapping[str, Any], content: Mapping[str, Any], folder: Path) -> None:
    """ValueError unless both describe the same episodes."""
    differing = [
        f"{key} {stored.get(key)!r} → {value!r}" for key, value in content.items() if stored.get(key) != value
    ]
    if differing:
        raise ValueError(
            f"--output_dir={folder} holds a recording with other settings ({'; '.join(differing)}): "
            "choose another folder, or repeat the first settings to continue it"
        )


@contextmanager
def claimed(work: Path, content: Mapping[str, Any]) -> Iterator[None]:
    """Hold the folder of unfinished work, which belongs to one configuration and one running command."""
    work.mkdir(parents=True, exist_ok=True)
    with (work / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(f"{work}: another command is recording into this folder; wait for it") from error
        stored = work / CONTENT_FILE
        if stored.is_file():
            require_same(json.loads(stored.read_text()), content, work)
        elif foreign_files(work, "lock", CONTENT_FILE):
            raise ValueError(f"{work} holds something else; move it away to record here")
        else:
            write_json(stored, dict(content))
        yield


def missing_parts(work: Path, parts: list[Part]) -> list[Part]:
    """The parts without a whole sub-dataset; torn and corrupted ones are dropped."""
    for torn in work.glob(".part-*.partial"):
        shutil.rmtree(torn, ignore_errors=True)
    missing = []
    for part in parts:
        folder = work / part.name
        problem = whole_dataset(folder, len(part.episodes)) if folder.exists() else "not recorded yet"
        if problem and folder.exists():
            logging.warning("%s is recorded again: %s", part.name, problem)
            shutil.rmtree(folder)
        if problem:
            missing.append(part)
    return missing


def record_parts(config: RecordConfig, work: Path, parts: list[Part]) -> None:
    """Record the missing parts, in this process or in several, with a progress bar."""
    missing = missing_parts(work, parts)
    if not missing:
        return
    count = min(config.num_workers, len(missing)) if config.imagination is None else 1
    with progress_bar(count_episodes(parts), missing) as report:
        if count == 1:
            make = PartRecorder if config.imagination is None else ImaginedPartRecorder
            recorder = make(config, work)
            for part in missing:
                recorder.record(part, report)
        else:
            record_in_parallel(config, work, missing, count, report)


@contextmanager
def progress_bar(episodes: int, missing: list[Part]) -> Iterator[Report]:
    """Shows what it is told of: episodes, time left, and the share of each kind that succeeded."""
    done = episodes - count_episodes(missing)
    seen: Counter[str] = Counter()
    won: Counter[str] = Counter()
    with tqdm(total=episodes, initial=done, unit="episode", desc="record") as bar:

        def report(result: EpisodeResult) -> None:
            seen[result.kind] += 1
            won[result.kind] += result.success
            bar.set_postfix({kind: f"{won[kind] / seen[kind]:.0%}" for kind in KINDS if seen[kind]}, False)
            bar.update()

        yield report


def record_in_parallel(
    config: RecordConfig, work: Path, missing: list[Part], count: int, report: Report
) -> None:
    """Let `count` processes share the parts."""
    context = simulating_context()
    jobs, results = context.Queue(), context.Queue()
    for item in [*missing, *[None] * count]:
        jobs.put(item)
    arguments = (config, work, jobs, results)
    workers = [context.Process(target=serve_parts, args=arguments, daemon=True) for _ in range(count)]
    for worker in workers:
        worker.start()
    try:
        follow_workers({part.index for part in missing}, results, workers, report)
        for worker in workers:
            worker.join(GRACE_SECONDS)
    finally:
        jobs.cancel_join_thread()  # else a full pipe that nobody reads any more holds the command up
        for worker in workers:
            worker.terminate()
            worker.join()


def follow_workers(open_parts: set[int], results: Any, workers: list[Any], report: Report) -> None:
    """Until every open part is whole. A worker's error is raised here.

    So is its death, as soon as the others are silent: it may have held a lock that they wait for.
    """
    while open_parts:
        try:
            result = results.get(timeout=POLL_SECONDS)
        except queue.Empty:
            ends = [worker.exitcode for worker in workers]
            if any(ends) or None not in ends:
                raise ValueError(
                    f"recording processes died (exit statuses {', '.join(map(str, ends))}; -9 is what a lack "
                    "of memory looks like, None still runs); run the same command to continue"
                ) from None
            continue
        if isinstance(result, Exception):
            raise result
        if isinstance(result, EpisodeResult):
            report(result)
        else:
            open_parts.discard(result)


def merge(config: RecordConfig, work: Path, parts: list[Part]) -> None:
    """Put the parts together and move the whole into place at once."""
    merged = work / "merged"
    shutil.rmtree(merged, ignore_errors=True)
    merge_folders([work / part.name for part in parts], merged, config.dataset_id)
    problem = whole_dataset(merged, count_episodes(parts))
    if problem:
        raise ValueError(f"{work}: merging failed: {problem}; remove the folder and record again")
    finish(merged, config.root, config.dataset_id, config.recorded_content())


def count_episodes(parts: list[Part]) -> int:
    return sum(len(part.episodes) for part in parts)

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
from typing import Any, Final

from tqdm import tqdm

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.imagined import ImaginedPartRecorder
from lerobot_dataset_maniskill.manifest import Part, planned_parts
from lerobot_dataset_maniskill.merging import already_recorded, finish, merge_folders, require_same
from lerobot_dataset_maniskill.worker import EpisodeResult, PartRecorder, Report, serve_parts
from lerobot_dataset_maniskill.writer import find_damage
from lerobot_wmrl.common.actions import warn_of_clipped
from lerobot_wmrl.common.constants import EVALUATION_SEED, GATE_SEED, KINDS
from lerobot_wmrl.common.errors import FieldError, within
from lerobot_wmrl.common.files import foreign_files, write_json, writing
from lerobot_wmrl.common.policies import check_weights, fit_to_environment
from lerobot_wmrl.data.budget import Ledger, spending
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.maniskill.backend import render_backend, simulating_context
from lerobot_wmrl.maniskill.embodiment import ACTION_NAMES

CONTENT_FILE: Final = "recording.json"
POLL_SECONDS: Final = 1.0
GRACE_SECONDS: Final = 10.0
"""Time that a worker may take to exit when its work is done."""


def record(config: RecordConfig) -> None:
    """Record everything that is missing, then merge; or report that the recording is complete."""
    config.validate()
    root, content = config.root, config.recorded_content()
    work, parts = root.parent / f".{root.name}.recording", planned_parts(config)
    ledger = None if config.budget is None else Ledger(config.budget)
    if ledger is not None:
        check_sources(config, ledger, parts)
    if already_recorded(root, content, count_episodes(parts)):
        discard(work, content)
    else:
        if ledger is not None and config.imagination is None:
            ledger.require_left(Counter(spending(plan.kind) for part in parts for plan in part.episodes))
        if config.policy is not None:
            check_weights(config.policy)
        if config.imagination is None:
            check_simulation(config)
        with writing("output_dir", root), claimed(work, content):
            record_parts(config, work, parts)
            merge(config, work, parts)
        shutil.rmtree(work, ignore_errors=True)
    if ledger is not None:
        ledger.charge(read_episodes(open_dataset(root)), imagined=config.imagination is not None)


def check_sources(config: RecordConfig, ledger: Ledger, parts: list[Part]) -> None:
    """Raise FieldError for episodes from which a method under a budget must not learn.

    The gate's rollouts have seeds of their own, on which nothing is reported.
    """
    if config.imagination is not None:
        from lerobot_wmrl.envs.start_frames import check_starts

        with within("env"):
            check_starts(config.imagination.dataset, ledger)
        return
    if config.maniskill.split == "ood":
        raise FieldError(
            "env.split", "ood", "under a budget, nothing is recorded in unseen scenes", "choose ind"
        )
    seeds = {plan.seed for part in parts for plan in part.episodes}
    if any(EVALUATION_SEED <= seed < GATE_SEED for seed in seeds):
        raise FieldError(
            "seed", config.seed,
            f"under a budget, seeds from {EVALUATION_SEED} on are for evaluation; these reach {max(seeds)}",
            "choose a smaller one",
        )  # fmt: skip


def check_simulation(config: RecordConfig) -> None:
    """Raise ValueError unless there is a renderer, and the cameras show what the policy needs."""
    render_backend()
    if config.policy is not None:
        fit_to_environment(config.policy, config.maniskill.observation_shapes(), len(ACTION_NAMES))


def discard(work: Path, content: Mapping[str, Any]) -> None:
    """Remove the work folder that a command left that was killed just after finishing."""
    stored = work / CONTENT_FILE
    if stored.is_file() and json.loads(stored.read_text()) == content:
        shutil.rmtree(work, ignore_errors=True)


@contextmanager
def claimed(work: Path, content: Mapping[str, Any]) -> Iterator[None]:
    """Lock the folder of unfinished work, which belongs to one configuration and one running command.

    A command that fails before a part is recorded leaves no folder behind.
    """
    work.mkdir(parents=True, exist_ok=True)
    with (work / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(f"{work}: another command is recording into this folder; wait for it") from error
        stored = work / CONTENT_FILE
        if stored.is_file() and has_parts(work):
            require_same(json.loads(stored.read_text()), content, work)
        elif not stored.is_file() and foreign_files(work, "lock", CONTENT_FILE):
            raise ValueError(f"{work} holds something else; move it away to record here")
        else:
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


def missing_parts(work: Path, parts: list[Part]) -> list[Part]:
    """Return the parts without a whole sub-dataset, and remove damaged sub-datasets."""
    for torn in work.glob(".part-*.partial"):
        shutil.rmtree(torn, ignore_errors=True)
    missing = []
    for part in parts:
        folder = work / part.name
        problem = find_damage(folder, len(part.episodes)) if folder.exists() else "not recorded yet"
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
    """Show the episodes that are reported to it, the time left, and each kind's success rate.

    At the end it says how many components of a policy's actions were out of range.
    """
    done = episodes - count_episodes(missing)
    seen: Counter[str] = Counter()
    won: Counter[str] = Counter()
    clipped: list[float] = []
    with tqdm(total=episodes, initial=done, unit="episode", desc="record") as bar:

        def report(result: EpisodeResult) -> None:
            seen[result.kind] += 1
            won[result.kind] += result.success
            clipped.extend(result.clipped)
            bar.set_postfix({kind: f"{won[kind] / seen[kind]:.0%}" for kind in KINDS if seen[kind]}, False)
            bar.update()

        yield report
    warn_of_clipped(clipped)


def record_in_parallel(
    config: RecordConfig, work: Path, missing: list[Part], count: int, report: Report
) -> None:
    """Record the parts in `count` processes."""
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
    """Wait until every open part is whole. Raises a worker's error here.

    A worker's death is raised too, as soon as the others are silent: it may have held a lock that they wait
    for.
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
    """Merge the parts and move the whole into place at once."""
    merged = work / "merged"
    shutil.rmtree(merged, ignore_errors=True)
    merge_folders([work / part.name for part in parts], merged, config.dataset_id)
    problem = find_damage(merged, count_episodes(parts))
    if problem:
        raise ValueError(f"{work}: merging failed: {problem}; remove the folder and record again")
    finish(merged, config.root, config.dataset_id, config.recorded_content())


def count_episodes(parts: list[Part]) -> int:
    """Return the number of episodes of all parts."""
    return sum(len(part.episodes) for part in parts)

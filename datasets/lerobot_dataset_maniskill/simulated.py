"""Episodes of planners and policies in ManiSkill, recorded by several processes."""

import queue
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from tqdm import tqdm

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.manifest import DatasetPart, planned_parts
from lerobot_dataset_maniskill.merging import describe, recorded_settings
from lerobot_dataset_maniskill.worker import EpisodeResult, PartRecorder, Report, serve_parts
from lerobot_wmrl.common.actions import warn_of_clipped
from lerobot_wmrl.common.constants import KINDS
from lerobot_wmrl.data.ledger import spending
from lerobot_wmrl.envs.lerobot_env import check_fit_to
from lerobot_wmrl.maniskill.backend import render_backend, simulating_context

POLL_SECONDS: Final = 1.0
GRACE_SECONDS: Final = 10.0
"""Time that a worker may take to exit when its work is done."""


class ManiSkillEpisodes:
    """The episodes that a configuration asks for, with vocabulary and card (`recorder.Source`). `content` are
    its settings."""

    def __init__(self, config: RecordConfig, content: dict[str, Any]) -> None:
        self.config, self.content, self.planned = config, content, planned_parts(config)

    @property
    def parts(self) -> dict[str, int]:
        return {part.name: len(part.episodes) for part in self.planned}

    @property
    def spent(self) -> Counter[str]:
        return Counter(spending(plan.kind) for part in self.planned for plan in part.episodes)

    def check(self) -> None:
        """Raise ValueError unless there is a renderer, and the cameras show what the policy needs."""
        render_backend()
        if self.config.policy is not None:
            check_fit_to(self.config.maniskill, self.config.policy)

    def record(self, work: Path, missing: Sequence[str]) -> None:
        """Record the missing parts, in this process or in several."""
        config, parts = self.config, [part for part in self.planned if part.name in missing]
        count = min(config.num_workers, len(parts))
        with progress_bar(sum(self.parts.values()), parts) as report:
            if count == 1:
                recorder = PartRecorder(config, work)
                for part in parts:
                    recorder.record(part, report)
            else:
                record_in_parallel(config, work, parts, count, report)

    def describe(self, merged: Path) -> str:
        return describe(merged, self.config.root, self.config.dataset_id, self.content)

    def settings(self, root: Path) -> dict[str, Any] | None:
        return recorded_settings(root)


@contextmanager
def progress_bar(episodes: int, missing: Sequence[DatasetPart]) -> Iterator[Report]:
    """Show the episodes that are reported to it, the time left, and each kind's success rate.

    At the end it says how many components of a policy's actions were out of range.
    """
    done = episodes - sum(len(part.episodes) for part in missing)
    tried: Counter[str] = Counter()
    won: Counter[str] = Counter()
    clipped: list[float] = []
    with tqdm(total=episodes, initial=done, unit="episode", desc="record") as bar:

        def report(result: EpisodeResult) -> None:
            tried[result.kind] += 1
            won[result.kind] += result.success
            clipped.extend(result.clipped)
            bar.set_postfix({kind: f"{won[kind] / tried[kind]:.0%}" for kind in KINDS if tried[kind]}, False)
            bar.update()

        yield report
    warn_of_clipped(clipped)


def record_in_parallel(
    config: RecordConfig, work: Path, missing: list[DatasetPart], count: int, report: Report
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

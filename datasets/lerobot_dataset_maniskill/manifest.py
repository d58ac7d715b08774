"""The list of episodes of a recording: a pure function of its configuration, so a recording can be
resumed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_wmrl.common.constants import KINDS, POLICY
from lerobot_wmrl.maniskill.scenes import Scene, scene_for_seed


@dataclass(frozen=True)
class EpisodePlan:
    """One episode to record.

    Args:
        task: with `scene` and `seed`, decides the start.
        kind: how its actions are made, one of `constants.KINDS`.
        scene: what is on the table.
        seed: seed of the episode.
    """

    task: str
    kind: str
    scene: Scene
    seed: int


@dataclass(frozen=True)
class DatasetPart:
    """A sub-dataset: what a worker records at a time."""

    index: int
    episodes: tuple[EpisodePlan, ...]

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"part-{self.index:05d}"


def planned_parts(config: RecordConfig) -> list[DatasetPart]:
    """Return all parts of the shard in order. Shards one after the other have the order of the whole."""
    episodes = planned_episodes(config)
    size, (shard, shards) = config.part_episodes, config.shard_of
    parts = [
        DatasetPart(index, tuple(episodes[first : first + size]))
        for index, first in enumerate(range(0, len(episodes), size))
    ]
    first, end = (len(parts) * number // shards for number in (shard, shard + 1))
    return parts[first:end]


def planned_episodes(config: RecordConfig) -> list[EpisodePlan]:
    """List the episodes. Episode i has the seed `config.seed + i`.

    Consecutive seeds visit scenes and tasks in turn; every round of the scenes gives each the next task.
    """
    scenes, tasks = config.maniskill.selected_scenes(), config.recorded_tasks
    seeds = range(config.seed, config.seed + config.num_episodes)
    return [
        EpisodePlan(task_for_seed(tasks, len(scenes), seed), kind, scene_for_seed(scenes, seed), seed)
        for kind, seed in zip(planned_kinds(config), seeds, strict=True)
    ]


def task_for_seed(tasks: Sequence[str], scenes: int, seed: int) -> str:
    """Return the task of an episode seed where `scenes` scenes are visited in turn."""
    return tasks[(seed % scenes + seed // scenes) % len(tasks)]


def planned_kinds(config: RecordConfig) -> list[str]:
    """Return the kinds of the episodes: exactly the shares (largest remainders), in random order."""
    if config.policy is not None:
        return [POLICY] * config.num_episodes
    names = sorted(config.kinds, key=KINDS.index)
    shares = np.array([config.kinds[name] for name in names], dtype=np.float64)
    ideal = shares / shares.sum() * config.num_episodes
    counts = np.floor(ideal).astype(int)
    for most in np.argsort(counts - ideal, kind="stable")[: config.num_episodes - counts.sum()]:
        counts[most] += 1
    order = np.random.default_rng((config.seed, config.num_episodes)).permutation(np.repeat(names, counts))
    return [str(kind) for kind in order]

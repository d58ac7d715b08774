"""The list of episodes of a recording: a pure function of its configuration, so a recording can be
resumed."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_wmrl.common.constants import KINDS, POLICY, START_COLUMNS, TASK_NAMES
from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.maniskill.scenes import SCENES, Scene, scene_for_seed

MOST_VISITS = 1000
"""Imagined episodes of one recording from the same start up to which recordings with other seeds have other
random numbers."""


@dataclass(frozen=True)
class EpisodePlan:
    """One episode to record.

    Args:
        task: with `scene` and `seed`, decides the start.
        kind: how its actions are made, one of `constants.KINDS`.
        scene: what is on the table.
        seed: seed of the episode.
        start: for an imagined episode, the index of the environment's start frame.
        visit: for an imagined episode, how many earlier ones have the same start.
    """

    task: str
    kind: str
    scene: Scene
    seed: int
    start: int = 0
    visit: int = 0


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
    episodes = simulated_episodes(config) if config.imagination is None else imagined_episodes(config)
    size, (shard, shards) = config.part_episodes, config.shard_of
    parts = [
        DatasetPart(index, tuple(episodes[first : first + size]))
        for index, first in enumerate(range(0, len(episodes), size))
    ]
    first, end = (len(parts) * number // shards for number in (shard, shard + 1))
    return parts[first:end]


def simulated_episodes(config: RecordConfig) -> list[EpisodePlan]:
    """List the episodes to simulate. Episode i has the seed `config.seed + i`.

    Consecutive seeds visit scenes and tasks in turn; every round of the scenes gives each the next task.
    """
    scenes, tasks = config.maniskill.selected_scenes(), config.recorded_tasks
    seeds = range(config.seed, config.seed + config.num_episodes)
    return [
        EpisodePlan(task_for_seed(tasks, len(scenes), seed), kind, scene_for_seed(scenes, seed), seed)
        for kind, seed in zip(planned_kinds(config), seeds, strict=True)
    ]


def imagined_episodes(config: RecordConfig) -> list[EpisodePlan]:
    """List the episodes to imagine, from the environment's start frames in turn.

    Task, scene and seed are those of the recorded episodes that the frames are from, so that an imagined
    episode can be repeated in ManiSkill.
    """
    from lerobot_wmrl.data.episodes import read_episodes
    from lerobot_wmrl.envs.start_frames import chosen_episodes

    assert config.imagination is not None
    source = config.imagination.dataset
    table = read_episodes(source.open())
    missing = [name for name in START_COLUMNS if name not in table.columns]
    if missing:
        raise FieldError(
            "env.dataset.root",
            source.name,
            f"does not say how its episodes began ({', '.join(missing)})",
            "give a dataset that lerobot-wmrl-record recorded: imagined episodes start like its episodes",
        )
    starts, plans = chosen_episodes(table, source), []
    for number in range(config.num_episodes):
        start = (config.seed + number) % len(starts)
        visit = config.seed * MOST_VISITS + number // len(starts)
        task, scene, seed, _ = (int(table.columns[name][starts[start]]) for name in START_COLUMNS)
        plans.append(EpisodePlan(TASK_NAMES[task], POLICY, SCENES[scene], seed, start, visit))
    if len(plans) > len(starts) and not config.exploration:
        logging.warning(
            "%d episodes begin from %d starts: without --exploration a policy whose actions are not random "
            "repeats itself in them",
            config.num_episodes,
            len(starts),
        )
    return plans


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

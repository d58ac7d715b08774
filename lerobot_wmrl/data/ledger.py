"""The ledger of real episodes: how many a method may learn from, and which ones these are.

A study that compares methods at equal real data gives each the same limits. The ledger is one JSON file:

    {"limits": {"demonstrations": 8, "rollouts": 300, "play": 0},
     "episodes": {"<digest>": {"spent": "rollouts", "dataset": "rollouts_1"}, …},
     "trainings": {"rl": 120}}

An episode is known by a digest of its start and actions, which stays the same when a dataset is merged, split
or copied.
"""

import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Final

import numpy as np
from filelock import FileLock

from lerobot_wmrl.common.constants import KINDS, PLAY, POLICY, START_COLUMNS, START_KIND
from lerobot_wmrl.common.errors import FieldError, require_at_least
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.flags import Flags
from lerobot_wmrl.data.episodes import EpisodeTable

DEMONSTRATIONS: Final = "demonstrations"
ROLLOUTS: Final = "rollouts"
IMAGINED: Final = "imagined"
"""Entry of an episode of a world model: known, but of no cost."""

FIRST_LEDGER: Final = 'write it: {"limits": {"demonstrations": 8, "rollouts": 300, "play": 0}}'


@dataclass(frozen=True)
class Limits:
    """Numbers of real episodes that a method may learn from.

    Args:
        demonstrations: planned or taught episodes.
        rollouts: episodes of a policy.
        play: episodes without a task.
    """

    demonstrations: int = 0
    rollouts: int = 0
    play: int = 0

    def __post_init__(self) -> None:
        require_at_least(self, 0, DEMONSTRATIONS, ROLLOUTS, PLAY)


@dataclass
class Entries:
    """Content of a ledger.

    Args:
        limits: what may be spent.
        episodes: digest → what the episode is `spent` on, and the name of its `dataset`'s folder.
        trainings: folder of a training in the simulator, relative to the ledger → rollouts that it has cost.
    """

    limits: Limits
    episodes: dict[str, dict[str, str]] = field(default_factory=dict)
    trainings: dict[str, int] = field(default_factory=dict)

    def spent(self) -> Counter[str]:
        """Return how many episodes have been spent on each of the limits."""
        spent = Counter(entry["spent"] for entry in self.episodes.values())
        spent[ROLLOUTS] += sum(self.trainings.values())
        return spent

    def require_left(self, path: Path, wanted: Mapping[str, int]) -> None:
        """Raise FieldError unless the limits allow the `wanted` episodes too."""
        spent = self.spent()
        for name, limit in asdict(self.limits).items():
            count, left = wanted.get(name, 0), limit - spent[name]
            if count and count > left:
                raise FieldError(
                    "budget",
                    path,
                    f"{count} more {name} are wanted, {left} of {limit} are left",
                    "record fewer, or give every method that is compared a larger limit",
                )


@dataclass(frozen=True)
class Ledger:
    """The ledger at `path`. Every change is written whole, and locked against other processes."""

    path: Path

    @classmethod
    def create(cls, path: Path, limits: Limits) -> "Ledger":
        """Write an empty ledger, or open the one that is there. FieldError if that has other limits."""
        ledger = cls(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        with ledger._locked():
            if not path.exists():
                ledger._write(Entries(limits))
            elif (stored := ledger.read().limits) != limits:
                raise FieldError(
                    "budget",
                    path,
                    f"has other limits ({asdict(stored)}) than {asdict(limits)}",
                    "repeat its limits, or choose another file",
                )
        return ledger

    def read(self) -> Entries:
        """Return what the file holds. FieldError if it is missing or holds no ledger."""
        try:
            content = json.loads(self.path.read_text())
            limits = Limits(**content["limits"])
        except FileNotFoundError:
            raise FieldError("budget", self.path, "there is no such file", FIRST_LEDGER) from None
        except (ValueError, TypeError, KeyError) as error:
            raise FieldError("budget", self.path, f"is no ledger ({error})", FIRST_LEDGER) from error
        return Entries(limits, content.get("episodes", {}), content.get("trainings", {}))

    def require_left(self, wanted: Mapping[str, int]) -> None:
        """Raise FieldError unless so many more episodes, by what they are spent on, are within the limits."""
        self.read().require_left(self.path, wanted)

    def charge(self, table: EpisodeTable, spent: str | None = None) -> None:
        """Enter a dataset's episodes, those that are not there yet.

        Args:
            table: the dataset.
            spent: what all of them are spent on, or IMAGINED if a world model made them; by default what the
                dataset says of who acted.

        Raises:
            FieldError: they exceed a limit. Nothing is entered.
        """
        kinds = [KINDS[kind] if kind >= 0 else "" for kind in table.column(START_KIND)]
        source = Path(table.dataset.root).name
        uses = dict(zip(episode_digests(table), [spent or spending(kind) for kind in kinds], strict=True))
        with self._changing() as entries:
            new = {digest: name for digest, name in uses.items() if digest not in entries.episodes}
            entries.require_left(self.path, Counter(new.values()))
            entries.episodes |= {digest: {"spent": name, "dataset": source} for digest, name in new.items()}

    def charge_training(self, output_dir: Path, rollouts: int) -> None:
        """Enter the rollouts of a training in the simulator. A training that is resumed is charged once.

        Args:
            output_dir: its folder, by which it is known.
            rollouts: episodes of the whole training.

        Raises:
            FieldError: they exceed the limit. Nothing is entered.
        """
        name = os.path.relpath(output_dir, self.path.parent)
        with self._changing() as entries:
            before = entries.trainings.get(name, 0)
            entries.require_left(self.path, {ROLLOUTS: max(rollouts - before, 0)})
            entries.trainings[name] = max(rollouts, before)

    def require_known(self, table: EpisodeTable, episodes: Sequence[int] | np.ndarray | None = None) -> None:
        """Raise FieldError unless the ledger has every episode that is to be learnt from.

        Args:
            table: the dataset.
            episodes: indices of the episodes, by default all.
        """
        known, digests = self.read().episodes, episode_digests(table)
        chosen = range(len(digests)) if episodes is None else episodes
        unknown = [int(episode) for episode in chosen if digests[episode] not in known]
        if unknown:
            raise FieldError(
                "dataset.root",
                table.dataset.root,
                f"{len(unknown)} of {len(chosen)} episodes are not in the budget {self.path}, the first is "
                f"episode {unknown[0]}",
                f"record them with lerobot-wmrl-record --budget={self.path}, or choose others",
            )

    @contextmanager
    def _changing(self) -> Iterator[Entries]:
        """Yield the entries, and write them unless an error leaves the block."""
        self.read()  # where there is no ledger, no lock is left
        with self._locked():
            entries = self.read()
            yield entries
            self._write(entries)

    def _locked(self) -> FileLock:
        """Return a lock beside the ledger, which is itself replaced. It waits for other processes."""
        return FileLock(self.path.with_name(f".{self.path.name}.lock"))

    def _write(self, entries: Entries) -> None:
        write_json(self.path, asdict(entries))


def spending(kind: str) -> str:
    """Return what an episode of a kind is spent on."""
    return {POLICY: ROLLOUTS, PLAY: PLAY}.get(kind, DEMONSTRATIONS)


def episode_digests(table: EpisodeTable) -> list[str]:
    """Return a digest of each episode: sha256 of its task, scene, seed and kind, and its actions. [E]"""
    starts = np.stack([table.column(name) for name in START_COLUMNS], 1).astype("<i8")  # (E, 4)
    return [
        sha256(start.tobytes() + table.action[rows].astype("<f4").tobytes()).hexdigest()
        for start, rows in zip(starts, table.rows(range(len(starts))), strict=True)
    ]


def budget_flags(budget: Path | None) -> Flags:
    """Return the flag that keeps a command within the budget of this training, if it has one."""
    return {} if budget is None else {"budget": str(budget)}

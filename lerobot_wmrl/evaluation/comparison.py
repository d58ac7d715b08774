"""Success rates of policies on the same starts, their pairs, and which pairs are decided."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, Final, NamedTuple

from lerobot_wmrl.common.statistics import PairedChange, Proportion
from lerobot_wmrl.evaluation.sequential import SequentialTest

COMPARISON_FILE: Final = "comparison.json"
"""The file of a comparison, in its folder."""


class Episode(NamedTuple):
    """One start, the `seed` of a suite's task, and whether each policy succeeded, in their order."""

    suite: str
    task_id: int
    seed: int
    successes: list[bool]


class Pair(NamedTuple):
    """Policy `after` against policy `before` on the same starts.

    Args:
        change: starts gained and lost, with McNemar's p-value, which is valid if their number was fixed.
        sequential: the test that is valid at any time of stopping; None if the number of starts is fixed.
        level: p-value that decides; 0 while McNemar's test waits for the number of starts that was fixed.
    """

    before: str
    after: str
    change: PairedChange
    sequential: SequentialTest | None
    level: float

    @property
    def p_value(self) -> float:
        """The p-value that decides."""
        return (self.sequential or self.change).p_value

    @property
    def better(self) -> str | None:
        """The policy that succeeds more often; None if that is not decided."""
        if self.p_value > self.level:
            return None
        gained = self.sequential.sign if self.sequential else self.change.gained - self.change.lost
        return self.after if gained > 0 else self.before

    def as_json(self) -> dict[str, Any]:
        """Return the pair as JSON. `p_value` decides; `mcnemar_p_value` is valid without early stopping."""
        return {
            "before": self.before,
            "after": self.after,
            "gained": self.change.gained,
            "lost": self.change.lost,
            "better": self.better,
            "p_value": self.p_value,
            "test": "sequential" if self.sequential else "mcnemar",
            "mcnemar_p_value": self.change.p_value,
        }


@dataclass(frozen=True)
class Comparison:
    """Outcomes of several policies on the same starts.

    Args:
        policies: names of the policies.
        n_episodes: most starts of each task.
        against: which are paired: every policy with the `first` one, or with `all` others.
        alpha: probability that equal policies are called different, for all pairs together.
        stop_early: whether the comparison ends once every pair is decided.
        episodes: in the order in which they ran.
    """

    policies: Sequence[str]
    n_episodes: int
    against: str = "first"
    alpha: float = 0.05
    stop_early: bool = True
    episodes: list[Episode] = field(default_factory=list)

    @property
    def starts_per_task(self) -> int:
        """Starts of each task so far."""
        return len({episode.seed for episode in self.episodes})

    @property
    def complete(self) -> bool:
        """Whether every task has had all its starts."""
        return self.starts_per_task >= self.n_episodes

    @property
    def finished(self) -> bool:
        """Whether the comparison is complete, or every pair is decided and it may stop early."""
        return self.complete or (self.stop_early and all(pair.better for pair in self.pairs()))

    def rates(self) -> dict[str, Proportion]:
        """Return each policy's success rate."""
        return {name: Proportion.of(outcomes) for name, outcomes in self._outcomes().items()}

    def rates_by_task(self) -> dict[str, dict[str, Proportion]]:
        """Return the rates of each task, named by its suite and its number there."""
        tasks = {
            (episode.suite, episode.task_id): f"{episode.suite} {episode.task_id}"
            for episode in self.episodes
        }
        return {
            name: replace(self, episodes=[each for each in self.episodes if each[:2] == task]).rates()
            for task, name in tasks.items()
        }

    def pairs(self) -> list[Pair]:
        """Return the pairs, each decided at alpha over their number (Bonferroni)."""
        outcomes, names = self._outcomes(), self._pair_names()
        level = self.alpha / len(names) if self.stop_early or self.complete else 0.0
        pairs = []
        for before, after in names:
            both = outcomes[before], outcomes[after]
            sequential = SequentialTest.between(*both) if self.stop_early else None
            change = PairedChange.between(*both)
            pairs.append(Pair(before, after, change, sequential, level))
        return pairs

    def _pair_names(self) -> list[tuple[str, str]]:
        pairs = list(combinations(self.policies, 2))
        return pairs if self.against == "all" else pairs[: len(self.policies) - 1]

    def _outcomes(self) -> dict[str, list[bool]]:
        return {
            name: [episode.successes[index] for episode in self.episodes]
            for index, name in enumerate(self.policies)
        }

    def as_json(self) -> dict[str, Any]:
        """Return results and episodes as JSON, from which `episodes_from_json` continues."""
        return {
            "policies": as_json(self.rates()),
            "by_task": {task: as_json(rates) for task, rates in self.rates_by_task().items()},
            "alpha": self.alpha,
            "finished": self.finished,
            "complete": self.complete,
            "pairs": [pair.as_json() for pair in self.pairs()],
            "episodes": [episode._asdict() for episode in self.episodes],
        }

    def __str__(self) -> str:
        by_task = self.rates_by_task()
        parts = {f", {task}": rates for task, rates in by_task.items()} if len(by_task) > 1 else {}
        rates = {
            name + part: each[name] for part, each in {"": self.rates(), **parts}.items() for name in each
        }
        width = max(map(len, rates))
        lines = [f"{name:<{width}}  {rate}" for name, rate in rates.items()]
        return "\n".join([*lines, "", *map(self._verdict, self.pairs()), self._explanation()])

    def _verdict(self, pair: Pair) -> str:
        evidence = f"{pair.change.gained} gained, {pair.change.lost} lost, p = {pair.p_value:.2g}"
        if pair.better is None:
            verdict = f"not decided after {len(self.episodes)} starts"
        else:
            worse = pair.before if pair.better == pair.after else pair.after
            verdict = f"{pair.better} succeeds more often than {worse}"
        return f"{pair.after} against {pair.before}: {evidence}: {verdict}"

    def _explanation(self) -> str:
        valid = "p is valid at any time of stopping" if self.stop_early else "p is McNemar's exact one"
        return f"{valid}; p up to {self.alpha / len(self._pair_names()):.2g} decides."


def as_json(rates: Mapping[str, Proportion]) -> dict[str, Any]:
    """Return rates by name as JSON."""
    return {name: rate.as_json() for name, rate in rates.items()}


def episodes_from_json(results: Mapping[str, Any]) -> list[Episode]:
    """Return the episodes of a comparison that was written as JSON."""
    return [Episode(**episode) for episode in results["episodes"]]


def chosen_policy(results: Mapping[str, Any]) -> str:
    """Return which policy of a comparison, written as JSON, to go on with: the most successful of those that
    succeed more often than the first, or the first.

    Raises:
        ValueError: the comparison was interrupted.
    """
    require_finished(results)
    first, *_ = policies = results["policies"]
    against = [pair for pair in results["pairs"] if pair["before"] == first]
    better = [pair["after"] for pair in against if pair["better"] == pair["after"]]
    return str(max(better, key=lambda name: policies[name]["share"], default=first))


def most_successful(results: Mapping[str, Any]) -> str:
    """Return which policy of a comparison, written as JSON, succeeds most often; of equal ones the first.

    Raises:
        ValueError: the comparison was interrupted.
    """
    require_finished(results)
    policies = results["policies"]
    return str(max(policies, key=lambda name: policies[name]["share"]))


def require_finished(results: Mapping[str, Any]) -> None:
    """Raise ValueError if a comparison, written as JSON, was interrupted."""
    if not results["finished"]:
        raise ValueError("the comparison is not finished: run its command again")

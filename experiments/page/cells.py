"""Numbers of docs/results.md as text: shares, changes and means with their intervals, and tables."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

Load = Callable[[str], dict[str, Any]]
"""Content of a file of docs/results by its stem."""

DOMAINS: Final = {"ind": "known", "ood": "unseen", "drawn": "known, sampled tokens"}


def share(rate: Mapping[str, Any]) -> str:
    """`57 % (47–66)`: a share with Wilson's 95 % interval."""
    low, high = rate["wilson_95"]
    return f"{100 * rate['share']:.0f} % ({100 * low:.0f}–{100 * high:.0f})"


def counted(rate: Mapping[str, Any]) -> str:
    """`23 of 120, 19 % (13–27)`."""
    return f"{rate['k']} of {rate['n']}, {share(rate)}"


def percents(rates: Sequence[Mapping[str, Any]]) -> str:
    """`63, 62, 62 %`: one share a seed."""
    return ", ".join(f"{100 * rate['share']:.0f}" for rate in rates) + " %"


def points(change: Mapping[str, Any]) -> str:
    """`+12.7 points (+7.7 to +18.0)`: a mean change; its interval resamples starts."""
    mean, low, high = (100 * change[name] for name in ("mean", "low", "high"))
    return f"{mean:+.1f} points ({low:+.1f} to {high:+.1f})"


def estimate(number: Mapping[str, Any] | None, digits: int = 1) -> str:
    """`5.7 (5.4–6.1)`: a mean over episodes with its bootstrap 95 % interval."""
    if number is None or number["value"] is None:
        return "–"
    if number["bootstrap_95"] is None:
        return f"{number['value']:.{digits}f} (one episode)"
    low, high = number["bootstrap_95"]
    return f"{number['value']:.{digits}f} ({low:.{digits}f}–{high:.{digits}f})"


def paired(row: Mapping[str, Any]) -> str:
    """`24 gained, 0 lost (p = 1e-07)`: McNemar's exact test."""
    return f"{row['gained']} gained, {row['lost']} lost (p = {row['p_value']:.1g})"

"""Figures of the report, as data URLs that a self-contained page can hold."""

import base64
import io
from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.improve.report.curves import Curve

COLOURS = ("#2b6cb0", "#dd6b20", "#2f855a", "#805ad5")


def data_url(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def picture(path: Path) -> str:
    """Return a PNG or GIF file as it is."""
    return data_url(path.read_bytes(), path.suffix.lstrip("."))


def drawn(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, bbox_inches="tight")
    return data_url(buffer.getvalue(), "png")


def success_bars(places: Mapping[str, Mapping[str, Proportion]]) -> str:
    """Draw each policy's success with 95 % intervals, a bar a place."""
    figure = Figure(figsize=(8, 3.4))
    axes = figure.subplots()
    width = 0.8 / len(places)
    for offset, (place, rates) in enumerate(places.items()):
        for group, rate in enumerate(rates.values()):
            x = group + (offset - (len(places) - 1) / 2) * width
            label = place if group == 0 else None
            axes.bar(x, rate.share, width=0.92 * width, color=COLOURS[offset], label=label)
            axes.errorbar(x, rate.share, rate.whiskers, color="#333", capsize=4)
            axes.annotate(
                f"{100 * rate.share:.0f} %",
                (x, rate.interval[1]),
                (0, 3),
                textcoords="offset points",
                ha="center",
            )
    titles = [title.replace(" ", "\n", 1) for title in next(iter(places.values()))]
    axes.set_xticks(range(len(titles)), titles)
    axes.set_ylim(0, 1.3)
    axes.set_yticks([0, 0.2, 0.4, 0.6, 0.8, 1])
    axes.set_ylabel("success rate")
    return drawn(tidy(figure))


def line(curve: Curve, title: str) -> str:
    """Draw a curve."""
    figure = Figure(figsize=(4.6, 2.9))
    axes = figure.subplots()
    axes.plot(curve.x, curve.y, color=COLOURS[0], linewidth=1.4)
    axes.set_title(title, fontsize=11)
    axes.set_xlabel(curve.unit)
    return drawn(tidy(figure))


def tidy(figure: Figure) -> Figure:
    """Remove frames, add horizontal grid lines, and show a legend where lines are labelled."""
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", alpha=0.25)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=9)
    return figure

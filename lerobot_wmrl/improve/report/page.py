"""The page: `report.html`, which needs no other file, and `summary.json`."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2

from lerobot_wmrl.common.files import write_json, write_text
from lerobot_wmrl.common.stages import Stage, read_record
from lerobot_wmrl.improve import commands
from lerobot_wmrl.improve.progress import Progress
from lerobot_wmrl.improve.report import figures
from lerobot_wmrl.improve.report.curves import Curve, training_curves
from lerobot_wmrl.improve.report.words import (
    choice_line,
    compared,
    decided_at,
    gate_line,
    gate_warnings,
    lacks,
    pair_lines,
    read_choice,
    reservations,
    rl_line,
    rollouts_line,
    start_line,
    trust,
)
from lerobot_wmrl.improve.results import Place, read_check, read_gate, read_selection
from lerobot_wmrl.improve.stage_names import StageName
from lerobot_wmrl.improve.stages import list_stages

PAGE = "report.html"

CHECKED = ("false_positives", "failures", "true_positives", "successes")
"""What the check counted."""

PICTURE_SECTIONS = (
    (
        "comparison",
        "Recorded beside imagined",
        "The same episode twice, from the same first frame and with the same actions: above as it was "
        "recorded, below as the world model imagined it.",
    ),
    (
        "goal",
        "Goal frames",
        "What the text world model expects the scene to look like when the task is done.",
    ),
    (
        "reward",
        "The reward along recorded episodes",
        "A successful and a failed episode, with the reward that the world models give each frame.",
    ),
    (
        "accuracy",
        "How long the imagination stays true",
        "How close imagined frames are to recorded ones, by the number of frames imagined so far.",
    ),
)
"""Start of the pictures' file names, heading, and what to look for."""


@dataclass(frozen=True)
class Page:
    """A page about an improvement.

    Args:
        progress: the improvement, as far as it has come.
        title: the page's heading.
        seed: that the command was given.
        records: records of the command's stages, in order.
        places: where the policies were compared.
        replays: folders with pictures of replayed episodes, by whose they are.
        curves: curves of trainings beside those of the improvement, by title.
    """

    progress: Progress
    title: str
    seed: int
    records: Sequence[dict[str, Any]]
    places: Sequence[Place]
    replays: Mapping[str, Path]
    curves: Mapping[str, Curve] = field(default_factory=dict)

    @classmethod
    def of(cls, progress: Progress) -> "Page":
        """Return the page of an improvement by itself."""
        plan = progress.plan
        return cls(
            progress,
            f"{plan.policy}, improved in imagination",
            plan.config.seed,
            stage_records(plan.out, list_stages(progress)),
            [compared(progress)],
            {"recorded": plan.folder(StageName.CHECK)},
        )

    def write(self, folder: Path) -> Path:
        """Write summary.json and the page into a folder; return the page."""
        summary = self.summary()
        write_json(folder / "summary.json", summary)
        write_text(folder / PAGE, self._render(summary))
        return folder / PAGE

    def summary(self) -> dict[str, Any]:
        """Return every headline number as JSON."""
        plan = self.progress.plan
        check, gate = read_check(plan.out), read_gate(plan.out)
        choice = read_choice(self.progress)
        return {
            "size": plan.config.preset,
            "seed": self.seed,
            "places": {place.name: place.comparison.as_json() for place in self.places},
            "check": {name: check[name] for name in CHECKED},
            "gate": gate and gate["fresh"],
            "chosen": self.progress.chosen() if choice else None,
            "choice": choice and choice.comparison.as_json(),
            "rl_checkpoints": read_selection(plan.out),
            "seconds": sum(record["seconds"] for record in self.records),
            "peak_memory_bytes": max(record["peak_memory_bytes"] for record in self.records),
        }

    def _all_records(self) -> list[dict[str, Any]]:
        """Return the records of all stages: behind that of lerobot-wmrl-improve, if it is one, its own."""
        records = []
        for record in self.records:
            records.append(record)
            if shlex.split(record["command"])[0] == "lerobot-wmrl-improve":
                nested = stage_records(self.progress.plan.out, list_stages(self.progress))
                records += [{**each, "title": f"– {each['title']}"} for each in nested]
        return records

    def _render(self, summary: Mapping[str, Any]) -> str:
        """Fill the template, with every picture inside the page."""
        environment = jinja2.Environment(
            loader=jinja2.PackageLoader("lerobot_wmrl.improve.report", "."),
            autoescape=True,
            undefined=jinja2.StrictUndefined,
        )
        progress = self.progress
        curves = {**self.curves, **training_curves(progress)}
        return environment.get_template("template.html").render(
            title=self.title,
            size=summary["size"],
            seed=self.seed,
            minutes=round(summary["seconds"] / 60, 1),
            peak_memory=f"{summary['peak_memory_bytes'] / 1e9:.1f}",
            paths=progress.policies,
            places=self.places,
            changes={place.name: pair_lines(place) for place in self.places},
            decided_at=decided_at(self.places),
            reservations=reservations(progress),
            start=[*start_line(progress), *rl_line(progress)],
            choice=choice_line(progress),
            chosen=summary["chosen"],
            bars=figures.success_bars({place.name: place.rates for place in self.places}),
            data=[*progress.plan.findings.lines, *rollouts_line(progress)],
            missing=lacks(progress),
            trust=[trust(progress), *gate_line(progress)],
            warnings=gate_warnings(progress),
            pictures=picture_sections(self.replays),
            curves=[figures.line(curve, title) for title, curve in curves.items()],
            drive=shlex.join(commands.drive_command(progress)),
            another_round=shlex.join(commands.another_round_command(progress) or []),
            stages=self._all_records(),
        )


def stage_records(folder: Path, stages: Sequence[Stage]) -> list[dict[str, Any]]:
    """Read the records of finished stages."""
    return [read_record(folder, stage.name) for stage in stages]


def picture_sections(replays: Mapping[str, Path]) -> list[dict[str, Any]]:
    """Collect the pictures of the replays by section, `<folder>/<section>*.png|gif`."""
    sections = []
    for stem, title, text in PICTURE_SECTIONS:
        images = [
            {"url": figures.picture(path), "caption": f"{whose}: {path.stem.replace('_', ' ')}"}
            for whose, folder in replays.items()
            for path in sorted(folder.glob(f"{stem}*"))
            if path.suffix in (".png", ".gif")
        ]
        if images:
            sections.append({"title": title, "text": text, "images": images})
    return sections

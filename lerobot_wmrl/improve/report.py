"""The report of an improvement, `report.md`: what was found, learnt and gained."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_wmrl.common.files import write_text
from lerobot_wmrl.common.stages import Stage, read_record
from lerobot_wmrl.common.statistics import Proportion
from lerobot_wmrl.evaluation.comparison import RESULTS
from lerobot_wmrl.evaluation.gate import DOUBTFUL_AUC
from lerobot_wmrl.evaluation.report import seen_line
from lerobot_wmrl.improve.stages import DONE_THRESHOLD, Improvement


def write_report(improvement: Improvement, stages: list[Stage]) -> Path:
    """Write the report and return its path."""
    path = improvement.out / "report.md"
    records = [read_record(improvement.out, stage) for stage in stages]
    listed = "\n\n".join(
        f"{each['title']} ({each['seconds']:.0f} s):\n\n```\n{each['command']}\n```" for each in records
    )
    sections = {
        "Result": verdict(improvement),
        "Data": "\n".join(f"- {line}" for line in [*improvement.found.lines, *improvement.found.missing]),
        "Can the world model be trusted?": trust(improvement),
        "The commands": listed,
    }  # fmt: skip
    text = "\n\n".join(f"## {title}\n\n{body}" for title, body in sections.items())
    write_text(path, f"# {improvement.policy}, improved in imagination\n\n{text}\n")
    return path


def verdict(improvement: Improvement) -> str:
    """Say in a few lines what was gained, and where."""
    found = read(improvement.out / "comparison" / RESULTS)
    names = dict(zip(found["policies"], policy_titles(improvement), strict=True))
    real = improvement.config.real_env
    where = "in imagination, from frames of the dataset" if real is None else f"in {real.type}"
    paths = dict(zip(names, improvement.policies, strict=True))
    rates = [
        f"- {title}: {Proportion(rate['k'], rate['n'])}, `{paths[name]}`"
        for (name, title), rate in zip(names.items(), found["policies"].values(), strict=True)
    ]
    changes = [
        f"- {names[pair['after']]}, against {names[pair['before']]}: {pair['gained']} starts gained, "
        f"{pair['lost']} lost, p = {pair['p_value']:.2g}: {decision(pair)}"
        for pair in found["pairs"]
    ]
    said = "\n".join([f"Success {where}:\n", *rates, "\nOn the same starts:\n", *changes])
    if real is None:
        said += (
            "\n\nThis is what the world model predicts, and shows nothing about the real world. Run the "
            "policies there, label what they did, and run the command again on all episodes."
        )
    return said


def policy_titles(improvement: Improvement) -> list[str]:
    """Return what the compared policies are, in their order."""
    cloned = ["trained further on the successes"] if improvement.clones else []
    return ["as it was", *cloned, "improved in imagination"]


def decision(pair: Mapping[str, Any]) -> str:
    """Say whether the second policy of a pair is decided to be better or worse than the first."""
    if pair["better"] is None:
        return "not decided"
    return "better" if pair["better"] == pair["after"] else "worse"


def trust(improvement: Improvement) -> str:
    """Say how well the world model tells recorded successes from failures."""
    found = read(improvement.out / "check" / "metrics.json")
    wins, losses = found["successes"], found["failures"]
    whose = "rollouts" if Path(found["dataset"]) == improvement.out / "merged" else "episodes"
    held_out = found["split"] == "validation"
    kind = f"held-out {whose}" if held_out else f"{whose} (most of which it has learnt from)"
    if not wins or not losses:
        return (
            f"Unknown: of the {kind} {wins} succeed and {losses} fail, and both are needed. Record more."
            f"{taken_instead(improvement)}"
        )
    false, recall = Proportion(found["false_positives"], losses), Proportion(found["true_positives"], wins)
    said = (
        f"On {wins + losses} {kind}: false positives {false}, recall {recall}, AUC {found['auc']:.2f} (the "
        "probability that a success scores higher than a failure; 0.5 is chance)."
    )
    if found["auc"] < DOUBTFUL_AUC:
        said += " That is not enough to trust its reward: record more episodes, failures above all."
    if (seen := found.get("seen_auc")) is not None:
        larger = " `--size=cpu` has larger frames." if improvement.could_be_larger else ""
        said += f" {seen_line(seen, larger)}"
    return said + taken_instead(improvement)


def taken_instead(improvement: Improvement) -> str:
    """Say where imagination saw success, if not at the strict threshold."""
    point = improvement.relaxed_criterion()
    if point is None:
        return ""
    false, recall = (
        Proportion(point[name]["k"], point[name]["n"]) for name in ("false_positive_rate", "recall")
    )
    return (
        f" No success is recognised at done_threshold={DONE_THRESHOLD}: imagination took "
        f"done_threshold={point['done_threshold']} and done_frames={point['done_frames']}, chosen on the "
        f"same episodes (false positives {false}, recall {recall})."
    )


def read(path: Path) -> dict[str, Any]:
    """Read a stage's JSON."""
    found: dict[str, Any] = json.loads(path.read_text())
    return found

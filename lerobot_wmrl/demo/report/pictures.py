"""The report's pictures: made by the replays, shown under headings that say what to look for."""

from pathlib import Path
from typing import Any

from lerobot_wmrl.demo.report.figures import picture

SECTIONS = (
    (
        "comparison",
        "Real beside imagined",
        "The same episode twice, from the same first frame and with the same actions: above as it happened, "
        "below as the world model imagined it.",
    ),
    (
        "goal",
        "Goal frames",
        "What the text world model expects the scene to look like when the task is done. The reward measures "
        "how close an imagined frame comes to it.",
    ),
    (
        "reward",
        "The reward along real episodes",
        "A successful and a failed real episode, with the reward that the world models give each frame.",
    ),
    (
        "accuracy",
        "How long the imagination stays true",
        "The distance between imagined and real frames, by the number of frames imagined so far.",
    ),
)
"""Start of the pictures' file names, heading, what to look for."""

EPISODES = {"rl": "PPO policy", "sft": "cloned policy", "held_out": "recorded, held out from training"}
"""Whose real episodes were replayed, by the suffix of the folder."""


def picture_sections(output_dir: Path) -> list[dict[str, Any]]:
    """Sections with at least one picture, from `replay_<whose>/<section>*.png|gif`."""
    sections = []
    for stem, title, text in SECTIONS:
        images = [
            {"url": picture(path), "caption": f"{whose}: {path.stem.replace('_', ' ')}"}
            for suffix, whose in EPISODES.items()
            for path in sorted((output_dir / f"replay_{suffix}").glob(f"{stem}*"))
            if path.suffix in (".png", ".gif")
        ]
        if images:
            sections.append({"title": title, "text": text, "images": images})
    return sections

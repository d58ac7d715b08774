"""Write docs/reference/*.md: what every console command answers to `--help`, alone and with its types.

make help docs
"""

import os
import re
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from lerobot_wmrl.common.stored_help import FOLDER

ROOT: Final = Path(__file__).parents[1]
TYPES: Final = {
    "lerobot-wmrl-record": (
        ["--env.type=wmrl_maniskill"],
        ["--env.type=world_model"],
        ["--policy.type=wm_mpc"],
    ),
    "lerobot-wmrl-train-world-model": (
        ["--model.type=action_world_model"],
        ["--model.type=action_world_model", "--model.dynamics.type=autoregressive"],
        ["--model.type=text_world_model"],
    ),
    "lerobot-wmrl-label": (
        ["--success.type=first_frames"],
        ["--success.type=column"],
        ["--success.type=reward_model"],
        ["--success.type=by_hand"],
    ),
    "lerobot-wmrl-train": (
        ["--env.type=world_model"],
        ["--algorithm.type=grpo"],
        ["--algorithm.type=distillation"],
    ),
}
"""Flags that choose types, whose own flags a page shows beside `--help` alone."""


def scripts() -> dict[str, str]:
    """Return the module of every console command."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return {name: target.partition(":")[0] for name, target in project["scripts"].items()}


def help_of(module: str, flags: list[str]) -> str:
    """Return what a command says, with a fixed width and without folders of this machine."""
    environment = {**os.environ, "COLUMNS": "100", "TERM": "dumb"}
    code = f"import sys; sys.argv = [{module!r}, *{flags!r}]; from {module} import main; main()"
    found = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=ROOT
    )
    if found.returncode:
        raise RuntimeError(f"{module} {' '.join(flags)}: {found.stderr[-1000:]}")
    text = re.sub(r"\x1b\[[0-9;]*m", "", found.stdout)
    return text.replace(str(ROOT), ".").replace(str(Path.home()), "~").rstrip()


def page(command: str, module: str) -> str:
    """Return one command's page."""
    stored = (FOLDER / f"{command}.txt").read_text().rstrip()
    parts = [
        f"# {command}\n\nWritten from `--help` by `make help docs`.\n",
        f"## `{command} --help`\n\n```text\n{stored}\n```\n",
    ]
    for flags in TYPES.get(command, ()):
        lines = help_of(module, [*flags, "--help"]).splitlines()
        own = "\n".join(added(lines, stored.splitlines()))
        parts.append(f"## With `{' '.join(flags)}`\n\n```text\n{own}\n```\n")
    return "\n".join(parts)


def added(lines: list[str], stored: list[str]) -> list[str]:
    """Return the flags, with their explanations, that are not in the stored page."""
    known = {line.split()[0] for line in stored if line.startswith("  --")}
    kept, keep = [], False
    for line in lines:
        if line.startswith("  --"):
            keep = line.split()[0] not in known
        elif not line.startswith("     "):
            keep = False
        if keep:
            kept.append(line)
    return kept


def main() -> None:
    """Entry point."""
    folder = ROOT / "docs" / "reference"
    folder.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(2) as pool:
        written = list(pool.map(lambda item: (item[0], page(*item)), scripts().items()))
    for command, text in written:
        (folder / f"{command}.md").write_text(text)
    lines = [f"- [{command}]({command}.md)" for command, _ in written]
    (folder / "README.md").write_text("# Reference\n\n" + "\n".join(lines) + "\n")
    print(f"wrote {len(written)} pages to {folder.relative_to(ROOT)}")


if __name__ == "__main__":
    main()

"""Write docs/reference/*.md: what every console command says with `--help`.

python tools/reference_pages.py
"""

import os
import re
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]
PAGES: Final = {
    "lerobot-wmrl-record": (["--help"], ["--env.type=wmrl_maniskill", "--help"]),
    "lerobot-wmrl-train-world-model": (
        ["--model.type=frame_tokenizer", "--help"],
        ["--model.type=action_world_model", "--help"],
        ["--model.type=text_world_model", "--help"],
    ),
    "lerobot-wmrl-train": (
        ["--env.type=world_model", "--algorithm.type=ppo", "--help"],
        ["--env.type=world_model", "--algorithm.type=grpo", "--help"],
    ),
}
"""Flags of each help that a page shows; `--help` alone for commands that are not named."""


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
    parts = [f"# {command}\n\nGenerated from `--help` by `python tools/reference_pages.py`.\n"]
    for flags in PAGES.get(command, (["--help"],)):
        parts.append(f"## `{' '.join([command, *flags])}`\n\n```text\n{help_of(module, flags)}\n```\n")
    return "\n".join(parts)


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

"""lerobot-wmrl-demo: the whole loop with one command, and a page that shows what it did.

    lerobot-wmrl-demo --preset=demo --output_dir=outputs/demo

Running the same command again continues after the last finished piece of work.
"""

import signal
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import NoReturn

from lerobot_wmrl.common.command_line import run_command
from lerobot_wmrl.common.presets import expand_preset
from lerobot_wmrl.demo.pipeline import StageError, claimed, run_stages
from lerobot_wmrl.demo.stages import DemoConfig, demo_stages


def run_demo(cfg: DemoConfig) -> None:
    """Every stage, then the report."""
    cfg.check()
    stages = demo_stages(cfg)
    with claimed(cfg.output_dir, {**asdict(cfg), "output_dir": str(cfg.output_dir)}):
        run_stages(stages, cfg.output_dir)
        from lerobot_wmrl.demo.report.build import write_report

        page = write_report(cfg, [stage.name for stage in stages])
    print(f"\nreport: {page}")


def interrupt(signal_number: int, frame: object) -> NoReturn:
    """`kill` ends the demo as Ctrl-C does: with its stage, and with a word on how to go on."""
    raise KeyboardInterrupt


def with_preset(argv: Sequence[str]) -> list[str]:
    """Replace the preset by its flags; without one it is the demo's."""
    given = any(argument.startswith("--preset") for argument in argv)
    return expand_preset(argv if given else ["--preset=demo", *argv], "demo")


def main() -> None:
    """Run the console command."""
    signal.signal(signal.SIGTERM, interrupt)
    try:
        run_command(run_demo, DemoConfig, with_preset)
    except StageError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("\nstopped: run the same command again to continue where it stopped")


if __name__ == "__main__":
    main()

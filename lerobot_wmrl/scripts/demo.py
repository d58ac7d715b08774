"""lerobot-wmrl-demo: the whole loop with one command, and a page that shows what it did.

    lerobot-wmrl-demo --preset=demo --output_dir=outputs/demo

Running the same command again continues after the last finished piece of work.
"""

import signal
import sys
from dataclasses import dataclass
from typing import NoReturn

from lerobot_wmrl.demo.pipeline import StageError, claimed, run_stages
from lerobot_wmrl.demo.stages import DemoConfig, demo_stages
from lerobot_wmrl.scripts.command import RunConfig, run_command


@dataclass
class DemoCommand(DemoConfig, RunConfig):
    __doc__ = DemoConfig.__doc__


def run_demo(cfg: DemoCommand) -> None:
    """Every stage, then the report."""
    stages = demo_stages(cfg)
    with claimed(cfg):
        try:
            run_stages(stages, cfg.output_dir)
        except StageError as error:
            raise SystemExit(f"error: {error}") from None
        except KeyboardInterrupt:
            raise SystemExit("\nstopped: run the same command again to continue where it stopped") from None
        from lerobot_wmrl.report.build import write_report

        page = write_report(cfg, [stage.name for stage in stages])
    print(f"\nreport: {page}")


def interrupted(signal_number: int, frame: object) -> NoReturn:
    raise KeyboardInterrupt


def main() -> None:
    """Entry point of the console command; without a preset it is the demo's."""
    signal.signal(signal.SIGTERM, interrupted)
    if not any(argument.startswith("--preset") for argument in sys.argv[1:]):
        sys.argv.insert(1, "--preset=demo")
    run_command(run_demo, DemoCommand, "demo")


if __name__ == "__main__":
    main()

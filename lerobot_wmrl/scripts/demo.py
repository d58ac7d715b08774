"""lerobot-wmrl-demo: from nothing to a better policy with one command, and a page that shows what it did.

    lerobot-wmrl-demo --preset=demo --output_dir=outputs/demo

It records demonstrations of a task in ManiSkill, clones a policy, and calls lerobot-wmrl-improve, which
learns from these and from rollouts of that policy alone. In the end it compares the policies on held-out
starts in unseen scenes too. Every stage is one console command, which it prints. Running the same command
again continues an interrupted demo. It ends with a summary and `report.html`.
"""

from dataclasses import asdict
from functools import partial

from lerobot_wmrl.common.output_folders import Claim
from lerobot_wmrl.common.presets import expand_preset
from lerobot_wmrl.common.stages import MARKER, run_stage_command, run_stages
from lerobot_wmrl.demo.stages import Demo, DemoConfig, conclusion
from lerobot_wmrl.maniskill.backend import require_simulator


def run_demo(cfg: DemoConfig) -> None:
    """Run every stage, write the report, and say what came of it."""
    cfg.validate()
    require_simulator()
    demo = Demo(cfg)
    settings = {**asdict(cfg), "output_dir": str(cfg.output_dir)}
    with Claim(cfg.output_dir, settings, marker=MARKER).held():
        run_stages(demo.stages(), cfg.output_dir, ["lerobot_wmrl.maniskill.simulation"], offline=True)
        page = demo.page()
        path = page.write(cfg.output_dir)
    print(f"\n{conclusion(page, path)}")


def main() -> None:
    """Run the console command."""
    run_stage_command(run_demo, DemoConfig, partial(expand_preset, command="demo"))


if __name__ == "__main__":
    main()

"""lerobot-wmrl-demo: the whole loop with one command, and a page that shows what it did.

    lerobot-wmrl-demo --preset=demo --output_dir=outputs/demo

It records demonstrations of a task in ManiSkill, clones a policy, records that policy's rollouts, and learns
from these alone: a policy cloned again with the successful rollouts, world models, and that policy trained by
PPO inside them and then fitted to a planner. All policies are measured on the same held-out starts in
ManiSkill. Every stage is one console command, which it prints. Running the same command again continues an
interrupted demo. It ends with a summary and `report.html`.
"""

from collections.abc import Sequence
from dataclasses import asdict

from lerobot_wmrl.common.presets import expand_preset
from lerobot_wmrl.demo.stages import DemoConfig, demo_stages


def run_demo(cfg: DemoConfig) -> None:
    """Run every stage, write the report, and say what came of it."""
    from lerobot_wmrl.common.stages import claimed, run_stages

    cfg.check()
    stages = demo_stages(cfg)
    with claimed(cfg.output_dir, {**asdict(cfg), "output_dir": str(cfg.output_dir)}):
        run_stages(stages, cfg.output_dir, ["lerobot_wmrl.maniskill.simulation"], offline=True)
        from lerobot_wmrl.demo.report.page import conclusion, write_report

        page = write_report(cfg, [stage.name for stage in stages])
    print(f"\n{conclusion(cfg, page)}")


def with_preset(argv: Sequence[str]) -> list[str]:
    """Expand the preset, `demo` if none is given."""
    given = any(argument.startswith("--preset") for argument in argv)
    return expand_preset(argv if given else ["--preset=demo", *argv], "demo")


def main() -> None:
    """Run the console command."""
    from lerobot_wmrl.common.stages import run_stage_command

    run_stage_command(run_demo, DemoConfig, with_preset)


if __name__ == "__main__":
    main()

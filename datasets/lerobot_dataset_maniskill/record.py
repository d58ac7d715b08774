"""`lerobot-wmrl-record`: trajectories in ManiSkill → a LeRobotDataset."""

import sys

from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_wmrl.maniskill.scenes import describe_scenes
from lerobot_wmrl.presets import expand_preset


@parser.wrap()
def run(config: RecordConfig) -> None:
    if config.list_scenes:
        print(describe_scenes())
        return
    from lerobot_dataset_maniskill.quiet import silence_libraries
    from lerobot_dataset_maniskill.recorder import record

    silence_libraries()
    record(config)


def main() -> None:
    """Entry point. Bad input: one clear line, exit code 1."""
    register_third_party_plugins()
    init_logging()
    try:
        sys.argv[1:] = expand_preset(sys.argv[1:], "record")
        run()
    except (ValueError, FileNotFoundError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()

"""`lerobot-wmrl-record`: trajectories in ManiSkill → a LeRobotDataset."""

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.recipe_files import expand_recipes
from lerobot_wmrl.command import run_command
from lerobot_wmrl.maniskill.scenes import describe_scenes


def run(config: RecordConfig) -> None:
    """Print the scenes, or record."""
    if config.list_scenes:
        print(describe_scenes())
        return
    from lerobot_dataset_maniskill.quiet import silence_libraries
    from lerobot_dataset_maniskill.recorder import record
    from lerobot_dataset_maniskill.shards import merge_shards

    silence_libraries()
    if config.merge_shards:
        config.validate()
        assert config.output_dir is not None
        merge_shards(config.merge_shards, config.output_dir, config.dataset_id)
    else:
        record(config)


def main() -> None:
    """Entry point of the console command."""
    run_command(run, RecordConfig, expand_recipes)


if __name__ == "__main__":
    main()

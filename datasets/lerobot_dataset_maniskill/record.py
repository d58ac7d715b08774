"""lerobot-wmrl-record: record trajectories in ManiSkill, or rollouts of a policy, as a LeRobotDataset.

    lerobot-wmrl-record --preset=demo --output_dir=outputs/planned
    lerobot-wmrl-record --policy.path=outputs/sft --env.type=wmrl_maniskill --num_episodes=60 \\
        --output_dir=outputs/rollouts
    lerobot-wmrl-record --policy.path=outputs/sft --env.type=world_model --env.world_model_path=W \\
        --env.dataset.root=D --output_dir=outputs/imagined

Planners act by default; with `--policy.path` that policy does, in ManiSkill or in a world model.
`--recipe=FILE` stands for the settings in a YAML file, `--preset=tiny|demo|cpu|gpu|paper` for one of those in
the package; flags further right override them.
Running the same command again continues an interrupted recording, or reports that it is complete.
"""

from huggingface_hub import HfApi

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.recipe_files import expand_recipes
from lerobot_wmrl.common.command_line import run_command
from lerobot_wmrl.common.files import writing
from lerobot_wmrl.maniskill.scenes import describe_scenes


def run(config: RecordConfig) -> None:
    """Print the scenes, or record and publish."""
    if config.list_scenes:
        print(describe_scenes())
        return
    from lerobot_dataset_maniskill.publishing import publish
    from lerobot_dataset_maniskill.quiet import silence_libraries
    from lerobot_dataset_maniskill.recorder import record
    from lerobot_dataset_maniskill.shards import merge_shards

    silence_libraries()
    if config.merge_shards:
        config.validate()
        with writing("output_dir", config.root):
            merge_shards(config.merge_shards, config.root, config.dataset_id)
    else:
        record(config)
    if config.push_to_hub:
        publish(HfApi(), config.root, config.dataset_id, config.private)


def main() -> None:
    """Entry point of the console command."""
    run_command(run, RecordConfig, expand_recipes)


if __name__ == "__main__":
    main()

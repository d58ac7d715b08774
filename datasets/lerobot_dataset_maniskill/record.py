"""lerobot-wmrl-record: record trajectories in ManiSkill, or rollouts of a policy, as a LeRobotDataset.

    lerobot-wmrl-record --preset=demo --output_dir=outputs/planned
    lerobot-wmrl-record --policy.path=outputs/sft --env.type=wmrl_maniskill --num_episodes=60 \\
        --output_dir=outputs/rollouts
    lerobot-wmrl-record --policy.path=outputs/sft --env.type=world_model --env.world_model_path=W \\
        --env.dataset.root=D --like.root=D --output_dir=outputs/imagined
    lerobot-wmrl-record --policy.path=outputs/sft --env.type=pusht --like.root=data/demonstrations \\
        --output_dir=outputs/rollouts

Planners act by default; with `--policy.path` that policy does, in ManiSkill, in any environment of LeRobot's
or in a world model.
`--recipe=FILE` stands for the settings in a YAML file, `--preset=tiny|demo|cpu|gpu|paper` for one of those in
the package; flags further right override them.
Running the same command again continues an interrupted recording, or reports that it is complete.
"""

import importlib.resources
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_dataset_maniskill.merging import merge_shards
from lerobot_dataset_maniskill.publishing import ONLY_PUBLISHES, publish
from lerobot_dataset_maniskill.recorder import record
from lerobot_dataset_maniskill.worker import silence_libraries
from lerobot_wmrl.common.command_line import run_command
from lerobot_wmrl.common.errors import renamed, suggestion
from lerobot_wmrl.common.files import writing
from lerobot_wmrl.common.flags import format_flags
from lerobot_wmrl.common.hub import create_repo, publishing
from lerobot_wmrl.common.presets import chosen_types, read_settings, without_other_types
from lerobot_wmrl.common.settings import settings_of
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.ledger import IMAGINED, Ledger
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.maniskill.scenes import describe_scenes

MANISKILL: Final = RecordConfig().env.type
"""The environment that is recorded in unless another is given."""

IN_MANISKILL: Final = ("tasks", "kinds", "depth", "shard", "num_workers")
"""Settings of a recipe that say something of ManiSkill alone."""


def expand_recipes(argv: Sequence[str]) -> list[str]:
    """Replace `--recipe=FILE`, and `--preset=NAME` (a recipe of this package), by their flags in place.

    With another environment than the recipe's, what it says of its own is left out.
    """
    expanded: list[str] = []
    kind = chosen_types(argv).get("env")
    for argument in argv:
        name, _, value = argument.partition("=")
        if name == "--recipe":
            expanded += recipe_flags(Path(value), kind)
        elif name == "--preset":
            expanded += recipe_flags(packaged_recipe(value), kind)
        else:
            expanded.append(argument)
    return expanded


def packaged_recipe(name: str) -> Path:
    """Return the file of a recipe of this package. Raises ValueError if there is none."""
    folder = Path(str(importlib.resources.files("lerobot_dataset_maniskill") / "recipes"))
    known = sorted(path.stem for path in folder.glob("*.yaml"))
    if name not in known:
        raise ValueError(f"--preset={name}: unknown preset; choose one of {', '.join(known)}")
    return folder / f"{name}.yaml"


def recipe_flags(path: Path, env: str | None = None) -> list[str]:
    """Return the file's keys as flags, of an environment `env` those that it has too, if it is another one.
    Raises ValueError if the file cannot be read, or names an unknown key."""
    try:
        settings = read_settings(path, whole=("kinds",))
    except ValueError as error:
        raise ValueError(f"--recipe={error}") from error
    flags = format_flags(settings)
    paths = {f"{name}.path" for name in RecordConfig.path_fields}
    known = {*(each.name for each in settings_of(RecordConfig, chosen_types(flags))), *paths}
    for name in settings:
        if name not in known:
            prefix, _, key = name.rpartition(".")
            beside = sorted(each.rpartition(".")[2] for each in known if each.rpartition(".")[0] == prefix)
            hint = suggestion(key, beside, prefix and f"{prefix}.") if beside else "see --help"
            raise ValueError(f"--recipe={path}: the key {name} is unknown; {hint}")
    if env in (None, settings.get("env.type", MANISKILL)):
        return flags
    shared = without_other_types({"env.type": MANISKILL, **settings}, {"env.type": env})
    return format_flags({name: value for name, value in shared.items() if name not in IN_MANISKILL})


def run(config: RecordConfig) -> None:
    """Print the scenes, or record and, if asked for, publish."""
    if config.list_scenes:
        print(describe_scenes())
        return
    from huggingface_hub import HfApi

    silence_libraries()
    if config.merge_shards:
        config.validate()
        check_shards(config)
        with writing("output_dir", config.root):
            merge_shards(config.merge_shards, config.root, config.dataset_id)
    else:
        record(config)
    if config.push_to_hub and not config.in_maniskill:
        with publishing(config.dataset_id, ONLY_PUBLISHES.format(root=config.root)):
            create_repo(HfApi(), config.dataset_id, config.private, "dataset")
            tags = [IMAGINED] if isinstance(config.env, WorldModelEnv) else []
            recording = open_dataset(config.root, config.dataset_id)
            recording.push_to_hub(private=config.private, tags=tags)
    elif config.push_to_hub:
        publish(HfApi(), config.root, config.dataset_id, config.private)


def check_shards(config: RecordConfig) -> None:
    """Raise FieldError unless the shards are in the ledger, if one is given: then it knows the whole too."""
    if config.budget is not None:
        with renamed("dataset.root", "merge_shards"):
            for shard in config.merge_shards:
                Ledger(config.budget).require_known(read_episodes(open_dataset(shard)))


def main() -> None:
    """Entry point of the console command."""
    run_command(run, RecordConfig, expand_recipes)


if __name__ == "__main__":
    main()

"""The stages of the demo: which command each one runs, as a user would type it."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from lerobot.utils.constants import PRETRAINED_MODEL_DIR

from lerobot_wmrl.common.checkpoints import LAST_CHECKPOINT, latest_checkpoint
from lerobot_wmrl.common.command_line import RunConfig
from lerobot_wmrl.common.constants import EVALUATION_SEED, KINDS
from lerobot_wmrl.common.errors import FieldError, require_at_least
from lerobot_wmrl.common.presets import Flags, format_flags, preset_flags
from lerobot_wmrl.demo.runner import Stage
from lerobot_wmrl.maniskill.recordings import recorded_episodes

SEED_STRIDE = 100_000
"""Demo seed s records and trains with seeds from s·SEED_STRIDE on, below EVALUATION_SEED."""

EXPLORATION_SEED = SEED_STRIDE // 2
"""Offset of the seeds with which the SFT policy gathers experience for the world models."""

ROLLOUT_SEED = EVALUATION_SEED + SEED_STRIDE
"""First seed of the rollouts replayed in the world model: neither trained on nor used for a success rate."""

EXPLORATION = 0.4
"""Largest noise on the SFT policy's actions while it gathers experience, as a share of the action box."""


@dataclass
class DemoConfig(RunConfig):
    """Run the whole loop on one task: record, train, SFT, reinforce in imagination, measure, report.

    Running the same command again continues after the last finished piece of work. `--preset=demo` (the
    default) takes 40 minutes on one core, `--preset=tiny` a few and shows only that everything runs; flags
    further right override the preset.

    Args:
        output_dir: folder of everything the demo makes; `report.html` is the page to read.
        seed: seed of recording, training and PPO. The evaluation seeds stay the same.
        stage_preset: `--preset` of each stage's command.
        sft_episodes: optimal planned episodes that the SFT policy is cloned from.
        explore_episodes: noisy rollouts of that policy, which the world models learn from beside the planned
            episodes.
        eval_episodes: held-out episodes behind each success rate.
        rollout_episodes: rollouts of each policy in ManiSkill that are replayed in the world model to measure
            false positives and recall.
    """

    output_dir: Path = Path("outputs/demo")
    seed: int = 0
    stage_preset: str = "demo"
    sft_episodes: int = 8
    explore_episodes: int = 300
    eval_episodes: int = 100
    rollout_episodes: int = 60

    def check(self) -> None:
        """Raise FieldError for a setting that cannot be."""
        preset_flags(self.stage_preset, "demo")
        last = EVALUATION_SEED // SEED_STRIDE - 1
        if not 0 <= self.seed <= last:
            raise FieldError(
                "seed", self.seed, f"must be from 0 to {last}, so that no evaluation seed is trained on"
            )
        require_at_least(self, 1, "sft_episodes", "explore_episodes", "eval_episodes", "rollout_episodes")


def demo_stages(config: DemoConfig) -> list[Stage]:
    """List every stage in order. Paths are relative to where the demo runs, so each line can be copied."""
    return [
        Stage("record", "Record planned trajectories in ManiSkill", partial(record, config)),
        Stage("sft", "Clone an SFT policy from a few optimal episodes", partial(train_sft, config)),
        Stage("explore", "Record noisy attempts of that policy", partial(explore, config)),
        Stage("merge", "Merge both recordings", partial(merge, config)),
        *(
            Stage(model, f"Train the {model.replace('_', ' ')}", partial(train_model, config, model))
            for model in ("frame_tokenizer", "action_world_model", "text_world_model")
        ),
        Stage(
            "replay_held_out",
            "Replay held-out recordings in it",
            partial(replay, config, "dataset", "held_out"),
        ),
        *measurements(config, "sft", "SFT policy"),
        Stage("rl", "Train it by PPO inside the world model", partial(reinforce, config)),
        *measurements(config, "rl", "PPO policy"),
    ]


def measurements(config: DemoConfig, policy: str, title: str) -> list[Stage]:
    """Measure a policy's success in ManiSkill and in imagination, and replay its ManiSkill episodes."""
    rollouts = f"rollouts_{policy}"
    return [
        Stage(f"eval_{policy}", f"Success of the {title} in ManiSkill", partial(evaluate, config, policy)),
        Stage(
            f"imagine_{policy}", f"Success of the {title} in imagination", partial(imagine, config, policy)
        ),
        Stage(rollouts, f"Record ManiSkill episodes of the {title}", partial(record_policy, config, policy)),
        Stage(
            f"replay_{policy}", "Replay those in the world model", partial(replay, config, rollouts, policy)
        ),
    ]


def checkpoint(folder: Path) -> Path:
    """Return the latest checkpoint of a training command that wrote to `folder`."""
    return folder / LAST_CHECKPOINT / PRETRAINED_MODEL_DIR


def first_seed(config: DemoConfig) -> int:
    return config.seed * SEED_STRIDE


def preset_command(config: DemoConfig, program: str, flags: Flags) -> list[str]:
    """Return a command of this package, at the demo's size."""
    return [program, f"--preset={config.stage_preset}", *format_flags(flags)]


def record(config: DemoConfig) -> list[str]:
    flags: Flags = {"output_dir": str(config.output_dir / "planned"), "seed": first_seed(config)}
    return preset_command(config, "lerobot-wmrl-record", flags)


def train_sft(config: DemoConfig) -> list[str]:
    dataset = config.output_dir / "planned"
    flags: Flags = {"policy.type": "cnn", "dataset.repo_id": "local/demo", "seed": first_seed(config)}
    return lerobot_train(
        config.output_dir / "sft",
        dataset,
        optimal_episodes(dataset, config.sft_episodes),
        [*preset_flags(config.stage_preset, "sft"), *format_flags(flags)],
    )


def optimal_episodes(root: Path, count: int) -> list[int]:
    """Return the first `count` successful episodes of the kind `optimal`, taken from the scenes in turn."""
    table = recorded_episodes(root)
    chosen = (table["kind"] == KINDS.index("optimal")) & table["success"]
    rank = np.zeros(len(chosen), dtype=np.int64)
    for scene in np.unique(table["scene"]):
        members = chosen & (table["scene"] == scene)
        rank[members] = np.arange(members.sum())
    order = sorted(np.flatnonzero(chosen), key=lambda row: (rank[row], table["scene"][row]))
    if len(order) < count:
        raise ValueError(
            f"{root} holds {len(order)} successful optimal episodes, {count} are needed: record more"
        )
    return sorted(int(table["episode"][row]) for row in order[:count])


def lerobot_train(folder: Path, dataset: Path, episodes: Sequence[int], flags: Sequence[str]) -> list[str]:
    """Return LeRobot's own training command, begun or continued.

    It continues by other flags, and refuses a folder without checkpoints, which is therefore removed. It
    points `last` at a checkpoint that is whole, but a kill can come between the two.
    """
    last = folder / LAST_CHECKPOINT
    newest = last if last.exists() else latest_checkpoint(folder)
    if newest is not None:
        trained = newest / PRETRAINED_MODEL_DIR / "train_config.json"
        return ["lerobot-train", *format_flags({"config_path": str(trained), "resume": True})]
    shutil.rmtree(folder, ignore_errors=True)
    files: Flags = {
        "policy.push_to_hub": False,
        "dataset.root": str(dataset),
        "dataset.episodes": f"[{','.join(map(str, episodes))}]",
        "output_dir": str(folder),
    }
    return ["lerobot-train", *flags, *format_flags(files)]


def explore(config: DemoConfig) -> list[str]:
    """Record noisy episodes of the SFT policy: the world models must see how it fails, not planners only."""
    seed = first_seed(config) + EXPLORATION_SEED
    command = roll_out(config, "sft", config.output_dir / "explored", config.explore_episodes, seed)
    return [*command, f"--exploration={EXPLORATION}"]


def roll_out(config: DemoConfig, policy: str, folder: Path, episodes: int, seed: int) -> list[str]:
    flags: Flags = {
        "policy.path": str(checkpoint(config.output_dir / policy)),
        "env.type": "wmrl_maniskill",
        "num_episodes": episodes,
        "output_dir": str(folder),
        "seed": seed,
    }
    return preset_command(config, "lerobot-wmrl-record", flags)


def merge(config: DemoConfig) -> list[str]:
    """Merge with LeRobot's own tool, which refuses what an interrupted call left; that is removed first."""
    target, names = config.output_dir / "dataset", ("planned", "explored")
    shutil.rmtree(target, ignore_errors=True)
    flags: Flags = {
        "new_repo_id": "local/dataset",
        "new_root": str(target),
        "operation.type": "merge",
        "operation.repo_ids": str([f"local/{name}" for name in names]),
        "operation.roots": str([str(config.output_dir / name) for name in names]),
        "operation.concatenate_videos": False,
        "operation.concatenate_data": False,
    }
    return ["lerobot-edit-dataset", *format_flags(flags)]


def train_model(config: DemoConfig, model: str) -> list[str]:
    out = config.output_dir
    flags: dict[str, str | int] = {"model.type": model, "dataset.root": str(out / "dataset")}
    if model != "frame_tokenizer":
        flags["model.tokenizer_path"] = str(checkpoint(out / "frame_tokenizer"))
    flags |= {"output_dir": str(out / model), "seed": first_seed(config)}
    return preset_command(config, "lerobot-wmrl-train-world-model", flags)


def imagination(config: DemoConfig) -> Flags:
    """Return the environment that the two world models make."""
    out = config.output_dir
    return {
        "env.type": "world_model",
        "env.world_model_path": str(checkpoint(out / "action_world_model")),
        "env.text_world_model_path": str(checkpoint(out / "text_world_model")),
        "env.dataset.root": str(out / "dataset"),
    }


def reinforce(config: DemoConfig) -> list[str]:
    """Train whatever the gate says of the SFT policy's rollouts; the report shows its warning."""
    out = config.output_dir
    flags: Flags = {
        "policy.path": str(checkpoint(out / "sft")),
        **imagination(config),
        "gate.dataset.root": str(out / "rollouts_sft"),
        "algorithm.type": "ppo",
        "output_dir": str(out / "rl"),
        "seed": first_seed(config),
    }
    return preset_command(config, "lerobot-wmrl-train", flags)


def evaluate(config: DemoConfig, policy: str) -> list[str]:
    """Evaluate in ManiSkill, on the same held-out starts for every policy and every demo seed."""
    return success_rate(config, policy, {}, preset="eval", folder=f"eval_{policy}")


def imagine(config: DemoConfig, policy: str) -> list[str]:
    """Evaluate with the same command inside the world model."""
    return success_rate(
        config, policy, imagination(config), preset="eval-imagined", folder=f"imagine_{policy}"
    )


def success_rate(config: DemoConfig, policy: str, env: Flags, preset: str, folder: str) -> list[str]:
    """Return LeRobot's own evaluation command."""
    flags: Flags = {
        "policy.path": str(checkpoint(config.output_dir / policy)),
        **env,
        "eval.n_episodes": config.eval_episodes,
        "seed": EVALUATION_SEED,
        "output_dir": str(config.output_dir / folder),
    }
    return ["lerobot-eval", *preset_flags(config.stage_preset, preset), *format_flags(flags)]


def record_policy(config: DemoConfig, policy: str) -> list[str]:
    """Record held-out episodes of a policy without exploration."""
    folder = config.output_dir / f"rollouts_{policy}"
    return roll_out(config, policy, folder, config.rollout_episodes, ROLLOUT_SEED)


def replay(config: DemoConfig, dataset: str, name: str) -> list[str]:
    """Replay recorded episodes in the world model; of the training data, those held out."""
    out = config.output_dir
    flags: Flags = {
        "model.path": str(checkpoint(out / "action_world_model")),
        "text_model.path": str(checkpoint(out / "text_world_model")),
        "dataset.root": str(out / dataset),
        "split": "validation" if dataset == "dataset" else "all",
        "output_dir": str(out / f"replay_{name}"),
    }
    return preset_command(config, "lerobot-wmrl-eval-world-model", flags)

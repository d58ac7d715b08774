"""The commands of an improvement, as a user would type them: one of each stage, and two to go on with."""

from collections.abc import Callable, Sequence
from functools import partial
from math import ceil
from pathlib import Path
from typing import Final

import numpy as np

from lerobot_wmrl.common.constants import EVALUATION_SEED, SELECTION_SEED
from lerobot_wmrl.common.errors import STOPPED
from lerobot_wmrl.common.lerobot_commands import edit_command, env_flags, merge_command, train_command
from lerobot_wmrl.common.presets import Flags, format_flags
from lerobot_wmrl.common.stages import Stage, never
from lerobot_wmrl.data.dataset import DatasetSource
from lerobot_wmrl.improve.configuration_improve import ROLLOUT_SEED_OFFSET
from lerobot_wmrl.improve.improvement import CLONED, MAX_STARTS, Improvement

SELECTIONS: Final = 4
"""Measurements of success in the real environment during RL at most, beside one before it."""

IMAGINED_STARTS: Final = 256
"""Imagined episodes of each policy that choose which one to improve, at most."""

MANISKILL_PROCESSES: Final = 2
"""Processes that simulate ManiSkill while policies are compared."""


def stages(improvement: Improvement) -> list[Stage]:
    """List every stage that this improvement needs, in order."""
    config = improvement.config

    def stage(
        name: str, title: str, command: Callable[[Improvement], list[str]], needed: bool = True,
        optional: Callable[[int], bool] = never, fresh: bool = False,
    ) -> list[Stage]:  # fmt: skip
        folder = improvement.out / name if fresh else None
        return [Stage(name, title, partial(command, improvement), optional, folder)] if needed else []

    def leaves_policies(status: int) -> bool:
        """Return whether RL stopped by a rule of its own, and there are policies to compare."""
        return status == STOPPED and (others() or config.distils)

    def others() -> bool:
        """Return whether there is a policy to compare with the one before."""
        return improvement.clones or improvement.rl_checkpoint.exists()

    records, clones = config.rollouts > 0, improvement.clones
    return [
        *stage("columns", "Leave out columns that rollouts lack", columns, bool(improvement.extra_columns),
               fresh=True),
        *stage("rollouts", "Record rollouts of the policy", rollouts, records),
        *stage("merged", "Merge the dataset with them", merged, records, fresh=True),
        *stage("cloned", "Train the policy further on the successes", cloned, clones, fresh=True),
        *stage("tokenizer", "Train the frame tokenizer", tokenizer),
        *stage("world_model", "Train the world model", world_model),
        *stage("check", "Check the world model on recorded episodes", check),
        *stage("start", "Choose in imagination which policy to improve", start, clones),
        *stage("rl", "Train the policy in imagination", rl, optional=leaves_policies),
        *stage("distilled", "Fit the policy to a planner in imagination", distilled, config.distils,
               optional=lambda status: others()),
        *stage("choice", "Choose the policy to use", choice, config.selects),
        *stage("comparison", "Compare the policies", comparison),
    ]  # fmt: skip


def columns(improvement: Improvement) -> list[str]:
    root = improvement.found.root
    names: Flags = {"operation.feature_names": improvement.extra_columns}
    command = edit_command(improvement.out / "columns", "remove_feature", names)
    return [*command, f"--repo_id=local/{root.name}", f"--root={root}"]


def rollouts(improvement: Improvement) -> list[str]:
    config = improvement.config
    like: Flags = {"like.root": str(improvement.mergeable), "max_frames": improvement.frame_limit}
    env = {name: value for name, value in real_env(improvement, "env").items() if name != "env.batched"}
    return ["lerobot-wmrl-record", *format_flags({
        "policy.path": improvement.policy, **env,
        **({} if improvement.in_maniskill else like),
        "video": "video" in improvement.found.columns.values(), "num_episodes": config.rollouts,
        "exploration": config.exploration, "seed": config.seed + ROLLOUT_SEED_OFFSET,
        "output_dir": str(improvement.out / "rollouts"),
    })]  # fmt: skip


def merged(improvement: Improvement) -> list[str]:
    parts = {"dataset": improvement.mergeable, "rollouts": improvement.out / "rollouts"}
    return merge_command(improvement.out / "merged", parts)


def cloned(improvement: Improvement) -> list[str]:
    policy, table = improvement.config.policy, improvement.table
    assert policy is not None
    successes = np.flatnonzero(table.success & table.among(improvement.data.episodes)).tolist()
    # LeRobot keeps loaded adapters, but writes no policy's configuration beside them without the flag
    adapters: Flags = {"peft.method_type": "LORA"} if policy.use_peft else {}
    return train_command(improvement.out / "cloned", [
        *format_flags(improvement.sizes.cloning_settings()),
        *format_flags({
            "policy.path": improvement.policy, "policy.push_to_hub": False, **adapters,
            "dataset.repo_id": f"local/{table.dataset.root.name}",
            "dataset.root": str(table.dataset.root), "dataset.episodes": successes,
            "seed": improvement.config.seed,
        }),
    ])  # fmt: skip


def tokenizer(improvement: Improvement) -> list[str]:
    return learn(improvement, "frame_tokenizer", "tokenizer", {
        "model.tokenizer.cameras": improvement.found.cameras,
        "model.tokenizer.image_size": improvement.sizes.side, "model.tokenizer.context": True,
        "model.tokenizer.success": True,
    })  # fmt: skip


def world_model(improvement: Improvement) -> list[str]:
    return learn(improvement, "action_world_model", "world_model", {
        "model.tokenizer_path": str(improvement.out / "tokenizer"),
        "model.clip_length": improvement.length + 2,
    })  # fmt: skip


def learn(improvement: Improvement, model: str, folder: str, flags: Flags) -> list[str]:
    """Return the command that trains a tokenizer or a world model."""
    return sized_command(improvement, "lerobot-wmrl-train-world-model", {
        "model.type": model, **flags, **improvement.data.flags(), "seed": improvement.config.seed,
        "output_dir": str(improvement.out / folder),
    })  # fmt: skip


def check(improvement: Improvement) -> list[str]:
    data, split = improvement.checked()
    # imagination that also begins in the middle of episodes reaches their ends
    length: Flags = {} if improvement.branches() else {"episode_length": improvement.length}
    return ["lerobot-wmrl-eval-world-model", *format_flags({
        "model.path": str(improvement.out / "world_model"), **data, "split": split, **length,
        **improvement.strict_criterion(), "max_episodes": 200, "output_dir": str(improvement.out / "check"),
    })]  # fmt: skip


def start(improvement: Improvement) -> list[str]:
    both = [improvement.policies[CLONED], improvement.policy]
    folder, seed = improvement.out / "start", improvement.config.seed
    return compare(improvement, folder, imagination(improvement), IMAGINED_STARTS, both, seed)


def rl(improvement: Improvement) -> list[str]:
    config = improvement.config
    real: Flags = {} if config.real_env is None else real_env(improvement, "real_env")
    given: Flags = {} if config.iterations is None else {"iterations": config.iterations}
    algorithm = {**config.algorithm, **given}
    if algorithm["algorithm.type"] == "ppo":
        algorithm = {**algorithm, "algorithm.gamma": improvement.discount}
        if config.policy is not None and config.policy.use_peft:  # the standard deviation is in no adapter
            algorithm = {**algorithm, "algorithm.initial_std": "null"}
    selection: Flags = {
        "selection.freq": ceil(improvement.sizes.iterations(algorithm) / SELECTIONS),
        "selection.n_episodes": improvement.rl_selection_episodes,
    }
    return train(improvement, "rl", improvement.policies[improvement.start()], {
        **real, "gate.action": "warn" if real else "off", "gate.freq": 0,
        "gate.n_episodes": min(50, config.eval_episodes),
        **(selection if config.selects else {}), **algorithm,
    })  # fmt: skip


def distilled(improvement: Improvement) -> list[str]:
    return train(improvement, "distilled", improvement.fitted(), {
        "gate.action": "off", "algorithm.type": "distillation", "algorithm.recorded": False,
    })  # fmt: skip


def train(improvement: Improvement, folder: str, policy: str, flags: Flags) -> list[str]:
    """Return the command that trains a policy in imagination."""
    fitting = improvement.sizes.rl_flags(flags, improvement.success_frames)
    return sized_command(improvement, "lerobot-wmrl-train", {
        "policy.path": policy, **imagination(improvement), **fitting, **flags,
        "seed": improvement.config.seed, "output_dir": str(improvement.out / folder),
    })  # fmt: skip


def choice(improvement: Improvement) -> list[str]:
    folder, starts = improvement.out / "choice", improvement.config.selection_episodes
    seed = SELECTION_SEED + improvement.rl_selection_episodes
    return compare(improvement, folder, real_env(improvement, "env"), starts, seed=seed)


def comparison(improvement: Improvement) -> list[str]:
    imagined = improvement.config.real_env is None
    env = imagination(improvement) if imagined else real_env(improvement, "env")
    return compare(improvement, improvement.out / "comparison", env, improvement.config.eval_episodes)


def compare(
    improvement: Improvement, folder: Path, env: Flags, starts: int, policies: Sequence[str] = (),
    seed: int = EVALUATION_SEED,
) -> list[str]:  # fmt: skip
    """Return the command that compares policies, by default all, each pair on the same starts."""
    imagined = env["env.type"] == "world_model"
    if imagined:  # none twice: there are at least as many as episodes
        starts = min(starts, improvement.fewest_starts())
        env = {**env, "env.dataset.max_starts": improvement.spread(starts)}
    at_once = 16 if imagined else MANISKILL_PROCESSES if improvement.in_maniskill else 1
    return ["lerobot-wmrl-compare", *format_flags({
        "policies": [*(policies or improvement.policies.values())], "against": "all", **env,
        "n_episodes": starts, "batch_size": min(at_once, starts), "stop_early": False, "seed": seed,
        "output_dir": str(folder),
    })]  # fmt: skip


def imagination(improvement: Improvement) -> Flags:
    """Return the environment that the world model makes."""
    return {
        "env.type": "world_model", "env.world_model_path": str(improvement.out / "world_model"),
        **{f"env.{name}": value for name, value in improvement.data.flags().items()},
        "env.dataset.max_starts": MAX_STARTS, "env.dataset.branches": improvement.branches(),
        "env.reward.type": "general", "env.reward.alpha": 1, "env.episode_length": improvement.length,
        **{f"env.{name}": value for name, value in improvement.criterion().items()},
    }  # fmt: skip


def real_env(improvement: Improvement, prefix: str) -> Flags:
    """Return the real environment's settings behind a prefix."""
    assert improvement.config.real_env is not None
    return env_flags(improvement.config.real_env, prefix)


def sized_command(improvement: Improvement, program: str, flags: Flags) -> list[str]:
    """Return a command that has the preset of the improvement's size."""
    return [program, f"--preset={improvement.config.preset}", *format_flags(flags)]


def drive(improvement: Improvement) -> list[str]:
    """Return the command that shows the world model in the browser."""
    real = {} if improvement.config.real_env is None else real_env(improvement, "real_env")
    return ["lerobot-wmrl-play", *format_flags({
        "world_model.path": str(improvement.out / "world_model"), **DatasetSource.flags(improvement.data),
        "policy.path": improvement.policies[improvement.chosen()], **real, **improvement.criterion(),
    })]  # fmt: skip


def another_round(improvement: Improvement) -> list[str] | None:
    """Return the command that records rollouts of the policy to use and improves it on all episodes; None if
    nothing was recorded."""
    config = improvement.config
    if not config.rollouts:
        return None
    given: Flags = {} if config.iterations is None else {"iterations": config.iterations}
    limit: Flags = {} if improvement.in_maniskill else {"max_frames": improvement.frame_limit}
    return ["lerobot-wmrl-improve", *format_flags({
        "policy.path": improvement.policies[improvement.chosen()], **improvement.data.flags(),
        **real_env(improvement, "real_env"), "rollouts": config.rollouts, "exploration": config.exploration,
        "size": config.preset, **given, **limit, "selection_episodes": config.selection_episodes,
        "eval_episodes": config.eval_episodes, "seed": config.seed + config.rollouts,
        "output_dir": f"{improvement.out}_again",
    })]  # fmt: skip

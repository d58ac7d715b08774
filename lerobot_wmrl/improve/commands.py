"""The commands of an improvement, as a user would type them: one for each stage, and two to go on with."""

from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import Final

import numpy as np

from lerobot_wmrl.common.flags import Flags, env_flags, program_call
from lerobot_wmrl.common.lerobot_commands import edit_command, merge_command, train_command
from lerobot_wmrl.common.seeds import EVALUATION_SEED, SELECTION_SEED
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.improve.configuration_improve import ROLLOUT_SEED_OFFSET
from lerobot_wmrl.improve.learnt import MAX_STARTS
from lerobot_wmrl.improve.plan import Plan
from lerobot_wmrl.improve.progress import CLONED, Progress
from lerobot_wmrl.improve.stage_names import StageName

SELECTIONS: Final = 4
"""Measurements of success in the real environment during RL at most, beside one before it."""

IMAGINED_STARTS: Final = 256
"""Imagined episodes of each policy that choose which one to improve, at most."""

MANISKILL_PROCESSES: Final = 2
"""Processes that simulate ManiSkill while policies are compared."""


def columns_command(progress: Progress) -> list[str]:
    """Return the command that leaves out the columns that rollouts lack."""
    plan, root = progress.plan, progress.plan.findings.root
    return edit_command(
        plan.folder(StageName.COLUMNS),
        "remove_feature",
        {
            "repo_id": f"local/{root.name}",
            "root": str(root),
            "operation.feature_names": plan.extra_columns,
        },
    )


def rollouts_command(progress: Progress) -> list[str]:
    """Return the command that records rollouts of the policy in the real environment."""
    plan, config = progress.plan, progress.plan.config
    like: Flags = {"like.root": str(plan.mergeable), "max_frames": plan.frame_limit}
    env = {name: value for name, value in real_env(plan, "env").items() if name != "env.batched"}
    return program_call(
        "lerobot-wmrl-record",
        {
            "policy.path": plan.policy,
            **env,
            **({} if plan.in_maniskill else like),
            "video": "video" in plan.findings.columns.values(),
            "num_episodes": config.rollouts,
            "exploration": config.exploration,
            "seed": config.seed + ROLLOUT_SEED_OFFSET,
            "output_dir": str(plan.folder(StageName.ROLLOUTS)),
        },
    )


def merged_command(progress: Progress) -> list[str]:
    """Return the command that merges the dataset with the rollouts."""
    plan = progress.plan
    parts = {"dataset": plan.mergeable, "rollouts": plan.folder(StageName.ROLLOUTS)}
    return merge_command(plan.folder(StageName.MERGED), parts)


def cloned_command(progress: Progress) -> list[str]:
    """Return the command that trains the policy further on the successful episodes."""
    plan = progress.plan
    policy, table = plan.config.policy, progress.learnt.table
    assert policy is not None
    successes = np.flatnonzero(table.success & table.among(plan.data.episodes)).tolist()
    # LeRobot keeps loaded adapters, but writes no policy's configuration beside them without the flag
    adapters: Flags = {"peft.method_type": "LORA"} if policy.use_peft else {}
    return train_command(
        plan.folder(StageName.CLONED),
        {
            **plan.sizes.cloning_settings(),
            "policy.path": plan.policy,
            "policy.push_to_hub": False,
            **adapters,
            "dataset.repo_id": f"local/{table.dataset.root.name}",
            "dataset.root": str(table.dataset.root),
            "dataset.episodes": successes,
            "seed": plan.config.seed,
        },
    )


def tokenizer_command(progress: Progress) -> list[str]:
    """Return the command that trains the frame tokenizer."""
    plan = progress.plan
    return model_command(
        plan,
        "frame_tokenizer",
        StageName.TOKENIZER,
        {
            "model.tokenizer.cameras": plan.findings.cameras,
            "model.tokenizer.image_size": plan.sizes.side,
            "model.tokenizer.context": True,
            "model.tokenizer.success": True,
        },
    )


def world_model_command(progress: Progress) -> list[str]:
    """Return the command that trains the action world model."""
    plan = progress.plan
    return model_command(
        plan,
        "action_world_model",
        StageName.WORLD_MODEL,
        {
            "model.tokenizer_path": str(plan.folder(StageName.TOKENIZER)),
            "model.clip_length": plan.length + 2,
        },
    )


def model_command(plan: Plan, model: str, stage: StageName, flags: Flags) -> list[str]:
    """Return the command that trains a tokenizer or a world model."""
    return sized_command(
        plan,
        "lerobot-wmrl-train-world-model",
        {
            "model.type": model,
            **flags,
            **plan.data.flags(),
            "seed": plan.config.seed,
            "output_dir": str(plan.folder(stage)),
        },
    )


def check_command(progress: Progress) -> list[str]:
    """Return the command that replays recorded episodes in the world model."""
    plan = progress.plan
    data, split = progress.learnt.checked()
    # imagination that also begins in the middle of episodes reaches their ends
    length: Flags = {} if progress.learnt.branches() else {"episode_length": plan.length}
    return program_call(
        "lerobot-wmrl-eval-world-model",
        {
            "model.path": str(plan.folder(StageName.WORLD_MODEL)),
            **data,
            "split": split,
            **length,
            **plan.strict_criterion(),
            "max_episodes": 200,
            "output_dir": str(plan.folder(StageName.CHECK)),
        },
    )


def start_command(progress: Progress) -> list[str]:
    """Return the command that compares the cloned policy with the one before, in imagination."""
    plan = progress.plan
    both = [progress.policies[CLONED], plan.policy]
    folder, seed = plan.folder(StageName.START), plan.config.seed
    return compare_command(progress, folder, imagination(progress), IMAGINED_STARTS, both, seed)


def rl_command(progress: Progress) -> list[str]:
    """Return the command that trains the better of the two in imagination."""
    plan, config = progress.plan, progress.plan.config
    real: Flags = {} if config.real_env is None else real_env(plan, "real_env")
    iterations: Flags = {} if config.iterations is None else {"iterations": config.iterations}
    algorithm = {**config.algorithm, **iterations}
    if algorithm["algorithm.type"] == "ppo":
        algorithm = {**algorithm, "algorithm.gamma": plan.discount}
        if config.policy is not None and config.policy.use_peft:  # the standard deviation is in no adapter
            algorithm = {**algorithm, "algorithm.initial_std": "null"}
    selection: Flags = {
        "selection.freq": ceil(plan.sizes.iterations(algorithm) / SELECTIONS),
        "selection.n_episodes": plan.rl_selection_episodes,
    }
    return train_policy_command(
        progress,
        StageName.RL,
        progress.policies[progress.start()],
        {
            **real,
            "gate.action": "warn" if real else "off",
            "gate.freq": 0,
            "gate.n_episodes": min(50, config.eval_episodes),
            **(selection if config.selects else {}),
            **algorithm,
        },
    )


def distilled_command(progress: Progress) -> list[str]:
    """Return the command that fits the policy to a planner in imagination."""
    return train_policy_command(
        progress,
        StageName.DISTILLED,
        progress.distillation_start(),
        {
            "gate.action": "off",
            "algorithm.type": "distillation",
            "algorithm.recorded": False,
        },
    )


def train_policy_command(progress: Progress, stage: StageName, policy: str, flags: Flags) -> list[str]:
    """Return the command that trains a policy in imagination."""
    plan = progress.plan
    fitting = plan.sizes.rl_flags(flags, progress.learnt.success_frames)
    return sized_command(
        plan,
        "lerobot-wmrl-train",
        {
            "policy.path": policy,
            **imagination(progress),
            **fitting,
            **flags,
            "seed": plan.config.seed,
            "output_dir": str(plan.folder(stage)),
        },
    )


def choice_command(progress: Progress) -> list[str]:
    """Return the command that compares all policies on starts for selection, to choose one."""
    plan = progress.plan
    folder, starts = plan.folder(StageName.CHOICE), plan.config.selection_episodes
    seed = SELECTION_SEED + plan.rl_selection_episodes
    return compare_command(progress, folder, real_env(plan, "env"), starts, seed=seed)


def comparison_command(progress: Progress) -> list[str]:
    """Return the command that compares all policies on starts for evaluation, to report them."""
    plan = progress.plan
    imagined = plan.config.real_env is None
    env = imagination(progress) if imagined else real_env(plan, "env")
    return compare_command(progress, plan.folder(StageName.COMPARISON), env, plan.config.eval_episodes)


def compare_command(
    progress: Progress,
    folder: Path,
    env: Flags,
    starts: int,
    policies: Sequence[str] = (),
    seed: int = EVALUATION_SEED,
) -> list[str]:
    """Return the command that compares policies, by default all, each pair on the same starts."""
    imagined = env["env.type"] == "world_model"
    if imagined:  # none twice: there are at least as many as episodes
        starts = min(starts, progress.learnt.fewest_starts())
        env = {**env, "env.dataset.max_starts": progress.learnt.evenly_chosen(starts)}
    at_once = 16 if imagined else MANISKILL_PROCESSES if progress.plan.in_maniskill else 1
    return program_call(
        "lerobot-wmrl-compare",
        {
            "policies": [*(policies or progress.policies.values())],
            "against": "all",
            **env,
            "n_episodes": starts,
            "batch_size": min(at_once, starts),
            "stop_early": False,
            "seed": seed,
            "output_dir": str(folder),
        },
    )


def imagination(progress: Progress) -> Flags:
    """Return the environment that the world model makes."""
    plan = progress.plan
    return {
        "env.type": "world_model",
        "env.world_model_path": str(plan.folder(StageName.WORLD_MODEL)),
        **{f"env.{name}": value for name, value in plan.data.flags().items()},
        "env.dataset.max_starts": MAX_STARTS,
        "env.dataset.branches": progress.learnt.branches(),
        "env.episode_length": plan.length,
        **{f"env.{name}": value for name, value in progress.criterion().items()},
    }


def real_env(plan: Plan, prefix: str) -> Flags:
    """Return the real environment's settings behind a prefix."""
    assert plan.config.real_env is not None
    return env_flags(plan.config.real_env, prefix)


def sized_command(plan: Plan, program: str, flags: Flags) -> list[str]:
    """Return a command that has the preset of the improvement's size."""
    return program_call(program, {"preset": plan.config.preset, **flags})


def drive_command(progress: Progress) -> list[str]:
    """Return the command that shows the world model and the policy to use in the browser; of several tasks it
    opens the first."""
    plan, env = progress.plan, progress.plan.config.real_env
    if isinstance(env, WmrlManiSkillEnv):
        env = replace(env, task=env.task_names[0])
    real = {} if env is None else env_flags(env, "real_env")
    return program_call(
        "lerobot-wmrl-play",
        {
            "world_model.path": str(plan.folder(StageName.WORLD_MODEL)),
            **plan.data.flags(),
            "policy.path": progress.policies[progress.chosen()],
            **real,
            **progress.criterion(),
        },
    )


def another_round_command(progress: Progress) -> list[str] | None:
    """Return the command that records rollouts of the policy to use and improves it on all episodes; None if
    nothing was recorded."""
    plan, config = progress.plan, progress.plan.config
    if not config.rollouts:
        return None
    iterations: Flags = {} if config.iterations is None else {"iterations": config.iterations}
    limit: Flags = {} if plan.in_maniskill else {"max_frames": plan.frame_limit}
    return program_call(
        "lerobot-wmrl-improve",
        {
            "policy.path": progress.policies[progress.chosen()],
            **plan.data.flags(),
            **real_env(plan, "real_env"),
            "rollouts": config.rollouts,
            "exploration": config.exploration,
            "size": config.preset,
            **iterations,
            **limit,
            "selection_episodes": config.selection_episodes,
            "eval_episodes": config.eval_episodes,
            "seed": config.seed + config.rollouts,
            "output_dir": f"{plan.out}_again",
        },
    )

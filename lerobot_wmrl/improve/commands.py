"""The commands of an improvement, as a user would type them: one of each stage, and two to go on with."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from math import ceil
from pathlib import Path
from typing import Final

import numpy as np

from lerobot_wmrl.common.errors import STOPPED
from lerobot_wmrl.common.flags import Flags, env_flags, format_flags, format_lerobot_flags
from lerobot_wmrl.common.lerobot_commands import edit_command, merge_command, train_command
from lerobot_wmrl.common.seeds import EVALUATION_SEED, SELECTION_SEED
from lerobot_wmrl.common.stages import Stage, never
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


def stages(progress: Progress) -> list[Stage]:
    """List every stage that this improvement needs, in order."""
    plan, config = progress.plan, progress.plan.config

    def stage[T](
        name: StageName, title: str, command: Callable[[T], list[str]], of: T, needed: bool = True,
        optional: Callable[[int], bool] = never, fresh: bool = False,
    ) -> list[Stage]:  # fmt: skip
        folder = plan.folder(name) if fresh else None
        return [Stage(name, title, partial(command, of), optional, folder)] if needed else []

    def leaves_policies(status: int) -> bool:
        """Return whether RL stopped by a rule of its own, and there are policies to compare."""
        return status == STOPPED and (can_compare() or config.distils)

    def can_compare() -> bool:
        """Return whether there is a policy to compare with the one before."""
        return plan.clones or plan.rl_checkpoint.exists()

    records, clones = config.rollouts > 0, plan.clones
    return [
        *stage(StageName.COLUMNS, "Leave out columns that rollouts lack", columns_command, plan,
               bool(plan.extra_columns), fresh=True),
        *stage(StageName.ROLLOUTS, "Record rollouts of the policy", rollouts_command, plan, records),
        *stage(StageName.MERGED, "Merge the dataset with them", merged_command, plan, records, fresh=True),
        *stage(StageName.CLONED, "Train the policy further on the successes", cloned_command, progress,
               clones, fresh=True),
        *stage(StageName.TOKENIZER, "Train the frame tokenizer", tokenizer_command, plan),
        *stage(StageName.WORLD_MODEL, "Train the world model", world_model_command, plan),
        *stage(StageName.CHECK, "Check the world model on recorded episodes", check_command, progress),
        *stage(StageName.START, "Choose in imagination which policy to improve", start_command, progress,
               clones),
        *stage(StageName.RL, "Train the policy in imagination", rl_command, progress,
               optional=leaves_policies),
        *stage(StageName.DISTILLED, "Fit the policy to a planner in imagination", distilled_command, progress,
               config.distils, optional=lambda status: can_compare()),
        *stage(StageName.CHOICE, "Choose the policy to use", choice_command, progress, config.selects),
        *stage(StageName.COMPARISON, "Compare the policies", comparison_command, progress),
    ]  # fmt: skip


def columns_command(plan: Plan) -> list[str]:
    """Return the command that leaves out the columns that rollouts lack."""
    root = plan.findings.root
    return edit_command(plan.folder(StageName.COLUMNS), "remove_feature", {
        "repo_id": f"local/{root.name}", "root": str(root), "operation.feature_names": plan.extra_columns,
    })  # fmt: skip


def rollouts_command(plan: Plan) -> list[str]:
    """Return the command that records rollouts of the policy in the real environment."""
    config = plan.config
    like: Flags = {"like.root": str(plan.mergeable), "max_frames": plan.frame_limit}
    env = {name: value for name, value in real_env(plan, "env").items() if name != "env.batched"}
    return ["lerobot-wmrl-record", *format_flags({
        "policy.path": plan.policy, **env,
        **({} if plan.in_maniskill else like),
        "video": "video" in plan.findings.columns.values(), "num_episodes": config.rollouts,
        "exploration": config.exploration, "seed": config.seed + ROLLOUT_SEED_OFFSET,
        "output_dir": str(plan.folder(StageName.ROLLOUTS)),
    })]  # fmt: skip


def merged_command(plan: Plan) -> list[str]:
    """Return the command that merges the dataset with the rollouts."""
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
    return train_command(plan.folder(StageName.CLONED), [
        *format_lerobot_flags(plan.sizes.cloning_settings()),
        *format_lerobot_flags({
            "policy.path": plan.policy, "policy.push_to_hub": False, **adapters,
            "dataset.repo_id": f"local/{table.dataset.root.name}",
            "dataset.root": str(table.dataset.root), "dataset.episodes": successes,
            "seed": plan.config.seed,
        }),
    ])  # fmt: skip


def tokenizer_command(plan: Plan) -> list[str]:
    """Return the command that trains the frame tokenizer."""
    return model_command(plan, "frame_tokenizer", StageName.TOKENIZER, {
        "model.tokenizer.cameras": plan.findings.cameras,
        "model.tokenizer.image_size": plan.sizes.side, "model.tokenizer.context": True,
        "model.tokenizer.success": True,
    })  # fmt: skip


def world_model_command(plan: Plan) -> list[str]:
    """Return the command that trains the action world model."""
    return model_command(plan, "action_world_model", StageName.WORLD_MODEL, {
        "model.tokenizer_path": str(plan.folder(StageName.TOKENIZER)),
        "model.clip_length": plan.length + 2,
    })  # fmt: skip


def model_command(plan: Plan, model: str, stage: StageName, flags: Flags) -> list[str]:
    """Return the command that trains a tokenizer or a world model."""
    return sized_command(plan, "lerobot-wmrl-train-world-model", {
        "model.type": model, **flags, **plan.data.flags(), "seed": plan.config.seed,
        "output_dir": str(plan.folder(stage)),
    })  # fmt: skip


def check_command(progress: Progress) -> list[str]:
    """Return the command that replays recorded episodes in the world model."""
    plan = progress.plan
    data, split = progress.learnt.checked()
    # imagination that also begins in the middle of episodes reaches their ends
    length: Flags = {} if progress.learnt.branches() else {"episode_length": plan.length}
    return ["lerobot-wmrl-eval-world-model", *format_flags({
        "model.path": str(plan.folder(StageName.WORLD_MODEL)), **data, "split": split, **length,
        **plan.strict_criterion(), "max_episodes": 200, "output_dir": str(plan.folder(StageName.CHECK)),
    })]  # fmt: skip


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
    return train_policy_command(progress, StageName.RL, progress.policies[progress.start()], {
        **real, "gate.action": "warn" if real else "off", "gate.freq": 0,
        "gate.n_episodes": min(50, config.eval_episodes),
        **(selection if config.selects else {}), **algorithm,
    })  # fmt: skip


def distilled_command(progress: Progress) -> list[str]:
    """Return the command that fits the policy to a planner in imagination."""
    return train_policy_command(progress, StageName.DISTILLED, progress.distillation_start(), {
        "gate.action": "off", "algorithm.type": "distillation", "algorithm.recorded": False,
    })  # fmt: skip


def train_policy_command(progress: Progress, stage: StageName, policy: str, flags: Flags) -> list[str]:
    """Return the command that trains a policy in imagination."""
    plan = progress.plan
    fitting = plan.sizes.rl_flags(flags, progress.learnt.success_frames)
    return sized_command(plan, "lerobot-wmrl-train", {
        "policy.path": policy, **imagination(progress), **fitting, **flags,
        "seed": plan.config.seed, "output_dir": str(plan.folder(stage)),
    })  # fmt: skip


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
    progress: Progress, folder: Path, env: Flags, starts: int, policies: Sequence[str] = (),
    seed: int = EVALUATION_SEED,
) -> list[str]:  # fmt: skip
    """Return the command that compares policies, by default all, each pair on the same starts."""
    imagined = env["env.type"] == "world_model"
    if imagined:  # none twice: there are at least as many as episodes
        starts = min(starts, progress.learnt.fewest_starts())
        env = {**env, "env.dataset.max_starts": progress.learnt.evenly_chosen(starts)}
    at_once = 16 if imagined else MANISKILL_PROCESSES if progress.plan.in_maniskill else 1
    return ["lerobot-wmrl-compare", *format_flags({
        "policies": [*(policies or progress.policies.values())], "against": "all", **env,
        "n_episodes": starts, "batch_size": min(at_once, starts), "stop_early": False, "seed": seed,
        "output_dir": str(folder),
    })]  # fmt: skip


def imagination(progress: Progress) -> Flags:
    """Return the environment that the world model makes."""
    plan = progress.plan
    return {
        "env.type": "world_model", "env.world_model_path": str(plan.folder(StageName.WORLD_MODEL)),
        **{f"env.{name}": value for name, value in plan.data.flags().items()},
        "env.dataset.max_starts": MAX_STARTS, "env.dataset.branches": progress.learnt.branches(),
        "env.reward.type": "general", "env.reward.alpha": 1, "env.episode_length": plan.length,
        **{f"env.{name}": value for name, value in progress.criterion().items()},
    }  # fmt: skip


def real_env(plan: Plan, prefix: str) -> Flags:
    """Return the real environment's settings behind a prefix."""
    assert plan.config.real_env is not None
    return env_flags(plan.config.real_env, prefix)


def sized_command(plan: Plan, program: str, flags: Flags) -> list[str]:
    """Return a command that has the preset of the improvement's size."""
    return [program, f"--preset={plan.config.preset}", *format_flags(flags)]


def drive_command(progress: Progress) -> list[str]:
    """Return the command that shows the world model and the policy to use in the browser; of several tasks it
    opens the first."""
    plan, env = progress.plan, progress.plan.config.real_env
    if isinstance(env, WmrlManiSkillEnv):
        env = replace(env, task=env.task_names[0])
    real = {} if env is None else env_flags(env, "real_env")
    return ["lerobot-wmrl-play", *format_flags({
        "world_model.path": str(plan.folder(StageName.WORLD_MODEL)), **plan.data.flags(),
        "policy.path": progress.policies[progress.chosen()], **real, **progress.criterion(),
    })]  # fmt: skip


def another_round_command(progress: Progress) -> list[str] | None:
    """Return the command that records rollouts of the policy to use and improves it on all episodes; None if
    nothing was recorded."""
    plan, config = progress.plan, progress.plan.config
    if not config.rollouts:
        return None
    iterations: Flags = {} if config.iterations is None else {"iterations": config.iterations}
    limit: Flags = {} if plan.in_maniskill else {"max_frames": plan.frame_limit}
    return ["lerobot-wmrl-improve", *format_flags({
        "policy.path": progress.policies[progress.chosen()], **plan.data.flags(),
        **real_env(plan, "real_env"), "rollouts": config.rollouts, "exploration": config.exploration,
        "size": config.preset, **iterations, **limit, "selection_episodes": config.selection_episodes,
        "eval_episodes": config.eval_episodes, "seed": config.seed + config.rollouts,
        "output_dir": f"{plan.out}_again",
    })]  # fmt: skip

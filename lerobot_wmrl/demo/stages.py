"""The stages of the demo: which command each one runs, as a user would type it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lerobot_wmrl.common.checkpoints import last_checkpoint
from lerobot_wmrl.common.command_line import RunConfig
from lerobot_wmrl.common.constants import EVALUATION_SEED
from lerobot_wmrl.common.errors import FieldError, require_at_least
from lerobot_wmrl.common.lerobot_commands import merge_command, train_command
from lerobot_wmrl.common.presets import Flags, format_flags, preset_flags
from lerobot_wmrl.common.stages import Stage
from lerobot_wmrl.maniskill.recordings import recorded_episodes

SEED_STRIDE = 100_000
"""Demo seed s records and trains with seeds from s·SEED_STRIDE on, below EVALUATION_SEED."""

ROLLOUT_SEED_OFFSET = SEED_STRIDE // 2
"""Offset of the seeds with which the cloned policy is rolled out."""

CHECKED_SEED = EVALUATION_SEED + SEED_STRIDE
"""First seed of the episodes replayed in the world model: neither trained on nor used for a success rate."""

EXPLORATION = 0.4
"""Largest noise on the cloned policy's actions in its rollouts, as a share of the action box."""

MEASURED = {
    "cloned": "cloned policy",
    "filtered": "policy cloned with successful rollouts",
    "rl": "PPO policy",
    "distilled": "PPO policy, then fitted to a planner",
}
"""Policies whose success is measured, in the order in which they are made."""

WHERE: dict[str, Flags] = {
    "known": {"env.split": "ind", "env.scenes": "[0,1,2]"},
    "unseen": {"env.split": "ood"},
}
"""Scenes in which success is measured."""


@dataclass
class DemoConfig(RunConfig):
    """Run the whole loop on one task, beside a rival without a world model on the same data.

    A few demonstrations, and labelled rollouts of the policy cloned from them, are all that is learnt from.
    Three policies come of them: one cloned again, from the demonstrations and the successful rollouts; that
    one improved by PPO in a world model that has learnt from all of them; and PPO's, fitted there to a
    planner (distillation). All are measured in ManiSkill on the same held-out starts, in known and in unseen
    scenes.

    Running the same command again continues after the last finished piece of work. `--preset=demo` (the
    default) takes about 40 minutes on two cores, `--preset=tiny` a few minutes and shows only that
    everything runs; flags further right override the preset.

    Args:
        output_dir: folder of everything the demo makes; `report.html` is the page to read.
        seed: seed of recording, training and PPO. The evaluation seeds stay the same.
        stage_preset: `--preset` of each stage's command.
        demonstrations: planned episodes with a human's pauses and detours that the first policy is cloned
            from.
        rollouts: noisy rollouts of that policy, labelled as successes and failures.
        eval_episodes: held-out episodes behind each success rate.
        checked_episodes: held-out rollouts of a policy that are replayed in the world model, to measure false
            positives and recall. Nothing learns from them.
    """

    output_dir: Path = Path("outputs/demo")
    seed: int = 0
    stage_preset: str = "demo"
    demonstrations: int = 8
    rollouts: int = 300
    eval_episodes: int = 100
    checked_episodes: int = 60

    def check(self) -> None:
        """Raise FieldError for a setting that cannot be."""
        preset_flags(self.stage_preset, "demo")
        last = EVALUATION_SEED // SEED_STRIDE - 1
        if not 0 <= self.seed <= last:
            raise FieldError(
                "seed", self.seed, f"must be from 0 to {last}, so that no evaluation seed is trained on"
            )
        require_at_least(self, 1, "demonstrations", "rollouts", "eval_episodes", "checked_episodes")


def demo_stages(config: DemoConfig) -> list[Stage]:
    """List every stage in order. Paths are relative to where the demo runs, so each line can be copied."""
    return [
        Stage("demonstrations", "Record demonstrations in ManiSkill", partial(record, config)),
        Stage("cloned", "Clone a policy from them", partial(clone, config)),
        Stage("rollouts", "Record noisy rollouts of that policy", partial(roll_out, config)),
        Stage("merge", "Merge demonstrations and rollouts", partial(merge, config)),
        Stage(
            "filtered", "Clone another one, with the successful rollouts", partial(clone_successes, config)
        ),
        *(
            Stage(model, f"Train the {model.replace('_', ' ')}", partial(train_model, config, model))
            for model in ("frame_tokenizer", "action_world_model", "text_world_model")
        ),
        Stage(
            "replay_held_out",
            "Replay held-out recordings in it",
            partial(replay, config, "dataset", "held_out"),
        ),
        *checks(config, "filtered"),
        Stage("rl", "Train that policy by PPO inside the world model", partial(reinforce, config)),
        Stage("distilled", "Fit it to a planner inside the world model", partial(distil, config)),
        *checks(config, "distilled"),
        *(
            Stage(
                f"eval_{where}_{policy}",
                f"Success of the {MEASURED[policy]} in ManiSkill, {where} scenes",
                partial(evaluate, config, policy, where),
            )
            for where in WHERE
            for policy in MEASURED
        ),
        *(
            Stage(
                f"imagine_{policy}",
                f"Success of the {title} in imagination",
                partial(imagine, config, policy),
            )
            for policy, title in MEASURED.items()
        ),
    ]


def checks(config: DemoConfig, policy: str) -> list[Stage]:
    """Record a policy's ManiSkill episodes and replay them in the world model."""
    title, folder = MEASURED[policy], f"checked_{policy}"
    return [
        Stage(folder, f"Record held-out episodes of the {title}", partial(record_checked, config, policy)),
        Stage(f"replay_{policy}", "Replay those in the world model", partial(replay, config, folder, policy)),
    ]


def first_seed(config: DemoConfig) -> int:
    return config.seed * SEED_STRIDE


def preset_command(config: DemoConfig, program: str, flags: Flags) -> list[str]:
    """Return a command of this package, at the demo's size."""
    return [program, f"--preset={config.stage_preset}", *format_flags(flags)]


def record(config: DemoConfig) -> list[str]:
    flags: Flags = {
        "kinds": "{human_like: 1}",
        "num_episodes": config.demonstrations,
        "video": False,
        "output_dir": str(config.output_dir / "demonstrations"),
        "seed": first_seed(config),
    }
    return preset_command(config, "lerobot-wmrl-record", flags)


def clone(config: DemoConfig) -> list[str]:
    dataset = config.output_dir / "demonstrations"
    return lerobot_train(config, "cloned", dataset, preset_flags(config.stage_preset, "sft"))


def clone_successes(config: DemoConfig) -> list[str]:
    """Clone from every success (filtered cloning): what can be had of the same data without a world model."""
    dataset = config.output_dir / "dataset"
    flags = preset_flags(config.stage_preset, "sft", ["filtered"])
    return lerobot_train(config, "filtered", dataset, [*flags, f"--dataset.episodes={successful(dataset)}"])


def successful(root: Path) -> str:
    """Return the successful episodes of a recording, `[0,3,4]`. ValueError if there are none."""
    table = recorded_episodes(root)
    if not table["success"].any():
        raise ValueError(f"{root}: no episode succeeds: record more with `--demonstrations`")
    return f"[{','.join(map(str, table['episode'][table['success']]))}]"


def lerobot_train(config: DemoConfig, name: str, dataset: Path, flags: Sequence[str]) -> list[str]:
    """Return LeRobot's own training command for the policy `cnn`."""
    files: Flags = {
        "policy.type": "cnn",
        "policy.push_to_hub": False,
        "dataset.repo_id": f"local/{dataset.name}",
        "dataset.root": str(dataset),
        "seed": first_seed(config),
    }
    return train_command(config.output_dir / name, [*flags, *format_flags(files)])


def roll_out(config: DemoConfig) -> list[str]:
    """Record noisy episodes of the cloned policy: what it does right and wrong is all that is learnt from."""
    command = record_policy(
        config, "cloned", "rollouts", config.rollouts, first_seed(config) + ROLLOUT_SEED_OFFSET
    )
    return [*command, f"--exploration={EXPLORATION}"]


def record_checked(config: DemoConfig, policy: str) -> list[str]:
    """Record held-out episodes of a policy without exploration."""
    return record_policy(config, policy, f"checked_{policy}", config.checked_episodes, CHECKED_SEED)


def record_policy(config: DemoConfig, policy: str, name: str, episodes: int, seed: int) -> list[str]:
    flags: Flags = {
        "policy.path": str(last_checkpoint(config.output_dir / policy)),
        "env.type": "wmrl_maniskill",
        "num_episodes": episodes,
        "video": False,
        "output_dir": str(config.output_dir / name),
        "seed": seed,
    }
    return preset_command(config, "lerobot-wmrl-record", flags)


def merge(config: DemoConfig) -> list[str]:
    """Merge with LeRobot's own tool."""
    out = config.output_dir
    return merge_command(out / "dataset", {name: out / name for name in ("demonstrations", "rollouts")})


def train_model(config: DemoConfig, model: str) -> list[str]:
    out = config.output_dir
    flags: dict[str, str | int] = {"model.type": model, "dataset.root": str(out / "dataset")}
    if model != "frame_tokenizer":
        flags["model.tokenizer_path"] = str(last_checkpoint(out / "frame_tokenizer"))
    flags |= {"output_dir": str(out / model), "seed": first_seed(config)}
    return preset_command(config, "lerobot-wmrl-train-world-model", flags)


def imagination(config: DemoConfig) -> Flags:
    """Return the environment that the action world model makes. Its reward is success: goal frames that the
    text world model learns from a few demonstrations are not good enough to be rewarded."""
    out = config.output_dir
    return {
        "env.type": "world_model",
        "env.world_model_path": str(last_checkpoint(out / "action_world_model")),
        "env.dataset.root": str(out / "dataset"),
        "env.reward.type": "general",
        "env.reward.alpha": 1,
    }


def reinforce(config: DemoConfig) -> list[str]:
    """Train even if the gate fails on the policy's rollouts; the report shows its warning."""
    out = config.output_dir
    flags: Flags = {
        "policy.path": str(last_checkpoint(out / "filtered")),
        **imagination(config),
        "gate.dataset.root": str(out / "checked_filtered"),
        "algorithm.type": "ppo",
        "algorithm.train_encoder": False,
        "output_dir": str(out / "rl"),
        "seed": first_seed(config),
    }
    return preset_command(config, "lerobot-wmrl-train", flags)


def distil(config: DemoConfig) -> list[str]:
    """Fit PPO's policy to a planner that searches from what it does, by labels from imagination alone."""
    flags: Flags = {
        "policy.path": str(last_checkpoint(config.output_dir / "rl")),
        **imagination(config),
        "gate.action": "off",
        "algorithm.type": "distillation",
        "algorithm.recorded": False,
        "output_dir": str(config.output_dir / "distilled"),
        "seed": first_seed(config),
    }
    return preset_command(config, "lerobot-wmrl-train", flags)


def evaluate(config: DemoConfig, policy: str, where: str) -> list[str]:
    """Evaluate in ManiSkill, on the same held-out starts for every policy and every demo seed."""
    return success_rate(config, policy, WHERE[where], preset="eval", folder=f"eval_{where}_{policy}")


def imagine(config: DemoConfig, policy: str) -> list[str]:
    """Evaluate with the same command inside the world model."""
    return success_rate(
        config, policy, imagination(config), preset="eval-imagined", folder=f"imagine_{policy}"
    )


def success_rate(config: DemoConfig, policy: str, env: Flags, preset: str, folder: str) -> list[str]:
    """Return LeRobot's own evaluation command."""
    flags: Flags = {
        "policy.path": str(last_checkpoint(config.output_dir / policy)),
        **env,
        "eval.n_episodes": config.eval_episodes,
        "seed": EVALUATION_SEED,
        "output_dir": str(config.output_dir / folder),
    }
    return ["lerobot-eval", *preset_flags(config.stage_preset, preset), *format_flags(flags)]


def replay(config: DemoConfig, dataset: str, name: str) -> list[str]:
    """Replay recorded episodes in the world model; of the training data, those held out."""
    out = config.output_dir
    flags: Flags = {
        "model.path": str(last_checkpoint(out / "action_world_model")),
        "text_model.path": str(last_checkpoint(out / "text_world_model")),
        "dataset.root": str(out / dataset),
        "split": "validation" if dataset == "dataset" else "all",
        "output_dir": str(out / f"replay_{name}"),
    }
    return preset_command(config, "lerobot-wmrl-eval-world-model", flags)


def drive(config: DemoConfig) -> list[str]:
    """Return the command that shows the world model in the browser, beside ManiSkill."""
    out = config.output_dir
    flags: Flags = {
        "world_model.path": str(out / "action_world_model"),
        "dataset.root": str(out / "dataset"),
        "policy.path": str(out / "distilled"),
        "real_env.type": "wmrl_maniskill",
    }
    criterion = preset_flags(config.stage_preset, "eval-world-model")
    done = [flag for flag in criterion if flag.startswith("--done_")]
    return ["lerobot-wmrl-play", *format_flags(flags), *done]

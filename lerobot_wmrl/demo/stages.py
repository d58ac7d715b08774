"""The stages of the demo: which command each one runs, as a user would type it."""

import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lerobot_wmrl.constants import EVALUATION_SEED
from lerobot_wmrl.demo.episodes import optimal_episodes
from lerobot_wmrl.presets import Flags, format_flags, preset_flags

SEED_STRIDE = 100_000
"""Demo seed s records and trains with seeds from s·SEED_STRIDE on, below EVALUATION_SEED."""

ROLLOUT_SEED = EVALUATION_SEED + SEED_STRIDE
"""First seed of the rollouts replayed in the world model: neither trained on nor used for a success rate."""


@dataclass
class DemoConfig:
    """The whole loop on one task: record, train, clone, improve, measure, report.

    Running the same command again continues after the last finished piece of work.

    Args:
        output_dir: folder of everything the demo makes.
        seed: of recording, training and PPO; the evaluation seeds stay the same.
        stage_preset: the --preset that each stage's command gets.
        sft_episodes: optimal episodes the first policy is cloned from.
        eval_episodes: held-out episodes of each success rate.
        rollout_episodes: real episodes of each policy that are replayed in the world model.
    """

    output_dir: Path = Path("outputs/demo")
    seed: int = 0
    stage_preset: str = "demo"
    sft_episodes: int = 12
    eval_episodes: int = 100
    rollout_episodes: int = 60

    def check(self) -> None:
        """ValueError names a setting that cannot be."""
        last = EVALUATION_SEED // SEED_STRIDE - 1
        if not 0 <= self.seed <= last:
            raise ValueError(
                f"--seed={self.seed}: must be from 0 to {last}, so that no evaluation seed is trained on"
            )
        for name in ("sft_episodes", "eval_episodes", "rollout_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name}={getattr(self, name)}: must be at least 1")


@dataclass(frozen=True)
class Stage:
    """One command, made when the stage starts, because some flags depend on what earlier stages left."""

    name: str
    title: str
    command: Callable[[], list[str]]


def demo_stages(config: DemoConfig) -> list[Stage]:
    """Every stage in order. Paths are relative to where the demo runs, so that each line can be copied."""
    return [
        Stage("record", "Record trajectories in ManiSkill", partial(record, config)),
        *(
            Stage(model, f"Train the {model.replace('_', ' ')}", partial(train_model, config, model))
            for model in ("frame_tokenizer", "action_world_model", "text_world_model")
        ),
        Stage(
            "replay_held_out",
            "Replay held-out recordings in it",
            partial(replay, config, "dataset", "held_out"),
        ),
        Stage("sft", "Clone a policy from a few optimal episodes", partial(clone, config)),
        *measurements(config, "sft", "cloned policy"),
        Stage("rl", "Improve it by PPO inside the world model", partial(reinforce, config)),
        *measurements(config, "rl", "PPO policy"),
    ]


def measurements(config: DemoConfig, policy: str, title: str) -> list[Stage]:
    """For a policy: its real and its imagined success, and its real episodes replayed in the world model."""
    rollouts = f"rollouts_{policy}"
    return [
        Stage(f"eval_{policy}", f"Success of the {title} in ManiSkill", partial(evaluate, config, policy)),
        Stage(
            f"imagine_{policy}", f"Success of the {title} in imagination", partial(imagine, config, policy)
        ),
        Stage(rollouts, f"Record real episodes of the {title}", partial(record_policy, config, policy)),
        Stage(
            f"replay_{policy}", "Replay those in the world model", partial(replay, config, rollouts, policy)
        ),
    ]


def checkpoint(folder: Path) -> Path:
    """The latest checkpoint of a training command that wrote to `folder`."""
    return folder / "checkpoints" / "last" / "pretrained_model"


def first_seed(config: DemoConfig) -> int:
    return config.seed * SEED_STRIDE


def ours(config: DemoConfig, program: str, flags: Flags) -> list[str]:
    """A command of this package, at the demo's size."""
    return [program, f"--preset={config.stage_preset}", *format_flags(flags)]


def record(config: DemoConfig) -> list[str]:
    flags: Flags = {"output_dir": str(config.output_dir / "dataset"), "seed": first_seed(config)}
    return ours(config, "lerobot-wmrl-record", flags)


def train_model(config: DemoConfig, model: str) -> list[str]:
    out = config.output_dir
    flags: dict[str, str | int] = {"model.type": model, "dataset.root": str(out / "dataset")}
    if model != "frame_tokenizer":
        flags["model.tokenizer_path"] = str(checkpoint(out / "frame_tokenizer"))
    return ours(
        config,
        "lerobot-wmrl-train-world-model",
        {**flags, "output_dir": str(out / model), "seed": first_seed(config)},
    )


def clone(config: DemoConfig) -> list[str]:
    """LeRobot's own training. It continues by other flags, and refuses a folder without checkpoints."""
    folder, dataset = config.output_dir / "sft", config.output_dir / "dataset"
    if (folder / "checkpoints" / "last").exists():
        resume: Flags = {"config_path": str(checkpoint(folder) / "train_config.json"), "resume": True}
        return ["lerobot-train", *format_flags(resume)]
    shutil.rmtree(folder, ignore_errors=True)
    episodes = ",".join(str(episode) for episode in optimal_episodes(dataset, config.sft_episodes))
    flags: Flags = {
        "policy.type": "cnn",
        "policy.push_to_hub": False,
        "dataset.repo_id": "local/demo",
        "dataset.root": str(dataset),
        "dataset.episodes": f"[{episodes}]",
        "output_dir": str(folder),
        "seed": first_seed(config),
    }
    return ["lerobot-train", *preset_flags(config.stage_preset, "sft"), *format_flags(flags)]


def imagination(config: DemoConfig) -> Flags:
    """The environment that the two world models make."""
    out = config.output_dir
    return {
        "env.type": "world_model",
        "env.world_model_path": str(checkpoint(out / "action_world_model")),
        "env.text_world_model_path": str(checkpoint(out / "text_world_model")),
        "env.dataset.root": str(out / "dataset"),
    }


def reinforce(config: DemoConfig) -> list[str]:
    out = config.output_dir
    flags = {"policy.path": str(checkpoint(out / "sft")), **imagination(config), "algorithm.type": "ppo"}
    return ours(
        config, "lerobot-wmrl-train", {**flags, "output_dir": str(out / "rl"), "seed": first_seed(config)}
    )


def evaluate(config: DemoConfig, policy: str) -> list[str]:
    """LeRobot's own evaluation, on the same held-out starts for every policy and every demo seed."""
    real = {"env.type": "wmrl_maniskill", "env.task": "push", "env.split": "ind"}
    return success_rate(config, policy, real, preset="eval", folder=f"eval_{policy}")


def imagine(config: DemoConfig, policy: str) -> list[str]:
    """The same command inside the world model."""
    return success_rate(
        config, policy, imagination(config), preset="eval-imagined", folder=f"imagine_{policy}"
    )


def success_rate(config: DemoConfig, policy: str, env: Flags, preset: str, folder: str) -> list[str]:
    flags: Flags = {
        "policy.path": str(checkpoint(config.output_dir / policy)),
        **env,
        "eval.n_episodes": config.eval_episodes,
        "seed": EVALUATION_SEED,
        "output_dir": str(config.output_dir / folder),
    }
    return ["lerobot-eval", *preset_flags(config.stage_preset, preset), *format_flags(flags)]


def record_policy(config: DemoConfig, policy: str) -> list[str]:
    flags: Flags = {
        "policy.path": str(checkpoint(config.output_dir / policy)),
        "env.type": "wmrl_maniskill",
        "num_episodes": config.rollout_episodes,
        "output_dir": str(config.output_dir / f"rollouts_{policy}"),
        "seed": ROLLOUT_SEED,
    }
    return ours(config, "lerobot-wmrl-record", flags)


def replay(config: DemoConfig, dataset: str, name: str) -> list[str]:
    """Imagine real episodes from their first frame and actions; of the training data, those held out."""
    out = config.output_dir
    flags: Flags = {
        "model.path": str(checkpoint(out / "action_world_model")),
        "text_model.path": str(checkpoint(out / "text_world_model")),
        "dataset.root": str(out / dataset),
        "split": "validation" if dataset == "dataset" else "all",
        "output_dir": str(out / f"replay_{name}"),
    }
    return ours(config, "lerobot-wmrl-eval-world-model", flags)


def executable(command: list[str]) -> list[str]:
    """The command by its path beside this interpreter: the shell may not have activated the environment."""
    return [str(Path(sys.executable).parent / command[0]), *command[1:]]

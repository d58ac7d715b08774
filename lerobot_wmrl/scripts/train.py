"""lerobot-wmrl-train: train a policy further by reinforcement learning, in a world model or any environment.

    lerobot-wmrl-train --policy.path=outputs/sft --env.type=world_model --env.world_model_path=W \\
        --env.text_world_model_path=X --env.dataset.root=D --gate.dataset.root=ROLLOUTS --output_dir=rl
    lerobot-wmrl-train --policy.path=outputs/sft --env.type=wmrl_maniskill --num_envs=2 --output_dir=rl

Before the first update the gate measures the world model's false positive rate: how many failures it predicts
as successes. It needs labelled rollouts (`--gate.dataset.root=ROLLOUTS`) or an environment to record some
in (`--real_env.type=wmrl_maniskill …`). Above `--gate.limit` the training stops.
`--selection.freq=5` measures success every five iterations, in `--real_env` if it is set, and keeps the best
checkpoint as `checkpoints/best`.
`--dyna.rounds=2` trains the world model further, twice, on new rollouts of the current policy.
`--policy.push_to_hub=true --policy.repo_id=USER/NAME` publishes the best checkpoint, or the last one without
selection.

Running the same command again continues from the last checkpoint. `--preset=demo` sets the sizes.
`lerobot-eval --policy.path=outputs/rl/checkpoints/best/pretrained_model …` evaluates the result.
"""

import logging
import shlex
import shutil
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Final

import draccus
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.default import PeftConfig, WandBConfig
from lerobot.envs.configs import EnvConfig
from lerobot.rl.algorithms.configs import RLAlgorithmConfig
from lerobot.utils.constants import PRETRAINED_MODEL_DIR

from lerobot_wmrl.common.checkpoints import best_checkpoint, last_checkpoint
from lerobot_wmrl.common.command_line import RunConfig, claim_output_dir, run_command
from lerobot_wmrl.common.constants import EVALUATION_SEED
from lerobot_wmrl.common.distributed import LONGEST_WAIT, is_first_process, rank_and_size, wait_for_all
from lerobot_wmrl.common.errors import FieldError, require_at_least, within
from lerobot_wmrl.common.precision import keep_freed_memory
from lerobot_wmrl.common.presets import expand_preset, format_flags
from lerobot_wmrl.common.tracking import make_wandb
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.rl.configuration_algorithms import PolicyGradientConfig, PPOConfig
from lerobot_wmrl.rl.configuration_callbacks import CallbackSettings
from lerobot_wmrl.rl.configuration_distillation import DistillationConfig
from lerobot_wmrl.rl.configuration_grpo import GRPOConfig

PUBLISHING = ("push_to_hub", "repo_id", "private", "license", "tags")
"""Settings of the policy that only matter when it is published."""

MAY_DIFFER = (
    "resume", "job_name", "log_freq", "wandb", "gate.action", "dyna.dataset",
    *(f"policy.{name}" for name in PUBLISHING),
)  # fmt: skip
"""Settings that may change when a run is resumed."""


PATHS: Final = ("path", "root", "frames", "assets")
"""Ends of the names of settings that may be folders or files of this machine."""

UNPUBLISHED: Final = "FOLDER"
"""On a card, what stands for a folder of the machine on which the policy was trained."""

CARD: Final = """---
{metadata}
---

# {name}

A `{type}` policy of LeRobot, trained further by reinforcement learning with lerobot-wmrl-train:

{description}

It began as {start}. `train_config.json` has all settings. Evaluate it (FOLDER: what is not published):

```
{command}
```
"""


@dataclass
class TrainConfig(CallbackSettings, RunConfig):
    """Train a policy further by reinforcement learning.

    `--preset=tiny|demo|cpu` stands for the flags of that size; flags further right override it.

    Args:
        policy: the SFT policy to improve, `--policy.path=FOLDER`: a checkpoint, or the output folder of
            lerobot-train. PPO and GRPO train `cnn`, `act` and `openvla`; distillation trains any policy that
            lerobot-train can clone.
        env: `--env.type=world_model`, `wmrl_maniskill` or one of LeRobot's, and its settings.
        algorithm: `--algorithm.type=ppo`, `grpo` or `distillation`, and its settings.
        peft: `--peft.method_type=LORA --peft.r=32`, as in lerobot-train, trains new adapters and the value
            function alone. A policy that has adapters already needs none of these flags.
        output_dir: folder of checkpoints and metrics. If it holds this run already, the run continues.
        num_envs: environments stepped together, in each process of `torchrun`.
        rollout_steps: steps of each environment in a rollout; by default the longest episode.
        iterations: number of rollouts, each followed by an update.
        save_freq: iterations between checkpoints.
        log_freq: iterations between lines in the terminal.
        seed: seed of sampling and of the episodes, below 1,000,000. Seeds from there on are for evaluation.
        resume: require a checkpoint in `output_dir` and continue from it, as in lerobot-train. Works with
            `--config_path=outputs/rl/train_config.json` in place of all other flags too. Without this flag
            the same command begins or continues.
        wandb: `--wandb.enable=true` sends the metrics to Weights & Biases too, as lerobot-train does.
        job_name: name of the run in Weights & Biases.
        budget: ledger of the real episodes that a method may learn from, a JSON file (docs/protocol.md). It
            must know the episodes of all datasets. Recordings in `real_env` are entered, and so are the steps
            of a training outside a world model, as rollouts. Selection in `real_env` is refused.
        real_env: any environment of LeRobot's, for selection, gate and Dyna: `--real_env.type=…` and its
            settings.
        real_num_envs: environments that run at once in `real_env`.
        selection: choice of the checkpoint that is kept as `checkpoints/best`; off by default.
        gate: check of the world model's false positive rate.
        dyna: rounds that train the world model further on new rollouts of the current policy; off by default.
    """

    path_fields: ClassVar[list[str]] = ["policy"]
    other_names: ClassVar[dict[str, str]] = {"steps": "iterations", "batch_size": "num_envs"}
    dataset: ClassVar[None] = None
    is_reward_model_training: ClassVar[bool] = False

    policy: PreTrainedConfig | None = None
    env: EnvConfig | None = None
    algorithm: RLAlgorithmConfig = field(default_factory=PPOConfig)
    peft: PeftConfig | None = None
    output_dir: Path = Path("outputs/rl")
    num_envs: int = 64
    rollout_steps: int | None = None
    iterations: int = 40
    save_freq: int = 5
    log_freq: int = 1
    seed: int = 0
    resume: bool = False
    wandb: WandBConfig = field(default_factory=WandBConfig)
    job_name: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration as the dictionary that LeRobot's WandBLogger asks for."""
        return draccus.encode(self)


def check_config(cfg: TrainConfig) -> None:
    """Raise FieldError for the first setting that is impossible."""
    if not isinstance(cfg.algorithm, PolicyGradientConfig | DistillationConfig):
        raise FieldError(
            "algorithm.type", cfg.algorithm.type, "this command trains with ppo, grpo or distillation"
        )
    if cfg.env is None:
        raise FieldError("env.type", None, "is missing", "choose world_model, or another environment")
    require_at_least(cfg, 1, "num_envs", "iterations", "save_freq", "log_freq")
    if isinstance(cfg.algorithm, PPOConfig) and cfg.algorithm.value_iterations >= cfg.iterations:
        logging.warning(
            "iterations=%d: the policy stays as it is, because the value function alone learns in the first "
            "%d (algorithm.value_iterations)", cfg.iterations, cfg.algorithm.value_iterations,
        )  # fmt: skip
    if isinstance(cfg.algorithm, GRPOConfig):
        cfg.algorithm.check_num_envs(cfg.num_envs)
    if isinstance(cfg.algorithm, DistillationConfig):
        check_distillation(cfg.algorithm, cfg.env)
    if not 0 <= cfg.seed < EVALUATION_SEED:
        raise FieldError(
            "seed", cfg.seed, f"must be from 0 to {EVALUATION_SEED - 1}; those above are for evaluation"
        )
    cfg.check_callbacks(cfg.env, cfg.iterations)


def check_distillation(algorithm: DistillationConfig, env: EnvConfig) -> None:
    """Raise FieldError unless the planner can look ahead in the environment."""
    if not isinstance(env, WorldModelEnv):
        raise FieldError(
            "algorithm.type", "distillation",
            f"its planner looks ahead in a world model, and `env.type` is {env.type}",
            "set `env.type` to world_model, or choose ppo or grpo",
        )  # fmt: skip
    if env.done_frames > algorithm.planner.horizon:
        raise FieldError(
            "algorithm.planner.horizon", algorithm.planner.horizon,
            f"must be at least `env.done_frames`, {env.done_frames}",
        )  # fmt: skip


def check_tasks(cfg: TrainConfig, env: Any) -> None:
    """Raise FieldError if a task has no environment, or if GRPO finds no two episodes from the same start."""
    tasks, grpo = getattr(env, "tasks", 1), isinstance(cfg.algorithm, GRPOConfig)
    if grpo and tasks > 1:
        raise FieldError(
            "algorithm.type", cfg.algorithm.type,
            f"compares episodes from the same start, and the environment has {tasks} tasks",
            "choose one task, or ppo",
        )  # fmt: skip
    if grpo and hasattr(env, "repeats_starts") and not env.repeats_starts():
        raise FieldError(
            "algorithm.type", cfg.algorithm.type,
            "compares episodes from the same start, and in this environment a seed does not decide it",
            "choose ppo",
        )  # fmt: skip
    if tasks > env.num_envs:
        raise FieldError(
            "num_envs", env.num_envs, f"the environment has {tasks} tasks, and each needs one of its own",
            f"set it to a multiple of {tasks}, or choose fewer tasks",
        )  # fmt: skip


def rollout_length(cfg: TrainConfig, longest: int) -> int:
    """Return the number of steps of a rollout. FieldError if the longest episodes do not fit in it."""
    steps = cfg.rollout_steps or longest
    if steps < longest:
        raise FieldError(
            "rollout_steps", steps,
            f"episodes last up to {longest} steps and every rollout starts new ones, so their ends would "
            "never be trained on", "raise it, or lower `env.episode_length`",
        )  # fmt: skip
    return steps


def load_config(cfg: TrainConfig) -> PreTrainedConfig:
    """Read the policy's configuration into `cfg` and return it.

    Whether and where the policy is published comes from the command line or a resumed run's configuration.
    The checkpoint's own settings are ignored, because they would overwrite the SFT policy on the hub.
    """
    from lerobot_wmrl.common.policies import read_policy_config

    path = parser.get_path_arg("policy") or (cfg.policy and cfg.policy.pretrained_path)
    if not path:
        raise ValueError("--policy.path: give the checkpoint of the policy to train")
    stored = cfg.policy
    typed = parser.get_cli_overrides("policy") or []
    cfg.policy = read_policy_config(str(path), ["--push_to_hub=false", "--repo_id=null", *typed])
    if stored is not None:
        for name in PUBLISHING:
            setattr(cfg.policy, name, getattr(stored, name))
    if cfg.policy.push_to_hub and not cfg.policy.repo_id:
        raise FieldError("policy.push_to_hub", True, "give its name on the hub, --policy.repo_id=user/name")
    if cfg.policy.push_to_hub:
        require_published_base(cfg, cfg.policy)
    return cfg.policy


def require_published_base(cfg: TrainConfig, policy: PreTrainedConfig) -> None:
    """Raise FieldError if adapters are to be published and what they adapt is a folder of this machine."""
    from lerobot_wmrl.common.policies import adapter_config

    base = policy.pretrained_path if cfg.peft is not None else None
    if policy.use_peft:
        base = adapter_config(policy).base_model_name_or_path
    if base is not None and Path(base).exists():
        raise FieldError(
            "policy.push_to_hub", True, f"the adapters belong to the policy in {base}, which nobody else has",
            "publish that one, and give its name on the hub: with new adapters as `policy.path`, else in "
            "adapter_config.json, base_model_name_or_path",
        )  # fmt: skip


def train_policy(cfg: TrainConfig) -> None:
    """Load the policy, build the environment, train, publish, and say what was made."""
    from accelerate import PartialState
    from lerobot.utils.random_utils import set_seed

    from lerobot_wmrl.common.policies import load_policy, load_processors, require_past_observations
    from lerobot_wmrl.envs.lerobot_env import make_tensor_env
    from lerobot_wmrl.rl.budget import check_data

    check_config(cfg)
    check_data(cfg, cfg.env)
    config = load_config(cfg)
    if isinstance(cfg.algorithm, DistillationConfig):
        require_past_observations(config)
    PartialState(cpu=config.device == "cpu", timeout=LONGEST_WAIT)
    done = finished(cfg)
    wait_for_all()  # no process has written anything before all have looked
    if done:
        claim_output_dir(cfg.output_dir, draccus.encode(cfg), MAY_DIFFER)
        print(f"{cfg.output_dir}: already trained for {cfg.iterations} iterations")
    else:
        set_seed(cfg.seed)
        policy, processors = load_policy(config), load_processors(config)
        settings = draccus.encode(cfg)  # an environment of the hub tells its configuration of its actions
        with within("env"):
            env: Any = make_tensor_env(cfg.env, cfg.num_envs, config.device or "cpu")
        try:
            train_in(env, cfg, settings, policy, processors)
        finally:
            env.close()
    if is_first_process():
        lines = summary(cfg)
        print("\n".join(lines))
        publish(cfg, lines)


def finished(cfg: TrainConfig) -> bool:
    """Return whether the run has reached its last iteration. FieldError if there is nothing to resume."""
    from lerobot_wmrl.common.checkpoints import latest_checkpoint, require_resumable
    from lerobot_wmrl.rl.callbacks import has_record
    from lerobot_wmrl.rl.selection import Selection

    last = latest_checkpoint(cfg.output_dir)
    if cfg.resume:
        require_resumable(cfg.output_dir)
    if last is None or int(last.name) < cfg.iterations:
        return False
    return not cfg.selection.freq or has_record(
        cfg.output_dir, Selection.name, cfg.iterations, cfg.iterations
    )


def train_in(
    env: Any,
    cfg: TrainConfig,
    settings: dict[str, Any],
    policy: Any,
    processors: tuple[Any, Any],
) -> None:
    """Check that policy and environment fit, then train. `settings` are the configuration's, as JSON."""
    from lerobot_wmrl.common.policies import adopt_features, check_fit, check_units, with_new_adapters
    from lerobot_wmrl.envs.lerobot_env import check_real_env, shapes_of
    from lerobot_wmrl.rl.budget import charge_steps
    from lerobot_wmrl.rl.make_callbacks import Trained, make_callbacks
    from lerobot_wmrl.rl.policy_adapters import make_pipeline
    from lerobot_wmrl.rl.rollout import RolloutBuffer
    from lerobot_wmrl.rl.trainer import Schedule, make_algorithm, train

    check_tasks(cfg, env)
    config = policy.config
    observation = env.reset(seed=cfg.seed)[0]
    shown = shapes_of(observation)
    adopt_features(config, shown)
    check_fit(config, shown, env.single_action_space.shape[-1])
    if isinstance(cfg.env, WorldModelEnv):
        names = env.model.config.embodiment.action_names
        check_units(config, processors[1], names, env.action_low, env.action_high)
    if cfg.real_env is not None:
        check_real_env(config, cfg.real_env)
    if cfg.peft is not None:
        policy = with_new_adapters(policy, cfg.peft)
    algorithm = make_algorithm(policy, cfg.algorithm, cfg.output_dir)
    longest = env.max_episode_steps
    buffer = RolloutBuffer(rollout_length(cfg, longest), cfg.num_envs, config.device, longest)
    trained = Trained(policy, processors, env, cfg.env)
    callbacks = make_callbacks(cfg, trained, cfg.output_dir, cfg.iterations)
    if is_first_process():
        claim_output_dir(cfg.output_dir, settings, MAY_DIFFER)
        if cfg.budget is not None and not isinstance(cfg.env, WorldModelEnv):
            steps = cfg.iterations * cfg.num_envs * rank_and_size()[1] * buffer.steps
            charge_steps(cfg.budget, cfg.output_dir, steps, env.max_episode_steps)

    def save_pretrained(folder: Path) -> None:
        for part in (policy, config, *processors, cfg):
            part.save_pretrained(folder)

    schedule = Schedule(cfg.iterations, cfg.save_freq, cfg.seed, cfg.log_freq)
    train(
        env, algorithm, make_pipeline(config, *processors), buffer, schedule, cfg.output_dir, save_pretrained,
        callbacks, make_wandb(cfg),
    )  # fmt: skip


def chosen_checkpoint(cfg: TrainConfig) -> Path:
    """Return the best checkpoint, or the last one of a training without selection."""
    model = best_checkpoint if cfg.selection.freq else last_checkpoint
    return model(cfg.output_dir).parent


def summary(cfg: TrainConfig) -> list[str]:
    """Return lines that say what was made, how good it is, and how to evaluate it."""
    from lerobot_wmrl.common.tracking import read_metrics
    from lerobot_wmrl.rl.callbacks import read_record
    from lerobot_wmrl.rl.selection import Selection, success

    iterations = [line for line in read_metrics(cfg.output_dir) if "success_rate" in line]
    first, last, checkpoint = iterations[0], iterations[-1], chosen_checkpoint(cfg)
    policy, env, algorithm = cfg.policy.type, cfg.env.type, cfg.algorithm.type.upper()  # type: ignore[union-attr]
    planner = isinstance(cfg.algorithm, DistillationConfig)
    acted = f"the planner's success in {env}" if planner else f"success in {env} with exploration"
    lines = [
        f"{cfg.output_dir}: {policy} policy after {last['step']} iterations of {algorithm}, "
        f"{last['env_steps']:,} steps in {env}",
        f"{acted}: {first['success_rate']:.0%} in iteration {first['step']}, "
        f"{last['success_rate']:.0%} in iteration {last['step']}",
    ]
    if cfg.selection.freq:
        best = int(checkpoint.resolve().name)
        record = read_record(cfg.output_dir, Selection.name, best, cfg.iterations)
        measured = [place for place in ("real", "imagined") if place in record]
        found = ", ".join(f"{place} success {success(record, place)}" for place in measured)
        lines.append(f"best checkpoint: iteration {best}, {found}")
    return [*lines, f"next: {evaluation(cfg, str(checkpoint / PRETRAINED_MODEL_DIR))}"]


def evaluation(cfg: TrainConfig, path: str, shared: bool = False) -> str:
    """Return the command that evaluates the policy at `path`, a folder or a name on the hub.

    `shared`: for others, who do not have this machine's folders.
    """
    from lerobot_wmrl.common.lerobot_commands import env_flags

    evaluated: Any = cfg.real_env or cfg.env
    settings = dict(env_flags(evaluated))
    for name in settings if shared else ():
        place = Path(str(settings[name]))
        if name.endswith(PATHS) and (place.is_absolute() or place.exists()):
            settings[name] = UNPUBLISHED
    flags = {"policy.path": path, **settings, "eval.n_episodes": 100, "seed": EVALUATION_SEED}
    return shlex.join(["lerobot-eval", *format_flags(flags)])


def publish(cfg: TrainConfig, lines: list[str]) -> None:
    """Upload the chosen checkpoint with a model card if `policy.push_to_hub`. `lines` describe it."""
    config: Any = cfg.policy
    if not config.push_to_hub:
        return
    from huggingface_hub import HfApi, ModelCardData

    api = HfApi()
    name = api.create_repo(config.repo_id, private=config.private, exist_ok=True).repo_id
    data = ModelCardData(
        license=config.license or "apache-2.0", library_name="lerobot", pipeline_tag="robotics",
        tags=sorted({*(config.tags or []), "robotics", "lerobot", config.type}), model_name=name,
    )  # fmt: skip
    described = [lines[0].removeprefix(f"{cfg.output_dir}: "), *lines[1:-1]]
    description, start = "\n".join(f"- {line}" for line in described), str(config.pretrained_path)
    card = CARD.format(
        metadata=data.to_yaml(), name=name, type=config.type, description=description,
        start="a policy that is not published" if Path(start).exists() else f"`{start}`",
        command=evaluation(cfg, name, shared=True),
    )  # fmt: skip
    with TemporaryDirectory() as temporary:
        folder = Path(temporary) / "policy"
        shutil.copytree(chosen_checkpoint(cfg) / PRETRAINED_MODEL_DIR, folder)
        (folder / "README.md").write_text(card)
        api.upload_folder(
            repo_id=name, folder_path=folder, commit_message="Policy trained by reinforcement learning"
        )
    print(f"{cfg.output_dir}: published as {name}")


def main() -> None:
    """Entry point of the console command."""
    from accelerate import PartialState

    keep_freed_memory()
    run_command(train_policy, TrainConfig, partial(expand_preset, command="train"))
    PartialState().destroy_process_group()


if __name__ == "__main__":
    main()

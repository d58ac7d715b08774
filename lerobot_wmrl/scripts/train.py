"""lerobot-wmrl-train: improve a policy by reinforcement learning, inside a world model or in ManiSkill.

    lerobot-wmrl-train --policy.path=outputs/sft --env.type=world_model --env.world_model_path=W \\
        --env.text_world_model_path=X --env.dataset.root=D --gate.dataset.root=ROLLOUTS --output_dir=rl
    lerobot-wmrl-train --policy.path=outputs/sft --env.type=wmrl_maniskill --num_envs=2 --output_dir=rl

Before the first update the gate asks how many real failures the world model calls successes:
`--gate.dataset.root=ROLLOUTS` (with labels), or `--real_env.type=wmrl_maniskill …` for fresh ones.
`--selection.freq=5` measures success on seeds of its own, in `--real_env` too, and keeps `checkpoints/best`.
`--dyna.rounds=2` refreshes the world model with what the policy does by then.

Running the same command again continues from the last checkpoint. `--preset=demo` sets the sizes.
`lerobot-eval --policy.path=outputs/rl/checkpoints/best/pretrained_model …` evaluates the result.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import draccus
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.default import PeftConfig, WandBConfig
from lerobot.envs.configs import EnvConfig
from lerobot.rl.algorithms.configs import RLAlgorithmConfig

from lerobot_wmrl.common.command_line import RunConfig, claim_output_dir, run_command
from lerobot_wmrl.common.constants import ACTION_NAMES, EVALUATION_SEED
from lerobot_wmrl.common.distributed import LONGEST_WAIT, rank_and_size, wait_for_all
from lerobot_wmrl.common.malloc import keep_freed_memory
from lerobot_wmrl.common.presets import expand_preset
from lerobot_wmrl.rl.configuration_algorithms import GRPOConfig, PolicyGradientConfig, PPOConfig
from lerobot_wmrl.rl.configuration_callbacks import CallbackSettings

MAY_DIFFER = ("resume", "job_name", "log_freq", "wandb", "gate.action", "dyna.dataset")
"""Settings that a continued run may have otherwise than when it began."""


@dataclass
class TrainConfig(CallbackSettings, RunConfig):
    """Improve a policy by reinforcement learning.

    `--preset=tiny|demo|cpu` stands for the flags of that size; flags further right override it.

    Args:
        policy: `--policy.path=`, a checkpoint of lerobot-train or the folder it was written to.
        env: `--env.type=world_model|wmrl_maniskill` and its settings.
        algorithm: `--algorithm.type=ppo|grpo` and its settings.
        peft: `--peft.method_type=LORA --peft.r=32`, as in lerobot-train: train new adapters and the value
            alone. A policy that has adapters is trained in them without this.
        output_dir: where checkpoints and metrics go; continues if it holds this run already.
        num_envs: environments stepped together, in each process of `torchrun`.
        rollout_steps: steps of each of them an iteration; by default the longest episode.
        iterations: rollouts, each followed by an update.
        save_freq, log_freq: iterations between checkpoints, and between lines in the terminal.
        seed: of sampling and of the episodes; below the evaluation seeds.
        resume: there must be a checkpoint in `output_dir` to go on from, as in lerobot-train, also with
            `--config_path=outputs/rl/train_config.json` in place of all other flags. Without, it may be new.
        wandb: `--wandb.enable=true` also sends the metrics there, as lerobot-train does.
        job_name: of the run in wandb.
        real_env, real_num_envs: `--real_env.type=wmrl_maniskill` and its settings, where success is real;
            simulators at once.
        selection: which checkpoint is kept as `checkpoints/best`.
        gate: whether the world model may be trusted with a policy (`--gate.action=stop|warn|off`).
        dyna: rounds that refresh the world model with what the policy does by then (`--dyna.rounds`).
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
        """As LeRobot's WandBLogger asks for it."""
        return draccus.encode(self)


def check_config(cfg: TrainConfig) -> PolicyGradientConfig:
    """ValueError names the setting that cannot be."""
    if not isinstance(cfg.algorithm, PolicyGradientConfig):
        raise ValueError(f"--algorithm.type={cfg.algorithm.type}: this command trains with: ppo, grpo")
    if cfg.env is None or not hasattr(cfg.env, "create_tensor_env"):
        raise ValueError("--env.type: choose world_model or wmrl_maniskill")
    for name in ("num_envs", "iterations", "save_freq", "log_freq"):
        if getattr(cfg, name) < 1:
            raise ValueError(f"--{name}={getattr(cfg, name)}: must be at least 1")
    if isinstance(cfg.algorithm, GRPOConfig) and cfg.num_envs % cfg.algorithm.group_size:
        raise ValueError(
            f"--num_envs={cfg.num_envs}: must be a multiple of --algorithm.group_size="
            f"{cfg.algorithm.group_size}, whose environments begin alike"
        )
    if not 0 <= cfg.seed < EVALUATION_SEED:
        raise ValueError(
            f"--seed={cfg.seed}: must be from 0 to {EVALUATION_SEED - 1}; those above are for evaluation"
        )
    cfg.check_callbacks(cfg.env, cfg.iterations)
    return cfg.algorithm


def rollout_length(cfg: TrainConfig, longest: int) -> int:
    """Steps a rollout. ValueError if the end of an episode would never be seen."""
    steps = cfg.rollout_steps or longest
    if steps < longest:
        raise ValueError(
            f"--rollout_steps={steps}: episodes last up to {longest} steps and every rollout starts anew, so "
            "their ends would never be trained on; raise it, or lower --env.episode_length"
        )
    return steps


def load_config(cfg: TrainConfig) -> PreTrainedConfig:
    """The policy's configuration, also kept in `cfg`. ValueError if no policy is given."""
    from lerobot_wmrl.common.policy_checkpoints import read_policy_config

    path = parser.get_path_arg("policy") or (cfg.policy and cfg.policy.pretrained_path)
    if not path:
        raise ValueError("--policy.path: give the checkpoint of the policy to improve")
    cfg.policy = read_policy_config(str(path), parser.get_cli_overrides("policy") or [])
    cfg.policy.push_to_hub = False
    return cfg.policy


def train_policy(cfg: TrainConfig) -> None:
    """Load the policy, build the environment, see that they fit, train."""
    from accelerate import PartialState
    from lerobot.utils.random_utils import set_seed

    from lerobot_wmrl.common.policy_checkpoints import load_policy, load_processors

    algorithm = check_config(cfg)
    config = load_config(cfg)
    PartialState(cpu=config.device == "cpu", timeout=LONGEST_WAIT)
    done = finished(cfg)
    wait_for_all()  # no process has written anything before all have looked
    if done:
        claim_output_dir(cfg.output_dir, draccus.encode(cfg), MAY_DIFFER)
        print(f"{cfg.output_dir}: already trained for {cfg.iterations} iterations")
        return
    set_seed(cfg.seed)
    policy, processors = load_policy(config), load_processors(config)
    env: Any = cfg.env.create_tensor_env(cfg.num_envs, config.device)  # type: ignore[union-attr]
    try:
        train_in(env, cfg, algorithm, policy, processors)
    finally:
        env.close()


def finished(cfg: TrainConfig) -> bool:
    """Whether there is nothing left to do. ValueError if there is nothing to resume."""
    from lerobot_wmrl.common.checkpoints import latest_checkpoint
    from lerobot_wmrl.rl.callbacks import has_record
    from lerobot_wmrl.rl.selection import Selection

    last = latest_checkpoint(cfg.output_dir)
    if cfg.resume and last is None:
        raise ValueError(
            f"--resume=true: there is no checkpoint in --output_dir={cfg.output_dir} to go on from; leave "
            "the flag out to begin"
        )
    if last is None or int(last.name) < cfg.iterations:
        return False
    return not cfg.selection.freq or has_record(
        cfg.output_dir, Selection.name, cfg.iterations, cfg.iterations
    )


def make_wandb(cfg: TrainConfig) -> Any:
    """LeRobot's logger if it is asked for; of a run that wandb knows already, it goes on with that one."""
    if not cfg.wandb.enable or rank_and_size()[0] > 0:
        return None
    from lerobot.common.wandb_utils import WandBLogger

    known = (cfg.output_dir / "wandb" / "latest-run").exists()
    return WandBLogger(replace(cfg, resume=known, job_name=cfg.job_name or cfg.output_dir.name))


def train_in(
    env: Any,
    cfg: TrainConfig,
    algorithm_config: PolicyGradientConfig,
    policy: Any,
    processors: tuple[Any, Any],
) -> None:
    """See that policy and environment fit, then train."""
    from lerobot_wmrl.common.adapters import with_new_adapters
    from lerobot_wmrl.common.policy_checkpoints import adopt_features, check_fit
    from lerobot_wmrl.rl.make_callbacks import Trained, make_callbacks
    from lerobot_wmrl.rl.protocol import make_pipeline
    from lerobot_wmrl.rl.rollout import RolloutBuffer
    from lerobot_wmrl.rl.trainer import Schedule, make_algorithm, train

    config, settings = policy.config, draccus.encode(cfg)
    observation = env.reset(seed=cfg.seed)[0]
    shown = {name: tuple(value.shape[1:]) for name, value in observation.items() if hasattr(value, "shape")}
    adopt_features(config, shown)
    check_fit(config, shown, env.single_action_space.shape[-1])
    if cfg.simulator is not None:
        check_fit(config, cfg.simulator.observation_shapes(), len(ACTION_NAMES))
    if cfg.peft is not None:
        policy = with_new_adapters(policy, cfg.peft)
    algorithm = make_algorithm(policy, algorithm_config)
    buffer = RolloutBuffer(rollout_length(cfg, env.max_episode_steps), cfg.num_envs, config.device)
    trained = Trained(policy, processors, env, cfg.env)
    callbacks = make_callbacks(cfg, trained, cfg.output_dir, cfg.iterations)
    if rank_and_size()[0] == 0:
        claim_output_dir(cfg.output_dir, settings, MAY_DIFFER)

    def save_pretrained(folder: Path) -> None:
        for part in (policy, config, *processors, cfg):
            part.save_pretrained(folder)

    schedule = Schedule(cfg.iterations, cfg.save_freq, cfg.seed, cfg.log_freq)
    train(
        env, algorithm, make_pipeline(config, *processors), buffer, schedule, cfg.output_dir, save_pretrained,
        callbacks, make_wandb(cfg),
    )  # fmt: skip


def main() -> None:
    """Entry point of the console command."""
    from accelerate import PartialState

    keep_freed_memory()
    run_command(train_policy, TrainConfig, partial(expand_preset, command="train"))
    PartialState().destroy_process_group()


if __name__ == "__main__":
    main()

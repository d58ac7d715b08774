"""lerobot-wmrl-train: improve a policy by reinforcement learning, inside a world model or in ManiSkill.

    lerobot-wmrl-train --policy.path=outputs/sft --env.type=world_model --env.world_model_path=W \\
        --env.text_world_model_path=X --env.dataset.root=D --algorithm.type=ppo --output_dir=outputs/rl
    lerobot-wmrl-train --policy.path=outputs/sft --env.type=wmrl_maniskill --num_envs=2 --output_dir=rl

Running the same command again continues from the last checkpoint. `--preset=demo` sets the sizes.
`lerobot-eval --policy.path=outputs/rl/checkpoints/last/pretrained_model …` evaluates the result.
"""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import draccus
from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs.configs import EnvConfig
from lerobot.rl.algorithms.configs import RLAlgorithmConfig

from lerobot_wmrl.command import RunConfig, claim_output_dir, run_command
from lerobot_wmrl.constants import EVALUATION_SEED
from lerobot_wmrl.malloc import keep_freed_memory
from lerobot_wmrl.presets import expand_preset
from lerobot_wmrl.rl.configuration_ppo import PPOConfig


@dataclass
class TrainConfig(RunConfig):
    """Improve a policy by reinforcement learning.

    `--preset=tiny` or `--preset=demo` stands for the flags of that size; flags further right override it.

    Args:
        policy: `--policy.path=`, a checkpoint of lerobot-train or the folder it was written to.
        env: `--env.type=world_model|wmrl_maniskill` and its settings.
        algorithm: `--algorithm.type=ppo` and its settings.
        output_dir: where checkpoints and metrics go; continues if it holds this run already.
        num_envs: environments stepped together.
        rollout_steps: steps of each of them an iteration; by default the longest episode.
        iterations: rollouts, each followed by an update.
        save_freq: iterations between checkpoints.
        seed: of sampling and of the episodes; below the evaluation seeds.
    """

    path_fields: ClassVar[list[str]] = ["policy"]

    policy: PreTrainedConfig | None = None
    env: EnvConfig | None = None
    algorithm: RLAlgorithmConfig = field(default_factory=PPOConfig)
    output_dir: Path = Path("outputs/rl")
    num_envs: int = 64
    rollout_steps: int | None = None
    iterations: int = 40
    save_freq: int = 5
    seed: int = 0


def check_config(cfg: TrainConfig) -> PPOConfig:
    """ValueError names the setting that cannot be."""
    if not isinstance(cfg.algorithm, PPOConfig):
        raise ValueError(f"--algorithm.type={cfg.algorithm.type}: this command trains with: ppo")
    if cfg.env is None or not hasattr(cfg.env, "create_tensor_env"):
        raise ValueError("--env.type: choose world_model or wmrl_maniskill")
    for name in ("num_envs", "iterations", "save_freq"):
        if getattr(cfg, name) < 1:
            raise ValueError(f"--{name}={getattr(cfg, name)}: must be at least 1")
    if not 0 <= cfg.seed < EVALUATION_SEED:
        raise ValueError(
            f"--seed={cfg.seed}: must be from 0 to {EVALUATION_SEED - 1}; those above are for evaluation"
        )
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
    from lerobot_wmrl.policy_checkpoints import read_policy_config

    path = parser.get_path_arg("policy")
    if not path:
        raise ValueError("--policy.path: give the checkpoint of the policy to improve")
    cfg.policy = read_policy_config(path, parser.get_cli_overrides("policy") or [])
    cfg.policy.push_to_hub = False
    return cfg.policy


def train_policy(cfg: TrainConfig) -> None:
    """Load the policy, build the environment, see that they fit, train."""
    from lerobot.utils.random_utils import set_seed

    from lerobot_wmrl.checkpoints import latest_checkpoint
    from lerobot_wmrl.policy_checkpoints import load_policy, load_processors

    algorithm = check_config(cfg)
    config = load_config(cfg)
    done = latest_checkpoint(cfg.output_dir)
    if done is not None and int(done.name) >= cfg.iterations:
        claim_output_dir(cfg.output_dir, draccus.encode(cfg))
        print(f"{cfg.output_dir}: already trained for {cfg.iterations} iterations")
        return
    set_seed(cfg.seed)
    policy, processors = load_policy(config), load_processors(config)
    env: Any = cfg.env.create_tensor_env(cfg.num_envs, config.device)  # type: ignore[union-attr]
    try:
        train_in(env, cfg, algorithm, policy, processors)
    finally:
        env.close()


def train_in(
    env: Any, cfg: TrainConfig, algorithm_config: PPOConfig, policy: Any, processors: tuple[Any, Any]
) -> None:
    """See that policy and environment fit, then train."""
    from lerobot_wmrl.policy_checkpoints import check_fit
    from lerobot_wmrl.rl.ppo import PPO
    from lerobot_wmrl.rl.protocol import make_pipeline
    from lerobot_wmrl.rl.rollout import RolloutBuffer
    from lerobot_wmrl.rl.trainer import Schedule, train

    config = policy.config
    observation = env.reset(seed=cfg.seed)[0]
    shown = {name: tuple(value.shape[1:]) for name, value in observation.items() if hasattr(value, "shape")}
    check_fit(config, shown, env.single_action_space.shape[-1])
    algorithm = PPO(policy, algorithm_config)
    buffer = RolloutBuffer(rollout_length(cfg, env.max_episode_steps), cfg.num_envs, config.device)
    claim_output_dir(cfg.output_dir, draccus.encode(cfg))

    def save_pretrained(folder: Path) -> None:
        for part in (policy, *processors, cfg):
            part.save_pretrained(folder)

    schedule = Schedule(cfg.iterations, cfg.save_freq, cfg.seed)
    pipeline = make_pipeline(config, *processors)
    train(env, algorithm, pipeline, buffer, schedule, cfg.output_dir, save_pretrained)


def main() -> None:
    """Entry point of the console command."""
    keep_freed_memory()
    run_command(train_policy, TrainConfig, partial(expand_preset, command="train"))


if __name__ == "__main__":
    main()

"""What policy, environment and settings must agree on before a training begins."""

import logging
from typing import Any

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policies import LoadedPolicy, unwrapped
from lerobot_wmrl.common.policy_checks import adopt_features, check_fit
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.envs.lerobot_env import check_frame_rate, check_real_env, shapes_of
from lerobot_wmrl.envs.tensor_env import TensorEnv
from lerobot_wmrl.envs.world_model_env import WorldModelVectorEnv
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.rewards.general import RuleBasedReward, potential_discount
from lerobot_wmrl.rl.configuration_algorithms import AlgorithmConfig
from lerobot_wmrl.rl.configuration_train import TrainConfig
from lerobot_wmrl.rl.protocol import EncodingPolicy


def match_policy_to_env(cfg: TrainConfig, policy: LoadedPolicy, env: TensorEnv) -> None:
    """Let a policy see what its environment shows and act as far as it has learnt to.

    Raises:
        FieldError: they do not fit each other, the algorithm or `real_env`.
    """
    check_tasks(cfg, env)
    warn_of_discount(cfg, env.max_episode_steps)
    observation, _ = env.reset(seed=cfg.seed)
    shown = shapes_of(observation)
    adopt_features(policy.config, shown)
    check_fit(policy.config, shown, env.single_action_space.shape[-1])
    env.accept(policy)
    if cfg.real_env is not None:
        check_real_env(policy.config, cfg.real_env)
        if isinstance(env, WorldModelVectorEnv):
            check_frame_rate(cfg.real_env, env.model.config.embodiment.fps, "the world model's dataset")


def check_tasks(cfg: TrainConfig, env: TensorEnv) -> None:
    """Raise FieldError if a task has no environment, or if an algorithm that compares episodes from
    the same start, GRPO, finds no two."""
    assert isinstance(cfg.algorithm, AlgorithmConfig), "as `TrainConfig.validate` has checked"
    tasks, compares_starts = env.tasks, cfg.algorithm.compares_starts
    if compares_starts and tasks > 1:
        raise FieldError(
            "algorithm.type",
            cfg.algorithm.type,
            f"compares episodes from the same start, and the environment has {tasks} tasks",
            "choose one task, or ppo",
        )
    if compares_starts and not env.repeats_starts():
        raise FieldError(
            "algorithm.type",
            cfg.algorithm.type,
            "compares episodes from the same start, and in this environment a seed does not decide it",
            "choose ppo",
        )
    if tasks > env.num_envs:
        raise FieldError(
            "num_envs",
            env.num_envs,
            f"the environment has {tasks} tasks, and each needs one of its own",
            f"set it to a multiple of {tasks}, or choose fewer tasks",
        )


def settle_discount(cfg: TrainConfig) -> None:
    """Let GRPO, which adds rewards up without a discount, be rewarded for progress without one: discounted,
    an early approach to the goal would cost more than it earns. Leave a discount that is given."""
    reward = progress_reward(cfg)
    if not cfg.algorithm.discounts and reward is not None and reward.gamma is None:
        reward.gamma = 1.0


def progress_reward(cfg: TrainConfig) -> GeneralConfig | RuleBasedReward | None:
    """Return the settings of a reward that pays for progress made, None for others."""
    reward = cfg.env.reward if isinstance(cfg.env, WorldModelEnv | WmrlManiSkillEnv) else None
    if not isinstance(reward, GeneralConfig | RuleBasedReward):
        return None
    return reward if reward.alpha != 1 and reward.form == "potential" else None


def warn_of_discount(cfg: TrainConfig, longest: int) -> None:
    """Warn if progress is rewarded with another discount than the algorithm's, in episodes of up to `longest`
    steps."""
    assert isinstance(cfg.algorithm, AlgorithmConfig), "as `TrainConfig.validate` has checked"
    reward, discount = progress_reward(cfg), cfg.algorithm.discount(longest)
    if reward is None or discount is None:
        return
    if (reward_discount := potential_discount(reward, longest)) != discount:
        logging.warning(
            "env.reward.gamma=%s: progress is rewarded with this discount, and %s has %s, so that the time "
            "spent near the goal counts too; set --env.reward.gamma=%s",
            reward_discount,
            cfg.algorithm.type.upper(),
            discount,
            discount,
        )


def rollout_length(cfg: TrainConfig, longest: int) -> int:
    """Return the number of steps of a rollout. FieldError if the longest episodes do not fit in it."""
    steps = cfg.rollout_steps or longest
    if steps < longest:
        raise FieldError(
            "rollout_steps",
            steps,
            f"episodes last up to {longest} steps and every rollout starts new ones, so their ends would "
            "never be trained on",
            "raise it, or lower `env.episode_length`",
        )
    return steps


def check_std(policy: Any, stochastic: Any, std: float) -> None:
    """Raise FieldError unless the standard deviation of exploration can be set.

    Args:
        policy: LeRobot's.
        stochastic: what samples its actions, the policy itself or an adapter around it.
        std: `algorithm.initial_std`.
    """
    if not hasattr(stochastic, "set_std"):
        raise FieldError(
            "algorithm.initial_std", std, "this policy has no standard deviation", "set it to null"
        )
    if stochastic is policy and unwrapped(policy) is not policy:
        raise FieldError(
            "algorithm.initial_std",
            std,
            "is none of the adapters' parameters, which checkpoints hold alone",
            "set it to null, or train without adapters",
        )


def require_encoder(stochastic: Any) -> None:
    """Raise FieldError unless what samples actions has an encoder that can be kept as it was cloned."""
    if not isinstance(unwrapped(stochastic), EncodingPolicy):
        raise FieldError(
            "algorithm.train_encoder",
            False,
            "this policy has no encoder that can be kept",
            "set it to true, or take the policy cnn",
        )

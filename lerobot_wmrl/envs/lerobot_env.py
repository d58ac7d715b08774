"""Any environment of LeRobot's for reinforcement learning: tensors in, tensors out."""

import logging
from math import ceil
from typing import Any, Final

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs import make_env, make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig, HubEnvConfig, LiberoEnv
from lerobot.envs.utils import (
    NEW_ROLLOUT_OPTION,
    FreezeAfterEpisodeEnd,
    env_to_policy_features,
    preprocess_observation,
)
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.errors import FieldError, within
from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.common.policy_checks import check_fit, fit_to_environment, learnt_range, seen_shape
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.envs.configuration_hub import HubEnv
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.tensor_env import Outcome, TensorEnv
from lerobot_wmrl.maniskill.backend import render_backend

FRAME_LIMIT: Final = "_max_episode_steps"
"""Attribute of an environment that ends LeRobot's rollouts."""

SAME_START: Final = 0.01
"""Difference between two starts that rendering may make: of pixels in [0, 1], or in the state's units."""


def make_tensor_env(config: EnvConfig, n_envs: int, device: str) -> TensorEnv:
    """Return `n_envs` environments for reinforcement learning, as this project's own or around LeRobot's."""
    if is_own(config):
        env: TensorEnv = config.create_tensor_env(n_envs, device)
        return env
    return LeRobotTensorEnv(config, n_envs, device)


def is_own(config: EnvConfig) -> bool:
    """Return whether an environment is one of this project's."""
    return hasattr(config, "create_tensor_env")


def check_fit_to(config: EnvConfig, policy: PreTrainedConfig) -> None:
    """Raise FieldError unless policy and environment fit; a policy without features takes the environment's.

    Only this project's environments are checked: LeRobot's own may show a policy more than they declare.
    """
    if not is_own(config):
        return
    features = env_to_policy_features(config)
    action = features.pop(ACTION)
    shown = {name: tuple(feature.shape) for name, feature in features.items()}
    fit_to_environment(policy, shown, action.shape[0])


def runs_in_processes(config: EnvConfig) -> bool:
    """Return whether copies of an environment can run in processes of their own.

    This project's can, and so can the benchmarks that LeRobot makes itself, such as Meta-World. Those that it
    takes from Gymnasium's registry, such as PushT, or from the hub may lack `task_description`. LeRobot's
    rollout asks for it, and an asynchronous environment without it does not survive the question.
    """
    own_way = type(config).create_envs is not EnvConfig.create_envs
    return is_own(config) or (own_way and not isinstance(config, HubEnv))


def counts_resets(config: EnvConfig) -> bool:
    """Return whether not the seed but the number of resets so far chooses an episode's start, as in LIBERO.

    Policies meet the same starts there if each has environments of its own that are reset once an episode:
    LeRobot's `FreezeAfterEpisodeEnd` keeps those away that a vector environment would make by itself.
    """
    return isinstance(config, LiberoEnv) and config.init_states


def freeze_finished(env: Any) -> None:
    """Keep finished episodes of a vector environment from being reset and stepped until the last one ends.

    LeRobot's rollout takes no notice of what comes after an end, but it costs time, and in LIBERO starts.
    """
    if isinstance(env, SyncVectorEnv) and env.autoreset_mode is AutoresetMode.NEXT_STEP:
        env.envs = [FreezeAfterEpisodeEnd(each) for each in env.envs]


def shapes_of(observation: Observation) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a batch's tensors, without the batch's dimension, as `check_fit` takes them."""
    return {name: tuple(value.shape[1:]) for name, value in observation.items() if isinstance(value, Tensor)}


def check_real_env(policy: PreTrainedConfig, config: EnvConfig, starts: int = 0) -> None:
    """Raise FieldError unless a policy can act in `real_env`, of which one is made to look at it.

    ManiSkill says what it shows without its simulator, which must be there and able to render. The pictures
    of other environments may have any size: LeRobot leaves it to policies to make them fit. LIBERO must have
    at least `starts` starts for a task.
    """
    if isinstance(config, WmrlManiSkillEnv):
        with within("real_env"):
            config.selected_scenes()
            config.runs_batched("cuda")
        check_fit(policy, config.observation_shapes(), config.features[ACTION].shape[0], "real_env")
        render_backend()
        return
    with within("real_env"):
        env = make_tensor_env(config, 1, "cpu")
    try:
        if counts_resets(config) and (known := len(env.envs[0].get_wrapper_attr("_init_states"))) < starts:
            raise FieldError(
                "real_env.init_states",
                True,
                f"{config.type} has {known} starts for a task, policies are measured on {starts}",
                "set it to false, or lower `eval_episodes` and `selection_episodes`",
            )
        shown = shapes_of(env.reset()[0])
    finally:
        env.close()
    wanted = {name: seen_shape(feature) for name, feature in policy.image_features.items()}
    sized = {name: wanted.get(name, shape) for name, shape in shown.items()}
    check_fit(policy, sized, env.single_action_space.shape[0], "real_env")


def frame_limit(config: EnvConfig) -> int:
    """Return the most frames of an episode of `real_env`, of which one a task is made to ask it: LeRobot's
    rollouts go by the environment, and some configurations say something else (Meta-World's)."""
    if is_own(config):
        own: Any = config
        return int(own.horizon)
    with within("real_env"):
        envs = [env for members in _members(config, 1) for env in members]
        limits = [_frame_limit(config, env) for env in envs]
    for env in envs:
        env.close()
    return max(limits)


def check_frame_rate(config: EnvConfig, fps: int, where: str) -> None:
    """Raise FieldError unless `real_env` has as many frames a second as the data that is learnt from."""
    if config.fps != fps:
        raise FieldError(
            "real_env.fps",
            config.fps,
            f"{where} has {fps} frames a second, and what is recorded in both is "
            "learnt from, or checked on, together",
            f"set it to {fps} if the environment has that, or resample the dataset (lerobot-wmrl-resample)",
        )


class LeRobotTensorEnv(TensorEnv):
    """B environments of LeRobot's, stepped one after the other.

    Observations are what its rollout makes of them. An episode is truncated after `_max_episode_steps`
    frames, which LIBERO leaves to LeRobot's rollout.
    """

    def __init__(self, config: EnvConfig, n_envs: int, device: str) -> None:
        tasks = _members(config, 1)
        self.kind, self.tasks = config.type, len(tasks)
        if n_envs > self.tasks:
            for (env,) in tasks:
                env.close()
            tasks = _members(config, ceil(n_envs / self.tasks))
        in_turn = [env for members in zip(*tasks, strict=True) for env in members]
        self.envs, spare = in_turn[:n_envs], in_turn[n_envs:]
        for env in spare:
            env.close()
        self.before, self.after = make_env_pre_post_processors(config, None)
        self.num_envs, self.device = n_envs, torch.device(device)
        self.single_action_space = self.envs[0].action_space
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, n_envs)
        box: Any = self.single_action_space
        self.action_low, self.action_high = (torch.as_tensor(end).float() for end in (box.low, box.high))
        self._limits = [_frame_limit(config, env) for env in self.envs]
        self.max_episode_steps = max(self._limits)
        self.metadata = {"render_fps": config.fps, "autoreset_mode": AutoresetMode.SAME_STEP}
        self._length = np.zeros(n_envs, np.int64)

    def accept(self, policy: LoadedPolicy) -> None:
        """Let actions reach as far as those that the policy has learnt from, where it says so."""
        if learnt := learnt_range(policy.postprocessor):
            self.widen(*learnt)

    def widen(self, low: Tensor, high: Tensor) -> None:
        """Let actions reach as far as those that were learnt from, (A,) each; warn where that is new.

        LeRobot does not clip actions, and an environment may take more than its action space says: Aloha
        takes joint angles, and its space is that from −1 to 1.
        """
        beyond = ((low < self.action_low) | (high > self.action_high)).nonzero().flatten().tolist()
        if beyond:
            logging.warning(
                "env.type=%s: actions were learnt beyond the environment's action space, and may be taken "
                "there: %s. Are they in the same units?",
                self.kind,
                ", ".join(
                    f"component {at} {low[at]:.4g} to {high[at]:.4g} (in the environment "
                    f"{self.action_low[at]:.4g} to {self.action_high[at]:.4g})"
                    for at in beyond
                ),
            )
        self.action_low = torch.minimum(self.action_low, low)
        self.action_high = torch.maximum(self.action_high, high)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin B episodes, from `seed`, `seed` + 1, … or from the seeds given.

        The episodes after them have seeds that are drawn, from a generator that the first of these seeds.
        What a seed decides is up to the environment, see `repeats_starts`.
        """
        seeds: list[Any] = [None] * self.num_envs
        if seed is not None:
            seeds = (
                list(seed) if isinstance(seed, list | tuple) else [seed + row for row in range(len(seeds))]
            )
        self._later = np.random.default_rng(seeds[0])
        self._seen = [self._begin(row, each) for row, each in enumerate(seeds)]
        return self._stacked(self._seen), {}

    def step(self, actions: Tensor) -> tuple[Observation, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Take a step, see `TensorEnv`; actions pass LeRobot's processors of the environment first."""
        return super().step(self.after({ACTION: actions})[ACTION])

    def _advance(self, actions: Tensor) -> Outcome:
        reward, flags = np.zeros(self.num_envs, np.float32), np.zeros((3, self.num_envs), bool)
        for row, (env, taken) in enumerate(zip(self.envs, actions.numpy(), strict=True)):
            observation, gained, terminated, truncated, info = env.step(taken)
            self._length[row] += 1
            truncated |= not terminated and self._length[row] >= self._limits[row]
            reward[row], flags[:, row] = gained, (terminated, truncated, info.get("is_success", False))
            self._seen[row] = self._observe(row, observation)
        terminated, truncated, success = map(self._vector, flags)
        return Outcome(
            self._stacked(self._seen),
            self._vector(reward),
            terminated,
            truncated,
            success,
            self._vector(self._length.copy()),
        )

    def _restart(self, ended: Tensor, outcome: Outcome) -> Observation:
        for row in ended.nonzero()[:, 0].tolist():
            self._seen[row] = self._begin(row, int(self._later.integers(EVALUATION_SEED)))
        return self._stacked(self._seen)

    def repeats_starts(self) -> bool:
        """Return whether a seed decides the start. In LIBERO the number of resets does."""
        first, again = (self._begin(0, seed=0) for _ in range(2))
        return all(
            torch.allclose(value, again[name], atol=SAME_START)
            for name, value in first.items()
            if isinstance(value, Tensor)
        )

    def close_extras(self, **kwargs: Any) -> None:
        for env in self.envs:
            env.close()

    def _begin(self, row: int, seed: int | None) -> Observation:
        self._length[row] = 0
        return self._observe(row, self.envs[row].reset(seed=seed, options={NEW_ROLLOUT_OPTION: True})[0])

    def _observe(self, row: int, raw: Any) -> Observation:
        """Return an observation as LeRobot's rollout shows it to a policy's processors, batch of one."""
        observation = preprocess_observation(_batch_of_one(raw))
        observation["task"] = self._instruction(row)
        processed: Observation = self.before(observation)
        return processed

    def _instruction(self, row: int) -> list[str]:
        for name in ("task_description", "task"):
            try:
                return [str(self.envs[row].get_wrapper_attr(name))]
            except (AttributeError, NotImplementedError):
                continue
        return [""]

    def _stacked(self, observations: list[Observation]) -> Observation:
        stacked: Observation = {
            key: torch.cat([each[key] for each in observations]).to(self.device)
            for key, value in observations[0].items()
            if isinstance(value, Tensor)
        }
        return {**stacked, "task": [text for each in observations for text in each["task"]]}

    def _vector(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(values).to(self.device)


def _members(config: EnvConfig, each: int) -> list[list[gym.Env]]:
    """Make `each` environments of every task. → by task. FieldError if they are not to be had one by one, or
    their code would come from the hub."""
    if isinstance(config, HubEnvConfig):
        raise FieldError(
            "type",
            config.type,
            "its code lies on the hub, and this command does not run that of this type",
            "choose another; lerobot-wmrl-compare takes it, with --trust_remote_code=true",
        )
    made = make_env(config, each, use_async_envs=False)
    tasks = [env for suite in made.values() for env in suite.values()]
    for env in tasks:
        if not isinstance(env, gym.vector.SyncVectorEnv):
            raise FieldError(
                "type",
                config.type,
                f"makes a {type(env).__name__}, whose episodes cannot begin one by one",
                "it must make a gymnasium.vector.SyncVectorEnv where `use_async_envs` is false",
            )
    return [list(env.envs) for env in tasks]


def _frame_limit(config: EnvConfig, env: gym.Env) -> int:
    """Return the most frames of an episode. FieldError if the environment does not say it."""
    if not env.has_wrapper_attr(FRAME_LIMIT):
        raise FieldError(
            "type",
            config.type,
            f"does not say after how many frames an episode ends (`{FRAME_LIMIT}`)",
            "make the environment by gymnasium.make, with `max_episode_steps`",
        )
    return int(env.get_wrapper_attr(FRAME_LIMIT))


def _batch_of_one(observation: Any) -> Any:
    """Add a batch dimension to the arrays of an observation."""
    if isinstance(observation, dict):
        return {name: _batch_of_one(value) for name, value in observation.items()}
    return np.array(observation)[None]

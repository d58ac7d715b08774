"""Construction of a training's callbacks from its configuration."""

import logging
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.common.constants import SELECTION_SEED
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.envs.lerobot_env import is_own
from lerobot_wmrl.envs.tensor_env import TensorEnv
from lerobot_wmrl.envs.world_model_env import WorldModelVectorEnv, make_success_env
from lerobot_wmrl.evaluation.agreement import evaluate_policy, evaluate_within
from lerobot_wmrl.rl.callbacks import Callback
from lerobot_wmrl.rl.configuration_callbacks import CallbackSettings
from lerobot_wmrl.rl.dyna import DynaRounds, round_iterations
from lerobot_wmrl.rl.gate import SuccessGate
from lerobot_wmrl.rl.recorders import EnvRecorder, ManiSkillRecorder, Recorder
from lerobot_wmrl.rl.selection import IMAGINED, REAL, Measure, Selection


class Trained(NamedTuple):
    """A policy with its processors, and the environment that it is trained in with its configuration."""

    policy: Any
    processors: tuple[Any, Any]
    env: TensorEnv
    config: EnvConfig


def make_callbacks(
    settings: CallbackSettings, trained: Trained, output_dir: Path, iterations: int, seed: int
) -> list[Callback]:
    """Return the callbacks in the order in which they run: Dyna rounds, gate, selection."""
    callbacks: list[Callback] = []
    refreshed = frozenset(round_iterations(settings.dyna.rounds, iterations))
    if isinstance(trained.env, WorldModelVectorEnv):
        recorder = make_recorder(settings, trained.env)
        if settings.dyna.rounds:
            learnt, elsewhere = settings.learnt(trained.config), settings.dyna.dataset.roots is not None
            callbacks.append(DynaRounds(
                settings.dyna, trained.env, None if elsewhere else recorder, learnt, output_dir, iterations,
                seed, settings.budget,
            ))  # fmt: skip
        if settings.gate.action != "off":
            callbacks.append(SuccessGate(settings.gate, trained.env, recorder, refreshed, iterations))
    if settings.selection.freq:
        measures = make_measures(settings, trained)
        callbacks.append(Selection(settings.selection.freq, iterations, measures, output_dir, refreshed))
    return callbacks


def make_recorder(settings: CallbackSettings, env: WorldModelVectorEnv) -> Recorder | None:
    """Return a recorder of what policy and world model see in `real_env`; None without one."""
    simulator, model = settings.real_env, env.model.config
    if simulator is None:
        return None
    if not isinstance(simulator, WmrlManiSkillEnv):
        num_envs = settings.real_num_envs
        return EnvRecorder(simulator, model.embodiment, env.device.type, settings.budget, num_envs)
    cameras = list(dict.fromkeys([*simulator.cameras, *model.tokenizer.cameras]))
    return ManiSkillRecorder(simulator, settings.real_num_envs, cameras, model.depth, settings.budget)


def make_measures(settings: CallbackSettings, trained: Trained) -> dict[str, Measure]:
    """Return functions that measure success: `real` in `real_env`, and `imagined` in the world model. For a
    training outside a world model, `real` is in `real_env` or else in the training's environment."""
    policy, processors, env, config = trained
    episodes, dataset = settings.selection.n_episodes, settings.selection.dataset
    measures: dict[str, Measure] = {}
    if settings.real_env is not None:
        measures[REAL] = partial(
            evaluate_policy, settings.real_env, policy, processors, episodes, SELECTION_SEED,
            settings.real_num_envs,
        )  # fmt: skip

    def measure_in_training_env() -> Any:
        if not is_own(config):
            return evaluate_policy(config, policy, processors, episodes, SELECTION_SEED, num_envs=1)
        if not isinstance(env, WorldModelVectorEnv):
            return evaluate_within(env, config, policy, processors, episodes, SELECTION_SEED)
        own, measured_env = env.config.dataset, env
        if dataset.given:
            source = StartFrames(**vars(dataset), max_starts=own.max_starts, branches=own.branches)
            measured_env = make_success_env(env, source, episodes)
        elif not own.resets:
            measured_env = make_success_env(env, own, episodes)
        count = min(episodes, len(measured_env.starts))
        with measured_env.in_full():
            return evaluate_within(measured_env, config, policy, processors, count, SELECTION_SEED)

    if isinstance(env, WorldModelVectorEnv):
        measures[IMAGINED] = measure_in_training_env
    elif REAL not in measures:
        measures[REAL] = measure_in_training_env
    if REAL not in measures:
        logging.warning(
            "selection: without `real_env` the best checkpoint is the one that succeeds most often in "
            "imagination, which is not checked outside the world model"
        )
    return measures

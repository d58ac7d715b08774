"""Construction of a training's callbacks from its configuration."""

import logging
from functools import partial

from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.common.precision import device_setting
from lerobot_wmrl.common.seeds import SELECTION_SEED
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.envs.lerobot_env import is_own
from lerobot_wmrl.envs.starts import Starts
from lerobot_wmrl.envs.tensor_env import TensorEnv
from lerobot_wmrl.envs.world_model_env import WorldModelVectorEnv, load_spread_starts, make_success_env
from lerobot_wmrl.evaluation.policy_rollouts import PolicyEvaluation, evaluate_policy, evaluate_within
from lerobot_wmrl.rl.callbacks import Callback
from lerobot_wmrl.rl.configuration_callbacks import CallbackSettings, SelectionConfig
from lerobot_wmrl.rl.configuration_train import TrainConfig
from lerobot_wmrl.rl.dyna import DynaRounds, round_iterations
from lerobot_wmrl.rl.gate_callback import SuccessGate
from lerobot_wmrl.rl.recorders import EnvRecorder, ManiSkillRecorder, Recorder
from lerobot_wmrl.rl.selection import IMAGINED, REAL, Measure, Selection


def make_callbacks(cfg: TrainConfig, policy: LoadedPolicy, env: TensorEnv) -> list[Callback]:
    """Return the callbacks of a training in `env`, in their order: Dyna rounds, gate, selection."""
    assert cfg.env is not None
    callbacks: list[Callback] = []
    refreshed = frozenset(round_iterations(cfg.dyna.rounds, cfg.iterations))
    if isinstance(env, WorldModelVectorEnv):
        recorder = make_recorder(cfg, env)
        if cfg.dyna.rounds:
            learnt, elsewhere = cfg.learnt(cfg.env), cfg.dyna.dataset.roots is not None
            callbacks.append(
                DynaRounds(
                    cfg.dyna,
                    env,
                    None if elsewhere else recorder,
                    learnt,
                    cfg.output_dir,
                    cfg.iterations,
                    cfg.seed,
                    cfg.budget,
                )
            )
        if cfg.gate.action != "off":
            callbacks.append(SuccessGate(cfg.gate, env, recorder, refreshed, cfg.iterations))
    if cfg.selection.freq:
        measures = make_measures(cfg, policy, env, cfg.env)
        callbacks.append(Selection(cfg.selection.freq, cfg.iterations, measures, cfg.output_dir, refreshed))
    return callbacks


def make_recorder(settings: CallbackSettings, env: WorldModelVectorEnv) -> Recorder | None:
    """Return a recorder of what policy and world model see in `real_env`; None without one."""
    simulator, model = settings.real_env, env.model.config
    if simulator is None:
        return None
    if not isinstance(simulator, WmrlManiSkillEnv):
        num_envs = settings.real_num_envs
        return EnvRecorder(simulator, model.embodiment, device_setting(env.device), settings.budget, num_envs)
    cameras = list(dict.fromkeys([*simulator.cameras, *model.tokenizer.cameras]))
    return ManiSkillRecorder(simulator, settings.real_num_envs, cameras, model.depth, settings.budget)


def make_measures(
    settings: CallbackSettings, policy: LoadedPolicy, env: TensorEnv, config: EnvConfig
) -> dict[str, Measure]:
    """Return functions that measure success: `real` in `real_env`, and `imagined` in the world model. For a
    training outside a world model, `real` is in `real_env` or else in the training's environment."""
    episodes, measures = settings.selection.n_episodes, dict[str, Measure]()
    if settings.real_env is not None:
        measures[REAL] = partial(
            evaluate_policy, settings.real_env, policy, episodes, SELECTION_SEED, settings.real_num_envs
        )
    if isinstance(env, WorldModelVectorEnv):
        starts = selection_starts(settings.selection, env)
        measures[IMAGINED] = partial(measure_imagined, env, policy, starts, min(episodes, len(starts)))
    elif REAL not in measures and is_own(config) and env.tasks == 1:
        measures[REAL] = partial(evaluate_within, env, config, policy, episodes, SELECTION_SEED)
    elif REAL not in measures:  # task by task: each in all of its scenes, and on as many episodes
        at_once = max(1, env.num_envs // env.tasks) if is_own(config) else 1
        measures[REAL] = partial(evaluate_policy, config, policy, episodes, SELECTION_SEED, at_once)
    if REAL not in measures:
        logging.warning(
            "selection: without `real_env` the best checkpoint is the one that succeeds most often in "
            "imagination, which is not checked outside the world model"
        )
    return measures


def selection_starts(selection: SelectionConfig, env: WorldModelVectorEnv) -> Starts:
    """Return the starts of imagined episodes of selection. They hold for refreshed world models too, which
    keep the tokenizer."""
    source = env.config.dataset
    if selection.dataset.given:
        source = StartFrames(
            **vars(selection.dataset), max_starts=source.max_starts, branches=source.branches
        )
    elif source.resets:
        return env.starts
    return load_spread_starts(env.model, source, selection.n_episodes)


def measure_imagined(
    env: WorldModelVectorEnv, policy: LoadedPolicy, starts: Starts, episodes: int
) -> PolicyEvaluation:
    """Run a policy from these starts in the world model that `env` has by now."""
    return evaluate_within(
        make_success_env(env, starts, episodes), env.config, policy, episodes, SELECTION_SEED
    )

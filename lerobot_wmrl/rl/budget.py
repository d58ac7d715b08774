"""What a training by reinforcement learning may learn from, and what it costs in real episodes."""

import math
from pathlib import Path

import numpy as np
from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.common.errors import renamed, within
from lerobot_wmrl.data.dataset import DatasetSource
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.ledger import Ledger
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.envs.start_frames import check_starts
from lerobot_wmrl.evaluation.outcomes import check_labelled
from lerobot_wmrl.maniskill.recordings import require_unmeasured, require_unreported
from lerobot_wmrl.rl.configuration_callbacks import CallbackSettings
from lerobot_wmrl.world_models.checkpoint import check_dataset, read_config


def check_data(settings: CallbackSettings, env: EnvConfig) -> None:
    """Raise FieldError for a dataset that a training in `env` must not learn from.

    Starts must not be among those that results are reported on, whether policies are trained or chosen on
    them. With a budget its ledger must know the episodes of every dataset that decides something: starts,
    gate, selection and Dyna rounds. What these rounds learn from must fit the world model.
    """
    ledger = None if settings.budget is None else Ledger(settings.budget)
    if isinstance(env, WorldModelEnv):
        with within("env"):
            check_starts(env.dataset, ledger)
        if settings.dyna.rounds:
            check_rounds(settings, env)
        if settings.gate.action != "off" and settings.gate.dataset.given:
            config = read_config(env.world_model_path, "action_world_model", field="env.world_model_path")
            with within("gate"):
                check_labelled(config, read_episodes(settings.gate.dataset.open()))
    if settings.selection.dataset.given:
        with within("selection"):
            require_unmeasured(read_episodes(settings.selection.dataset.open()))
    if ledger is None:
        return
    datasets = {
        "gate.dataset.root": [settings.gate.dataset],
        "selection.dataset.root": [settings.selection.dataset],
        "dyna.learnt.root": [settings.learnt(env)] if settings.dyna.rounds else [],
        "dyna.dataset.roots": [DatasetSource(root) for root in settings.dyna.dataset.roots or []],
    }
    for field, sources in datasets.items():
        for source in sources:
            if source.given:
                with renamed("dataset.root", field):
                    ledger.require_known(read_episodes(source.open()))


def check_rounds(settings: CallbackSettings, env: WorldModelEnv) -> None:
    """Raise FieldError for a dataset from which no Dyna round could train the world model further."""
    rounds = [DatasetSource(root) for root in settings.dyna.dataset.roots or []]
    config = read_config(env.world_model_path, "action_world_model", field="env.world_model_path")
    for field, sources in {"dyna.learnt.root": [settings.learnt(env)], "dyna.dataset.roots": rounds}.items():
        for source in sources:
            with renamed("dataset.root", field):
                table = read_episodes(source.open())
                check_dataset(config, table.dataset.meta)
                remedy = f"give a dataset without them as `{field}`"
                learnt = np.flatnonzero(table.training(getattr(source, "episodes", None)))
                require_unreported(table, learnt, remedy)


def charge_steps(budget: Path, output_dir: Path, steps: int, episode_length: int) -> None:
    """Enter a training outside a world model in the ledger, its steps counted as the longest episodes.

    Args:
        budget: the ledger.
        output_dir: folder of the training.
        steps: environment steps of the whole training.
        episode_length: steps of the longest episode.

    Raises:
        FieldError: so many rollouts are not left.
    """
    Ledger(budget).charge_training(output_dir, math.ceil(steps / episode_length))

"""Recording what a policy does outside the world model, for the gate and for Dyna rounds."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import draccus
import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE, PRETRAINED_MODEL_DIR
from lerobot.utils.utils import flatten_dict
from torch import Tensor
from tqdm import trange

from lerobot_wmrl.common.constants import KINDS, POLICY, START_KIND, START_SEED
from lerobot_wmrl.common.exploration import ExplorationNoise
from lerobot_wmrl.common.policies import load_policy, load_processors, read_policy_config
from lerobot_wmrl.common.presets import Flags, format_flags
from lerobot_wmrl.common.processes import run_subcommand
from lerobot_wmrl.data.budget import Ledger, spending
from lerobot_wmrl.data.embodiment import HIGH, LOW, Embodiment
from lerobot_wmrl.data.episodes import open_dataset, read_episodes
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.rl.observations import to_bytes

DERIVED = ("features", "features_map", "cameras")
"""Settings of an environment that are derived from others, or that the caller passes itself."""

Observation = dict[str, Any]


class Recorder(Protocol):
    """Records what a policy does in `real_env`."""

    def record(
        self, checkpoint: Path, episodes: int, seed: int, folder: Path, exploration: float = 0.0
    ) -> None:
        """Record a dataset in `folder`, or complete it after a kill. Episode i starts from `seed` + i.

        Args:
            checkpoint: of the policy.
            episodes: how many.
            seed: of the first one.
            folder: of the dataset.
            exploration: largest noise on the actions, as a share of half their range.
        """


@dataclass(frozen=True)
class ManiSkillRecorder:
    """Records in ManiSkill with lerobot-wmrl-record, in a process of its own.

    Args:
        env: the environment.
        num_workers: simulators at once.
        cameras: names of the recorded cameras.
        depth: whether depth is recorded too.
        budget: ledger in which the episodes are entered; None without.
    """

    env: WmrlManiSkillEnv
    num_workers: int
    cameras: Sequence[str]
    depth: bool
    budget: Path | None = None

    def record(
        self, checkpoint: Path, episodes: int, seed: int, folder: Path, exploration: float = 0.0
    ) -> None:
        flags: Flags = {
            "policy.path": str(checkpoint / PRETRAINED_MODEL_DIR), **env_flags(self.env),
            "env.cameras": str(list(self.cameras)), "depth": self.depth, "num_workers": self.num_workers,
            "num_episodes": episodes, "seed": seed, "exploration": exploration, "output_dir": str(folder),
            **budget_flags(self.budget),
        }  # fmt: skip
        run_subcommand(["lerobot-wmrl-record", *format_flags(flags)])


@dataclass(frozen=True)
class EnvRecorder:
    """Records in any environment of LeRobot's, one episode after the other, with LeRobot's own rollout.

    Args:
        env: the environment; if it has several tasks, they take turns.
        robot: names and range of the actions, and names of the state, as the world model has them.
        device: of the policy.
        budget: ledger in which the episodes are entered; None without.
    """

    env: EnvConfig
    robot: Embodiment
    device: str
    budget: Path | None = None

    def record(
        self, checkpoint: Path, episodes: int, seed: int, folder: Path, exploration: float = 0.0
    ) -> None:
        ledger = None if self.budget is None else Ledger(self.budget)
        if not folder.is_dir():
            if ledger is not None:
                ledger.require_left({spending(POLICY): episodes})
            partial = folder.with_name(f".{folder.name}.partial")
            shutil.rmtree(partial, ignore_errors=True)
            self._record(checkpoint, episodes, seed, partial, exploration)
            partial.replace(folder)
        if ledger is not None:
            ledger.charge(read_episodes(open_dataset(folder)))

    def _record(self, checkpoint: Path, episodes: int, seed: int, folder: Path, exploration: float) -> None:
        path = str(checkpoint / PRETRAINED_MODEL_DIR)
        config = read_policy_config(path, [f"--device={self.device}"])
        policy, processors = load_policy(config), load_processors(config)
        env_processors = make_env_pre_post_processors(self.env, config)
        made = self.env.create_envs(1, use_async_envs=False)
        envs = [env for tasks in made.values() for env in tasks.values()]
        dataset = None
        try:
            for episode in trange(episodes, desc="Recording rollouts", unit="episode"):
                noise = ExplorationNoise(exploration, seed + episode, self._scale())
                seen = Witness(*processors, noise, self.robot)
                taken = rollout(
                    envs[episode % len(envs)], policy, *env_processors, seen.preprocess, seen.postprocess,
                    seeds=[seed + episode],
                )  # fmt: skip
                dataset = dataset or self._create(folder, seen.observations[0])
                add_episode(dataset, seen, taken, seed + episode)
        finally:
            for env in envs:
                env.close()
        assert dataset is not None
        dataset.finalize()

    def _scale(self) -> np.ndarray:
        return (np.array(self.robot.action_high) - np.array(self.robot.action_low)) / 2

    def _create(self, folder: Path, observation: Observation) -> LeRobotDataset:
        """Create an empty dataset for what this observation shows."""
        names = {OBS_STATE: self.robot.state_names}
        features: dict[str, dict[str, Any]] = {
            key: {"dtype": "float32", "shape": tuple(value.shape[1:]), "names": names.get(key) or None}
            for key, value in observation.items()
            if isinstance(value, Tensor) and not key.startswith(OBS_IMAGE)
        }
        for key, value in observation.items():
            if key.startswith(OBS_IMAGE):
                _, channels, height, width = value.shape
                shape = (height, width, channels)
                features[key] = {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}
        flag, whole = ({"dtype": kind, "shape": (1,), "names": None} for kind in ("bool", "int64"))
        features |= {
            ACTION: {
                "dtype": "float32", "shape": (len(self.robot.action_names),),
                "names": self.robot.action_names,
                "info": {LOW: self.robot.action_low, HIGH: self.robot.action_high},
            },
            "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
            "next.success": flag, "next.done": flag,
            START_SEED: whole, START_KIND: whole,
        }  # fmt: skip
        return LeRobotDataset.create(
            f"local/{folder.name.strip('.')}", self.env.fps, features, root=folder, use_videos=False
        )


@dataclass
class Witness:
    """Stands beside a policy's processors, keeps what the policy saw and did, and adds noise to it.

    Args:
        before, after: the policy's pre- and postprocessor.
        noise: what is added to each action.
        robot: whose range the actions keep.
    """

    before: Any
    after: Any
    noise: ExplorationNoise
    robot: Embodiment
    observations: list[Observation] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)

    def preprocess(self, observation: Observation) -> Observation:
        """Keep an observation in LeRobot's names, batch of one, and prepare it for the policy."""
        self.observations.append(dict(observation))
        prepared: Observation = self.before(observation)
        return prepared

    def postprocess(self, action: Tensor) -> Tensor:
        """Return the policy's action in the dataset's units, with noise, within its range. (1, A)"""
        chosen = self.after(action).cpu().numpy()[0] + self.noise()
        kept = np.clip(chosen, self.robot.action_low, self.robot.action_high).astype(np.float32)
        self.actions.append(kept)
        return torch.from_numpy(kept)[None]


def add_episode(dataset: LeRobotDataset, seen: Witness, taken: dict[str, Tensor], seed: int) -> None:
    """Add an episode of which `taken` holds reward, success and done as LeRobot's rollout returns them."""
    length = int(taken["done"][0].int().argmax()) + 1
    for step in range(length):
        observation = seen.observations[step]
        frame: dict[str, Any] = {
            key: to_bytes(value[0]).permute(1, 2, 0).cpu().numpy()
            if key.startswith(OBS_IMAGE)
            else value[0].cpu().numpy().astype(np.float32)
            for key, value in observation.items()
            if isinstance(value, Tensor)
        }
        dataset.add_frame({
            **frame, ACTION: seen.actions[step],
            "next.reward": np.array([float(taken["reward"][0, step])], np.float32),
            "next.success": np.array([bool(taken["success"][0, step])]),
            "next.done": np.array([step == length - 1]),
            START_SEED: np.array([seed]), START_KIND: np.array([KINDS.index(POLICY)]),
            "task": next(iter(observation.get("task") or [""])),
        })  # fmt: skip
    dataset.save_episode()


def budget_flags(budget: Path | None) -> Flags:
    """Return the flag that keeps a command within the budget of this training, if it has one."""
    return {} if budget is None else {"budget": str(budget)}


def env_flags(env: EnvConfig) -> Flags:
    """Return `env.type` and the settings that differ from their defaults, as a command takes them."""
    given, default = (flatten_dict(draccus.encode(each, EnvConfig), sep=".") for each in (env, type(env)()))
    differing = [name for name in given if given[name] != default.get(name)]
    chosen = {
        name
        for name in given
        if name.endswith(".type") and any(each.startswith(name.removesuffix("type")) for each in differing)
    }
    kept = [name for name in given if name in {*differing, *chosen} and name.split(".")[0] not in DERIVED]
    return {"env.type": env.type, **{f"env.{name}": given[name] for name in kept}}

"""Configuration of the world model as an environment."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
from lerobot.configs.rewards import RewardModelConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from lerobot_wmrl.common.constants import FPS, TASKS
from lerobot_wmrl.data.dataset_source import DatasetSource
from lerobot_wmrl.envs.uncertainty import Uncertainty
from lerobot_wmrl.rewards.configuration_general import GeneralConfig


@dataclass
class StartFrames(DatasetSource):
    """Where imagined episodes begin: in the first frames of a LeRobotDataset's episodes, in saved frames, or
    in ManiSkill's resets.

    Args:
        frames: a file by numpy.savez, in place of a dataset: `observation.images.<camera>` (K, H, W, 3)
            uint8, `observation.state` (K, P) and `task` (K,), the instructions.
        resets: start frames to take from ManiSkill, in place of a dataset, of `tasks` (push by default),
            `scenes` and the split `ind` (by default) or `ood`.
        split: `train` (what the world model was trained on), `validation` (held out) or `all`; `ind` or
            `ood`, scenes that training may see and those held out. Joined by a comma: what is in both.
        tasks, scenes: only episodes of these tasks (by name) and scenes (by index).
        max_starts: at most so many episodes or saved frames, drawn evenly; each needs a goal frame.
        past: frames of each episode of the dataset that the world model is shown, with what was done in
            them, before it imagines on from the next one.
    """

    split: str = "all"
    tasks: list[str] | None = None
    scenes: list[int] | None = None
    max_starts: int = 256
    past: int = 0
    frames: Path | None = None
    resets: int = 0

    def check(self) -> None:
        """ValueError unless there is exactly one place to begin in, and what is chosen of it can be."""
        given = [name for name in ("root", "frames", "resets") if getattr(self, name)]
        if len(given) != 1:
            raise ValueError(
                f"--env.dataset: starts are given by {' and '.join(given) or 'nothing'}; give one of "
                "--env.dataset.root, --env.dataset.frames and --env.dataset.resets"
            )
        if self.past < 0 or (self.past and not self.root):
            raise ValueError(
                f"--env.dataset.past={self.past}: the frames before a start are those of --env.dataset.root, "
                "at least 0; saved frames and resets have none"
            )
        if self.frames and (self.tasks or self.scenes or self.split != "all"):
            raise ValueError(
                "--env.dataset.frames: saved frames do not say their task, scene or split; leave out "
                "--env.dataset.tasks, --env.dataset.scenes and --env.dataset.split"
            )
        if self.resets and self.split not in ("all", "ind", "ood"):
            raise ValueError(
                f"--env.dataset.split={self.split}: ManiSkill's resets are of ind or ood, which none was "
                "trained on; choose one"
            )
        if self.resets < 0:
            raise ValueError(f"--env.dataset.resets={self.resets}: must be at least 1")


@EnvConfig.register_subclass("world_model")
@dataclass
class WorldModelEnv(EnvConfig):
    """The action world model answers a policy; the text world model sets the goal (method: Algorithm 1).

    Args:
        world_model_path: the action world model, a checkpoint or the output folder of its training.
        text_world_model_path: the text world model, for goal frames; not needed by rewards that know no goal.
        dataset: start frames and instructions.
        reward: `--env.reward.type=general` and its settings, or `embedding` or `proxy` with the output folder
            of its training as `--env.reward.pretrained_path`; or one of LeRobot's own, such as
            `reward_classifier`.
        episode_length: frames after which an episode is truncated.
        done_threshold: θ_sps of eq. 7. done_frames: k, consecutive frames that must reach it.
        uncertainty: what becomes of episodes that the world model is not sure of; see `--env.uncertainty.*`.
        device: where the models live; the best there is by default.
    """

    task: str | None = "imagination"
    fps: int = FPS
    world_model_path: str = ""
    text_world_model_path: str = ""
    dataset: StartFrames = field(default_factory=StartFrames)
    reward: RewardModelConfig = field(default_factory=GeneralConfig)
    episode_length: int = 40
    done_threshold: float = 0.5
    done_frames: int = 3
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    device: str | None = None
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(7,))}
    )
    features_map: dict[str, str] = field(default_factory=lambda: {ACTION: ACTION, "agent_pos": OBS_STATE})

    def __post_init__(self) -> None:
        """Describe observation and action as the world model's checkpoint has them."""
        for name in ("episode_length", "done_frames"):
            if getattr(self, name) < 1:
                raise ValueError(f"--env.{name}={getattr(self, name)}: must be at least 1")
        if self.episode_length < self.done_frames:
            raise ValueError(
                f"--env.episode_length={self.episode_length}: shorter than the {self.done_frames} frames "
                "for which done must hold, so no episode could succeed; raise it, or lower --env.done_frames"
            )
        if not 0 < self.done_threshold < 1:
            raise ValueError(f"--env.done_threshold={self.done_threshold}: must be a probability")
        if self.dataset.max_starts < 1:
            raise ValueError(f"--env.dataset.max_starts={self.dataset.max_starts}: must be at least 1")
        self.uncertainty.check()
        unknown = sorted({*(self.dataset.tasks or ())} - {*TASKS})
        if unknown:
            raise ValueError(f"--env.dataset.tasks={unknown}: choose from {', '.join(TASKS)}")
        if not self.world_model_path:
            return
        if getattr(self.reward, "needs_goal", False) and not self.text_world_model_path:
            raise ValueError(
                "--env.text_world_model_path is missing: the dense part of the general reward needs goal "
                "frames; give a text world model, or --env.reward.type=general --env.reward.alpha=1"
            )
        from lerobot_wmrl.world_models.checkpoint import read_config

        model: Any = read_config(self.world_model_path, "action_world_model")
        self.features[ACTION] = PolicyFeature(type=FeatureType.ACTION, shape=(model.action_size,))
        if model.state_size:
            self.features["agent_pos"] = PolicyFeature(type=FeatureType.STATE, shape=(model.state_size,))
        for camera in model.cameras:
            shape = (model.image_size, model.image_size, 3)
            self.features[f"pixels/{camera}"] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)
            self.features_map[f"pixels/{camera}"] = f"{OBS_IMAGES}.{camera}"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_tensor_env(self, n_envs: int, device: str | None = None) -> gym.vector.VectorEnv:
        """`n_envs` imaginations in one batch, tensors on the device: what PPO steps."""
        from lerobot_wmrl.envs.world_model_env import make_world_model_env

        return make_world_model_env(self, n_envs, device or self.device)

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """The same behind numpy and one for each task, for lerobot-eval. Batched natively, so
        `use_async_envs` changes nothing."""
        from lerobot_wmrl.envs.evaluation_adapter import EvaluationAdapter
        from lerobot_wmrl.envs.world_model_env import make_task_envs

        envs = make_task_envs(self, n_envs, self.device)
        return {self.type: {task: EvaluationAdapter(env) for task, env in envs.items()}}

"""Configuration of ManiSkill as an environment, `--env.type=wmrl_maniskill`.

Importing it imports no simulator: that happens when an environment is built.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from lerobot_wmrl.common.errors import FieldError, require_at_least
from lerobot_wmrl.maniskill.backend import render_backend, require_simulator
from lerobot_wmrl.maniskill.cameras import CAMERAS, IMAGE_SIZE, ROBOT_MESH_DETAIL, Rendering
from lerobot_wmrl.maniskill.embodiment import ACTION_NAMES, FPS, STATE_NAMES
from lerobot_wmrl.maniskill.objects import describe_assets, read_assets
from lerobot_wmrl.maniskill.scenes import Scene, scenes_of, with_meshes
from lerobot_wmrl.maniskill.tasks import tasks_of
from lerobot_wmrl.rewards.general import RuleBasedReward

if TYPE_CHECKING:
    import gymnasium as gym

    from lerobot_wmrl.maniskill.batched import BatchedSimulation
    from lerobot_wmrl.maniskill.simulation import Simulation


@EnvConfig.register_subclass("wmrl_maniskill")
@dataclass
class WmrlManiSkillEnv(EnvConfig):
    """ManiSkill with this project's tasks and scenes.

    Args:
        task: push, pull, pick_place or move_to_aim; or several of them (`push,pull`), in turn.
        split: `ind` (scenes that training may see) or `ood` (scenes held out).
        scenes: indices of scenes within the split (`lerobot-wmrl-record --list_scenes=true`); all by default.
        cameras: cameras that the policy sees.
        image_size: side of the square images in pixels.
        episode_length: steps after which an episode is truncated; each task's own horizon by default.
        reward: what a step pays for success and for progress.
        assets: YAML file with meshes to use in place of objects (`lemon: {mesh: lemon.obj, scale: 0.001}`).
        robot_mesh_detail: share of the robot's triangles that are drawn; 1 draws all, three times slower.
        batched: let all episodes share one simulation on CUDA. By default each has a process of its own.
    """

    task: str | None = "push"
    split: str = "ind"
    scenes: list[int] | None = None
    cameras: list[str] = field(default_factory=lambda: ["third_view"])
    image_size: int = IMAGE_SIZE
    episode_length: int | None = None
    reward: RuleBasedReward = field(default_factory=RuleBasedReward)
    assets: Path | None = None
    robot_mesh_detail: float = ROBOT_MESH_DETAIL
    batched: bool = False
    fps: int = FPS
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._validate()
        picture = PolicyFeature(type=FeatureType.VISUAL, shape=(self.image_size, self.image_size, 3))
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(len(ACTION_NAMES),)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(len(STATE_NAMES),)),
            **{f"pixels/{camera}": picture for camera in self.cameras},
        }
        self.features_map = {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            **{f"pixels/{camera}": f"{OBS_IMAGES}.{camera}" for camera in self.cameras},
        }

    def _validate(self) -> None:
        if not self.cameras or not {*self.cameras} <= {*CAMERAS}:
            raise FieldError("cameras", self.cameras, f"choose from {', '.join(CAMERAS)}")
        require_at_least(self, 16, "image_size")
        if self.episode_length is not None:
            require_at_least(self, 1, "episode_length")
        if not 0.0 < self.robot_mesh_detail <= 1.0:
            raise FieldError("robot_mesh_detail", self.robot_mesh_detail, "must be above 0 and at most 1")
        if self.assets is not None:
            read_assets(self.assets)

    def selected_scenes(self) -> tuple[Scene, ...]:
        """Return the scenes of the episodes. FieldError if task, split or scenes are unknown."""
        tasks_of(self.task)
        return scenes_of(self.split, self.scenes)

    @property
    def task_names(self) -> list[str]:
        """Names of the tasks. FieldError if one is unknown or named twice."""
        return [task.name for task in tasks_of(self.task)]

    def each_task(self) -> list["WmrlManiSkillEnv"]:
        """Return this configuration for each task alone."""
        return [replace(self, task=name) for name in self.task_names]

    @property
    def horizon(self) -> int:
        """Steps after which an episode is truncated, of the longest task."""
        return self.episode_length or max(task.horizon for task in tasks_of(self.task))

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"config": self}

    def observation_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of a policy's observations by LeRobot's names, images channels first."""
        image = (3, self.image_size, self.image_size)
        images = {f"{OBS_IMAGES}.{camera}": image for camera in self.cameras}
        return {**images, OBS_STATE: (len(STATE_NAMES),)}

    def create_simulation(self, depth: bool = False) -> "Simulation":
        """Return a simulator of the first task, these scenes and cameras, in this process."""
        require_simulator()
        from lerobot_wmrl.maniskill.simulation import Simulation

        return Simulation(tasks_of(self.task)[0], self._scenes_with_meshes(), self._rendering(depth))

    def create_batched_simulation(self, n_envs: int, device: str) -> "BatchedSimulation":
        """Return a simulator of `n_envs` episodes of one task at once.

        Raises:
            FieldError: there are several tasks.
        """
        require_simulator()
        from lerobot_wmrl.maniskill.batched import BatchedSimulation

        task, *more = tasks_of(self.task)
        if more:
            raise FieldError(
                "task",
                self.task,
                "a batched simulation has one task",
                "choose one, or set `batched` to false",
            )
        scenes = self._scenes_with_meshes()
        return BatchedSimulation(task, scenes, self._rendering(depth=False), n_envs, device)

    def describe_assets(self) -> dict[str, Any] | None:
        """Describe the user's own meshes by their content; None if there are none."""
        return None if self.assets is None else describe_assets(self.assets)

    def _scenes_with_meshes(self) -> tuple[Scene, ...]:
        meshes = {} if self.assets is None else read_assets(self.assets)
        return with_meshes(self.selected_scenes(), meshes)

    def _rendering(self, depth: bool) -> Rendering:
        return Rendering(tuple(self.cameras), self.image_size, depth, self.robot_mesh_detail)

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, "gym.vector.VectorEnv"]]:
        """Return {task: {0: environments}}, as lerobot-eval wants it: a suite for each task."""
        require_simulator()
        if self.runs_batched("cuda"):
            from lerobot_wmrl.envs.batched_maniskill_env import BatchedManiSkillEnv
            from lerobot_wmrl.envs.evaluation_adapter import EvaluationAdapter

            made: list[Any] = [EvaluationAdapter(BatchedManiSkillEnv(self, n_envs, "cuda", False))]
        else:
            from lerobot_wmrl.envs.maniskill_env import make_vector_env

            made = [
                make_vector_env([each] * n_envs, use_async_envs, freeze=True) for each in self.each_task()
            ]
        return {name: {0: each} for name, each in zip(self.task_names, made, strict=True)}

    def create_tensor_env(self, n_envs: int, device: str) -> "gym.vector.VectorEnv":
        """Return `n_envs` simulators with tensors on `device`, for reinforcement learning."""
        require_simulator()
        if self.runs_batched(device):
            from lerobot_wmrl.envs.batched_maniskill_env import BatchedManiSkillEnv

            return BatchedManiSkillEnv(self, n_envs, device, restart=True)
        from lerobot_wmrl.envs.maniskill_env import ManiSkillTensorEnv

        return ManiSkillTensorEnv(self, n_envs, device)

    def runs_batched(self, device: str) -> bool:
        """Return whether episodes share one simulation on `device`. FieldError if it cannot."""
        if not self.batched:
            return False
        import torch

        if not (device.startswith("cuda") and torch.cuda.is_available() and render_backend() == "gpu"):
            raise FieldError(
                "batched", self.batched, f"SAPIEN cannot simulate and render on {device} here", "leave it out"
            )
        return True

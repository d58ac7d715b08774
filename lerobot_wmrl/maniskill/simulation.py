"""The simulator: a ManiSkill table with a Panda (`TabletopEnv`), and one episode on it at a time in numpy
(`Simulation`), which the recorder and the environments drive.

Every object and container of the scenes is built once. Only the active scene's things stand on the table; the
others are parked out of sight. Changing the scene therefore costs nothing, where rebuilding it would cost
most of a second."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.structs.types import SimConfig
from transforms3d.euler import euler2quat

from lerobot_wmrl.maniskill.actors import build_carpet, build_container, build_object, build_table
from lerobot_wmrl.maniskill.backend import render_backend
from lerobot_wmrl.maniskill.cameras import Rendering
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW, FPS
from lerobot_wmrl.maniskill.episode import WORKSPACE_FLOOR, Frame, RunningEpisode
from lerobot_wmrl.maniskill.objects import CONTAINERS, ObjectSpec
from lerobot_wmrl.maniskill.rendering import AMBIENT, SUN, SUN_DIRECTION, camera_config
from lerobot_wmrl.maniskill.robot import (
    BASE_POSITION,
    CONTROL_MODE,
    GRIPPER_OPEN,
    BaseAxesPanda,
    InverseKinematics,
    lighten_meshes,
)
from lerobot_wmrl.maniskill.scenes import Scene
from lerobot_wmrl.maniskill.tasks import Situation, Start, Task

PHYSICS_STEPS: Final = 4
"""Physics steps per control step."""

TABLE_POSITION: Final = (-0.1, 0.0, -0.05)
PARKING: Final = (-3.0, 3.0, 0.3)
"""Where the first of the parked things stands (m); the others stand in a row beside it."""

CARPET: Final = "carpet"
ANGULAR_DAMPING: Final = 5.0
"""Makes round objects come to rest."""


class TabletopEnv(BaseEnv):
    """One robot, one table, the things of some scenes. `Simulation`, which owns it, takes the pictures.

    Args:
        scenes: the scenes that may be set up.
        rendering: which pictures are taken.
        num_envs: tables beside each other; 1 on the CPU.
        sim_backend: ManiSkill's name of the physics.
        **kwargs: passed on to ManiSkill.
    """

    SUPPORTED_ROBOTS = [BaseAxesPanda.uid]  # noqa: RUF012 (ManiSkill's own declaration)
    agent: BaseAxesPanda

    def __init__(
        self,
        scenes: Sequence[Scene],
        rendering: Rendering,
        num_envs: int = 1,
        sim_backend: str = "physx_cpu",
        **kwargs: Any,
    ) -> None:
        self.scenes, self.rendering = {scene.index: scene for scene in scenes}, rendering
        super().__init__(
            num_envs=num_envs,
            obs_mode="none",
            reward_mode="none",
            control_mode=CONTROL_MODE,
            robot_uids=BaseAxesPanda.uid,
            sim_backend=sim_backend,
            **kwargs,
        )

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(sim_freq=PHYSICS_STEPS * FPS, control_freq=FPS)

    @property
    def _default_sensor_configs(self) -> list[Any]:
        size, robot = self.rendering.image_size, self.agent.robot
        return [camera_config(name, size, robot) for name in self.rendering.cameras]

    def _load_agent(self, options: dict, *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, sapien.Pose(p=BASE_POSITION))
        if self.rendering.robot_mesh_detail < 1.0:
            lighten_meshes(self.agent.robot, self.rendering.robot_mesh_detail)

    def _load_scene(self, options: dict) -> None:
        names = {kind: _names(self.scenes.values(), kind) for kind in ("object", "container", "table")}
        specs = {scene.object: scene.object_spec for scene in self.scenes.values()}
        movable = [specs[name] for name in names["object"]]
        self.parking = self.parking_places(movable, [*names["container"], *names["table"], CARPET])
        places, scene = self.parking, self.scene
        self.objects = {spec.name: build_object(scene, spec, places[spec.name]) for spec in movable}
        self.containers = {n: build_container(scene, CONTAINERS[n], places[n]) for n in names["container"]}
        self.carpets = {CARPET: build_carpet(scene, places[CARPET])}
        self.tables = {n: build_table(scene, n, places[n]) for n in names["table"]}
        for actor in self.objects.values():
            for body in actor._bodies:
                body.set_angular_damping(ANGULAR_DAMPING)
        self.inverse_kinematics = InverseKinematics(self.agent)

    def parking_places(self, movable: Sequence[ObjectSpec], fixed: Sequence[str]) -> dict[str, sapien.Pose]:
        """Return where each thing is while no episode needs it.

        Args:
            movable: the objects.
            fixed: names of what never moves by itself: containers, tables, the mat.
        """
        names = [*(spec.name for spec in movable), *fixed]
        return {
            name: sapien.Pose(p=[PARKING[0], PARKING[1] + 3.0 * index, PARKING[2]])
            for index, name in enumerate(names)
        }

    def _load_lighting(self, options: dict) -> None:
        self.scene.set_ambient_light(AMBIENT)
        self.scene.add_directional_light(
            direction=SUN_DIRECTION,
            color=SUN,
            shadow=True,  # the gripper's shadow shows its height
            shadow_scale=0.4,
            shadow_near=-1.5,
            shadow_far=1.5,
            shadow_map_size=256,
        )

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        """Do nothing: `place` puts everything where the task's start says."""

    def place(self, scene: Scene, start: Start) -> None:
        """Put the scene's things and the robot where the episode starts, at rest."""
        places = arrangement(scene, start)
        for actors in (self.tables, self.containers, self.carpets, self.objects):
            _show_only(actors, places, self.parking)
        self.active = self.objects[scene.object]
        self.agent.reset(self.start_qpos(start))
        self.agent.controller.reset()

    def start_qpos(self, start: Start) -> np.ndarray:
        """Return the robot's joint positions (9,) at the start."""
        return self.inverse_kinematics.solve(start.tcp, GRIPPER_OPEN if start.gripper_open else 0.0)


def arrangement(scene: Scene, start: Start) -> dict[str, sapien.Pose]:
    """Return the poses of the table and of what stands on it, by name."""
    height = scene.object_spec.half_size[2]
    places = {
        scene.table: sapien.Pose(p=TABLE_POSITION),
        scene.container: sapien.Pose(p=[*start.container_xy, 0.0]),
        scene.object: sapien.Pose(p=[*start.object_xy, height], q=euler2quat(0, 0, start.object_yaw)),
    }
    if start.carpet_xy is not None:
        places[CARPET] = sapien.Pose(p=[*start.carpet_xy, 0.0])
    return places


def _names(scenes: Iterable[Scene], field: str) -> list[str]:
    return sorted({getattr(scene, field) for scene in scenes})


def _show_only(
    actors: dict[str, Any], places: dict[str, sapien.Pose], parking: dict[str, sapien.Pose]
) -> None:
    """Put the actors that `places` names there, at rest; park the others: hidden, immovable, far away."""
    for name, actor in actors.items():
        entity = actor._objs[0]
        body = entity.find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)
        visual = entity.find_component_by_type(sapien.render.RenderBodyComponent)
        visual.visibility = float(name in places)
        entity.set_pose(places.get(name, parking[name]))
        if actor.px_body_type == "dynamic":
            body.set_kinematic(name not in places)
            if name in places:
                body.set_linear_velocity(np.zeros(3))
                body.set_angular_velocity(np.zeros(3))


class Simulation:
    """A ManiSkill table that plays episodes of one task in some scenes.

    Args:
        task: defines starts, success and reward; another task may be set before a reset.
        scenes: the scenes that may be asked for, with a user's meshes if there are any.
        rendering: which pictures are taken.
    """

    def __init__(self, task: Task, scenes: Sequence[Scene], rendering: Rendering) -> None:
        self.task, self.rendering = task, rendering
        self.env = TabletopEnv(scenes, rendering, render_backend=render_backend())
        self.env.reset(seed=0)
        self.cameras = {name: self.env._sensors[name].camera._render_cameras[0] for name in rendering.cameras}
        self._low, self._high = np.array(ACTION_LOW, np.float32), np.array(ACTION_HIGH, np.float32)

    def reset(self, scene: Scene, seed: int) -> Frame:
        """Set up the start of (task, scene, seed). The same arguments give the same frame."""
        self.episode = RunningEpisode(self.task, self.env.scenes[scene.index], seed)
        self.env.place(self.episode.scene, self.episode.start)
        self.episode.begin(self.object_position)
        return self._frame()

    def step(self, action: np.ndarray) -> Frame:
        """Apply one action (7,), clipped to the action box and to the workspace, for one control step.

        Raises:
            ValueError: it contains NaN.
        """
        values = np.asarray(action, np.float32)
        if np.isnan(values).any():
            raise ValueError(f"action: NaN in {values.tolist()}; nothing can be simulated after it")
        clipped = np.clip(values, self._low, self._high)
        clipped[2] = max(clipped[2], WORKSPACE_FLOOR - self.tcp_position[2])
        self.episode.object_before = self.object_position
        self.env.step(torch.from_numpy(clipped)[None])
        return self._frame()

    @property
    def current_start(self) -> Start:
        """Start of the running episode."""
        return self.episode.start

    @property
    def instruction(self) -> str:
        """Instruction of the running episode."""
        return self.current_start.instruction

    @property
    def object_position(self) -> np.ndarray:
        """Centre of the object (3,), metres."""
        return np.asarray(self.env.active._objs[0].pose.p, np.float64)

    @property
    def gripper_opening(self) -> float:
        """From 0 (closed) to 1 (open)."""
        return float(np.clip(self.env.agent.robot._objs[0].qpos[-1] / GRIPPER_OPEN, 0.0, 1.0))

    @property
    def tcp_position(self) -> np.ndarray:
        """Position of the tool centre point (3,), metres."""
        return np.asarray(self.env.agent.tcp._objs[0].entity.pose.p, np.float64)

    def situation(self) -> Situation:
        """Return what the task judges now."""
        return self.episode.situation(self.object_position, self.tcp_position, self.gripper_opening)

    def close(self) -> None:
        """Release ManiSkill's environment."""
        self.env.close()

    def _frame(self) -> Frame:
        situation = self.situation()
        images, depth = self._take_pictures()
        reward, success = self.task.reward(situation), self.task.success(situation)
        return Frame(images, depth, self._state(), reward, success)

    def _state(self) -> np.ndarray:
        pose = self.env.agent.tcp._objs[0].entity.pose
        return np.array([*pose.p, *continuous(pose.q), self.gripper_opening], np.float32)

    def _take_pictures(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Take images and, if asked for, depth with every camera."""
        images: dict[str, np.ndarray] = {}
        depth: dict[str, np.ndarray] = {}
        if self.cameras:
            self.env.scene.sub_scenes[0].update_render()
        for name, camera in self.cameras.items():
            camera.take_picture()
            images[name] = np.ascontiguousarray(camera.get_picture("Color")[..., :3])
            if self.rendering.depth:
                backwards = camera.get_picture("PositionSegmentation")[..., 2:3]
                depth[name] = np.negative(backwards).astype(np.uint16)
        return images, depth


def continuous(quaternion: np.ndarray) -> np.ndarray:
    """Return q or −q, the same rotation: the one nearer to a hand that points down, (0, 1, 0, 0) wxyz.

    Otherwise the sign would jump while nothing moves, which dominates statistics and losses.
    """
    return -quaternion if quaternion[1] < 0 else quaternion

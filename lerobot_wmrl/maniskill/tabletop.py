"""The ManiSkill environment: a Panda at a table, with every object and container of some scenes built once.

Only the active scene's things stand on the table; the others are parked out of sight. Changing the scene
therefore costs nothing, where rebuilding it would cost most of a second.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.structs.types import SimConfig
from transforms3d.euler import euler2quat

from lerobot_wmrl.common.constants import FPS
from lerobot_wmrl.maniskill.actors import build_carpet, build_container, build_object, build_table
from lerobot_wmrl.maniskill.cameras import camera_config
from lerobot_wmrl.maniskill.objects import CONTAINERS, OBJECTS
from lerobot_wmrl.maniskill.rendering import AMBIENT, SUN, SUN_DIRECTION, Rendering
from lerobot_wmrl.maniskill.robot import (
    BASE_POSITION,
    CONTROL_MODE,
    GRIPPER_OPEN,
    BaseAxesPanda,
    InverseKinematics,
    lighten_meshes,
)
from lerobot_wmrl.maniskill.scenes import Scene
from lerobot_wmrl.maniskill.tasks import Start

PHYSICS_STEPS = 4
"""Physics steps a control step."""

TABLE_PLACE = (-0.1, 0.0, -0.05)
CARPET = "carpet"
PARKING = (-3.0, 3.0, 0.3)
ANGULAR_DAMPING = 5.0
"""Round objects come to rest."""


class TabletopEnv(BaseEnv):
    """One robot, one table, the things of `scenes`; images are taken by `Simulation`, which owns it."""

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
        self.scenes, self.rendering = tuple(scenes), rendering
        super().__init__(
            num_envs=num_envs, obs_mode="none", reward_mode="none", control_mode=CONTROL_MODE,
            robot_uids=BaseAxesPanda.uid, sim_backend=sim_backend, **kwargs,
        )  # fmt: skip

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
        names = {kind: _names(self.scenes, kind) for kind in ("object", "container", "table")}
        self.parking = self.parking_places(names["object"], [*names["container"], *names["table"], CARPET])
        places, scene = self.parking, self.scene
        self.objects = {n: build_object(scene, OBJECTS[n], places[n]) for n in names["object"]}
        self.containers = {n: build_container(scene, CONTAINERS[n], places[n]) for n in names["container"]}
        self.carpets = {CARPET: build_carpet(scene, places[CARPET])}
        self.tables = {n: build_table(scene, n, places[n]) for n in names["table"]}
        for actor in self.objects.values():
            for body in actor._bodies:
                body.set_angular_damping(ANGULAR_DAMPING)
        self.inverse_kinematics = InverseKinematics(self.agent)

    def parking_places(self, movable: Sequence[str], fixed: Sequence[str]) -> dict[str, sapien.Pose]:
        """Where each thing is while no episode needs it: objects, and what never moves by itself."""
        names = [*movable, *fixed]
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
        """Nothing to draw here: `place` puts everything where the task's start says."""

    def place(self, scene: Scene, start: Start) -> None:
        """Put the scene's things and the robot where the episode starts, at rest."""
        places = arrangement(scene, start)
        for actors in (self.tables, self.containers, self.carpets, self.objects):
            _show_only(actors, places, self.parking)
        self.active = self.objects[scene.object]
        self.agent.reset(self.start_qpos(start))
        self.agent.controller.reset()

    def start_qpos(self, start: Start) -> np.ndarray:
        """(9,) the robot's joint positions at the start."""
        return self.inverse_kinematics.solve(start.tcp, GRIPPER_OPEN if start.gripper_open else 0.0)


def arrangement(scene: Scene, start: Start) -> dict[str, sapien.Pose]:
    """What stands on the table, and the table itself, by name, with its pose."""
    height = OBJECTS[scene.object].half_size[2]
    places = {
        scene.table: sapien.Pose(p=TABLE_PLACE),
        scene.container: sapien.Pose(p=[*start.container_xy, 0.0]),
        scene.object: sapien.Pose(p=[*start.object_xy, height], q=euler2quat(0, 0, start.object_yaw)),
    }
    if start.carpet_xy is not None:
        places[CARPET] = sapien.Pose(p=[*start.carpet_xy, 0.0])
    return places


def _names(scenes: Sequence[Scene], field: str) -> list[str]:
    return sorted({getattr(scene, field) for scene in scenes})


def _show_only(
    actors: dict[str, Any], places: dict[str, sapien.Pose], parking: dict[str, sapien.Pose]
) -> None:
    """Put those of `places` there, at rest, and park the others: hidden, immovable and far away."""
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

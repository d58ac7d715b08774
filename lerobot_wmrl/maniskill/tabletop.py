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

from lerobot_wmrl.constants import FPS
from lerobot_wmrl.maniskill.actors import build_carpet, build_container, build_object, build_table
from lerobot_wmrl.maniskill.cameras import camera_config
from lerobot_wmrl.maniskill.objects import CONTAINERS, OBJECTS
from lerobot_wmrl.maniskill.rendering import AMBIENT, SUN, SUN_DIRECTION, Rendering
from lerobot_wmrl.maniskill.robot import (
    BASE_POSITION,
    CONTROL_MODE,
    GRIPPER_OPEN,
    BaseAxesPanda,
    lighten_meshes,
)
from lerobot_wmrl.maniskill.scenes import Scene
from lerobot_wmrl.maniskill.tasks import Start

PHYSICS_STEPS = 4
"""Physics steps a control step."""

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
        **kwargs: Any,
    ) -> None:
        self.scenes, self.rendering = tuple(scenes), rendering
        super().__init__(
            num_envs=1, obs_mode="none", reward_mode="none", control_mode=CONTROL_MODE,
            robot_uids=BaseAxesPanda.uid, sim_backend="physx_cpu", **kwargs,
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
        self.objects = {n: build_object(self.scene, OBJECTS[n]) for n in _names(self.scenes, "object")}
        self.containers = {
            n: build_container(self.scene, CONTAINERS[n]) for n in _names(self.scenes, "container")
        }
        self.carpets = {"carpet": build_carpet(self.scene)}
        self.tables = {n: build_table(self.scene, n) for n in _names(self.scenes, "table")}
        for actor in self.objects.values():
            actor._bodies[0].set_angular_damping(ANGULAR_DAMPING)
        self.rest_qpos = self.agent.keyframes["rest"].qpos.copy()
        self.rest_qpos[-2:] = 0.0

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
        _show_only(self.tables, scene.table, sapien.Pose(p=[-0.1, 0, -0.05]))
        _show_only(self.containers, scene.container, sapien.Pose(p=[*start.container_xy, 0.0]))
        carpet_xy = PARKING[:2] if start.carpet_xy is None else start.carpet_xy
        shown = None if start.carpet_xy is None else "carpet"
        _show_only(self.carpets, shown, sapien.Pose(p=[*carpet_xy, 0.0]))
        height = OBJECTS[scene.object].half_size[2]
        pose = sapien.Pose(p=[*start.object_xy, height], q=euler2quat(0, 0, start.object_yaw))
        _show_only(self.objects, scene.object, pose)
        self.active = self.objects[scene.object]
        self._place_robot(start.tcp, GRIPPER_OPEN if start.gripper_open else 0.0)

    def _place_robot(self, tcp: np.ndarray, finger: float) -> None:
        """Solve inverse kinematics from rest, so that the gripper points down at `tcp` (3,)."""
        arm = self.agent.controller.controllers["arm"]
        model = arm.kinematics.pmodel
        target = sapien.Pose(p=np.asarray(tcp) - np.array(BASE_POSITION), q=[0.0, 1.0, 0.0, 0.0])
        link = arm.kinematics.end_link_idx
        qpos, solved, _ = model.compute_inverse_kinematics(
            link, target, initial_qpos=self.rest_qpos, active_qmask=arm.kinematics.qmask, max_iterations=200
        )
        if not solved:
            raise RuntimeError(f"inverse kinematics failed for the start position {np.round(tcp, 3)}")
        qpos[-2:] = finger
        self.agent.reset(qpos)
        self.agent.controller.reset()


def _names(scenes: Sequence[Scene], field: str) -> list[str]:
    return sorted({getattr(scene, field) for scene in scenes})


def _show_only(actors: dict[str, Any], shown: str | None, pose: sapien.Pose) -> None:
    """Put `shown`, if any, at `pose` at rest, and park the others: hidden, immovable and far away."""
    for place, (name, actor) in enumerate(actors.items()):
        entity = actor._objs[0]
        body = entity.find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)
        visual = entity.find_component_by_type(sapien.render.RenderBodyComponent)
        visual.visibility = float(name == shown)
        entity.set_pose(
            pose if name == shown else sapien.Pose(p=[PARKING[0], PARKING[1] + 3.0 * place, PARKING[2]])
        )
        if actor.px_body_type == "dynamic":
            body.set_kinematic(name != shown)
            if name == shown:
                body.set_linear_velocity(np.zeros(3))
                body.set_angular_velocity(np.zeros(3))

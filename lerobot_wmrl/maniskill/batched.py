"""Many episodes in one simulation, with ManiSkill's batched physics and rendering on CUDA.

On the CPU a batch has one episode, which serves to compare it with `simulation.Simulation`. B is the number
of episodes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.utils.structs.pose import Pose
from torch import Tensor

from lerobot_wmrl.maniskill.backend import render_backend
from lerobot_wmrl.maniskill.cameras import Rendering
from lerobot_wmrl.maniskill.embodiment import ACTION_HIGH, ACTION_LOW
from lerobot_wmrl.maniskill.episode import WORKSPACE_FLOOR, RunningEpisode
from lerobot_wmrl.maniskill.objects import ObjectSpec
from lerobot_wmrl.maniskill.robot import GRIPPER_OPEN
from lerobot_wmrl.maniskill.scenes import Scene
from lerobot_wmrl.maniskill.simulation import TabletopEnv, arrangement
from lerobot_wmrl.maniskill.tasks import Situation, Task

SHELF = -6.0
"""Height (m) of the shelf for objects that no episode needs, further down than a camera sees."""

SHELF_HALF_SIZE = (1.0, 1.0, 0.05)
SHELF_SPACING = 0.35
SHELF_GAP = 0.01
"""Height above the shelf at which objects are put (m)."""

CELLAR = -9.0
"""Height (m) below which tables, containers and mats that no episode needs are put."""


class BatchedTabletopEnv(TabletopEnv):
    """B tables beside each other, each with everything that any scene needs."""

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        builder = self.scene.create_actor_builder()
        builder.add_box_collision(half_size=SHELF_HALF_SIZE)
        builder.initial_pose = sapien.Pose(p=[0.0, 0.0, SHELF - SHELF_HALF_SIZE[2]])
        builder.build_static(name="shelf")

    def parking_places(self, movable: Sequence[ObjectSpec], fixed: Sequence[str]) -> dict[str, sapien.Pose]:
        """Return places on the shelf for objects, below it for everything else."""
        side = int(np.ceil(np.sqrt(len(movable))))
        offset = SHELF_SPACING * (side - 1) / 2
        places = {name: sapien.Pose(p=[0.0, 0.0, CELLAR - index]) for index, name in enumerate(fixed)}
        for index, spec in enumerate(movable):
            x, y = (SHELF_SPACING * cell - offset for cell in divmod(index, side))
            places[spec.name] = sapien.Pose(p=[x, y, SHELF + spec.half_size[2] + SHELF_GAP])
        return places

    def place_rows(self, rows: Sequence[int], episodes: Sequence[RunningEpisode]) -> None:
        """Set up episodes on the tables `rows` (ascending): what they need at rest, everything else away."""
        self.scene._reset_mask = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.scene._reset_mask[list(rows)] = True
        layouts = [arrangement(episode.scene, episode.start) for episode in episodes]
        for name, actor in {**self.tables, **self.containers, **self.carpets, **self.objects}.items():
            poses = [layout.get(name, self.parking[name]) for layout in layouts]
            actor.set_pose(Pose.create(torch.tensor(np.array([[*p.p, *p.q] for p in poses]))).to(self.device))
        for actor in self.objects.values():
            actor.set_linear_velocity(torch.zeros(3, device=self.device))
            actor.set_angular_velocity(torch.zeros(3, device=self.device))
        qpos = np.stack([self.start_qpos(episode.start) for episode in episodes])
        self.agent.reset(torch.tensor(qpos, dtype=torch.float32, device=self.device))
        self._apply()
        self.agent.controller.reset()
        self.scene._reset_mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)

    def _apply(self) -> None:
        """Apply poses: on CUDA they are set in buffers that have to be applied and fetched again."""
        if self.gpu_sim_enabled:
            self.scene._gpu_apply_all()
            self.scene.px.gpu_update_articulation_kinematics()
            self.scene._gpu_fetch_all()


@dataclass(frozen=True)
class BatchedFrame:
    """What is observed at one control step of B episodes, on the simulation's device.

    Args:
        images: camera → (B, H, W, 3) uint8.
        state: (B, 8) float32, `embodiment.STATE_NAMES`.
        reward: (B,) float32.
        success: (B,) bool.
    """

    images: dict[str, Tensor]
    state: Tensor
    reward: Tensor
    success: Tensor


class BatchedSimulation:
    """Like `Simulation`, with B episodes of one task at once.

    Args:
        task: defines starts, success and reward.
        scenes: the scenes that may be asked for, with a user's meshes if there are any.
        rendering: which pictures are taken.
        num_envs: B; 1 on the CPU.
        device: "cpu", "cuda" or "cuda:1" and so on, of physics and pictures.
    """

    def __init__(
        self, task: Task, scenes: Sequence[Scene], rendering: Rendering, num_envs: int, device: str
    ) -> None:
        self.task, self.rendering = task, rendering
        renderer = f"sapien_{device}" if device.startswith("cuda") else render_backend()
        self.env = BatchedTabletopEnv(scenes, rendering, num_envs, f"physx_{device}", render_backend=renderer)
        self.env.reset(seed=0)
        self.device = self.env.device
        self.names = [*self.env.objects]
        self.episodes: list[RunningEpisode] = []
        self._low = torch.tensor(ACTION_LOW, device=self.device)
        self._high = torch.tensor(ACTION_HIGH, device=self.device)

    def reset(self, scenes: Sequence[Scene], seeds: Sequence[int], rows: Sequence[int]) -> BatchedFrame:
        """Set up the starts of (task, scene, seed) in some rows; the other rows go on.

        Args:
            scenes: one for each row in `rows`.
            seeds: one for each row in `rows`.
            rows: indices in ascending order; the first time all of them.

        Returns:
            The frame of all B rows.
        """
        env_scenes = [self.env.scenes[scene.index] for scene in scenes]
        started = [
            RunningEpisode(self.task, scene, seed) for scene, seed in zip(env_scenes, seeds, strict=True)
        ]
        running = {**dict(enumerate(self.episodes)), **dict(zip(rows, started, strict=True))}
        self.episodes = [running[row] for row in range(self.env.num_envs)]
        self.env.place_rows(rows, started)
        positions = self.object_positions().cpu().numpy()
        for row, episode in zip(rows, started, strict=True):
            episode.begin(positions[row])
        return self._frame()

    def step(self, actions: Tensor) -> BatchedFrame:
        """Apply actions (B, 7), clipped to the action box and to the workspace, for one control step.

        Raises:
            ValueError: if an action is NaN. On CUDA nothing else checks, and the physics of all rows is lost.
        """
        clipped = actions.to(self.device).clamp(self._low, self._high)
        if bool(clipped.isnan().any()):
            rows = clipped.isnan().any(1).nonzero().flatten().tolist()
            raise ValueError(f"action: NaN in environments {rows}; nothing can be simulated after it")
        floor = WORKSPACE_FLOOR - self.tcp_poses()[:, 2]
        clipped[:, 2] = torch.maximum(clipped[:, 2], floor)
        for episode, position in zip(self.episodes, self.object_positions().cpu().numpy(), strict=True):
            episode.object_before = position
        self.env.step(clipped)
        return self._frame()

    def object_positions(self) -> Tensor:
        """Return the centres of the objects (B, 3), metres."""
        every = torch.stack([self.env.objects[name].pose.p for name in self.names], 1)
        active = torch.tensor([self.names.index(e.scene.object) for e in self.episodes], device=self.device)
        return every[torch.arange(len(active), device=self.device), active]

    def tcp_poses(self) -> Tensor:
        """Return position and quaternion (wxyz) of the tool centre points (B, 7)."""
        return self.env.agent.tcp.pose.raw_pose

    def close(self) -> None:
        """Release ManiSkill's environment."""
        self.env.close()

    def _frame(self) -> BatchedFrame:
        opening = (self.env.agent.robot.qpos[:, -1] / GRIPPER_OPEN).clamp(0.0, 1.0)
        poses = self.tcp_poses()
        judged = [
            (self.task.reward(situation), self.task.success(situation))
            for situation in self._situations(poses[:, :3], opening)
        ]
        reward, success = zip(*judged, strict=True)
        quaternion = torch.where(poses[:, 4:5] < 0, -poses[:, 3:], poses[:, 3:])
        state = torch.cat([poses[:, :3], quaternion, opening[:, None]], 1).float()
        return BatchedFrame(
            self._images(),
            state,
            torch.tensor(reward, dtype=torch.float32, device=self.device),
            torch.tensor(success, device=self.device),
        )

    def _situations(self, tcp: Tensor, opening: Tensor) -> list[Situation]:
        """Return what the task judges, row by row, for tcp (B, 3) and opening (B,)."""
        objects, tcps = (values.cpu().numpy().astype(np.float64) for values in (self.object_positions(), tcp))
        rows = zip(self.episodes, objects, tcps, opening.tolist(), strict=True)
        return [episode.situation(*row) for episode, *row in rows]

    def _images(self) -> dict[str, Tensor]:
        if self.rendering.cameras:
            self.env.scene.update_render(update_sensors=True, update_human_render_cameras=False)
        images = {}
        for name in self.rendering.cameras:
            sensor: Any = self.env._sensors[name]
            sensor.capture()
            shown = sensor.get_obs(rgb=True, depth=False, position=False, segmentation=False)["rgb"]
            images[name] = shown.to(self.device).clone()  # the next picture is taken into the same memory
        return images

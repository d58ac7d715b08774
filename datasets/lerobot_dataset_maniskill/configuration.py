"""What to record: the flags of `lerobot-wmrl-record`."""

import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from huggingface_hub import get_token
from huggingface_hub.errors import HFValidationError
from huggingface_hub.utils import validate_repo_id
from lerobot.configs import parser
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig

from lerobot_dataset_maniskill.planners import MOTIONS
from lerobot_wmrl.common.command_line import RunConfig
from lerobot_wmrl.common.constants import EVALUATION_SEED, KINDS
from lerobot_wmrl.common.policy_checkpoints import read_policy_config
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.maniskill.tasks import task_of

POLICY_KIND = "policy"

LOCAL = "local"
"""Namespace of datasets that have no name on the hub."""


def default_kinds() -> dict[str, float]:
    """Shares of the trajectory kinds; they need not sum to 1."""
    return {"optimal": 0.20, "waypoint": 0.06, "interpolated": 0.06, "noisy": 0.13, "near_miss": 0.55}


@dataclass
class RecordConfig(RunConfig):
    """Record trajectories in ManiSkill as a LeRobotDataset.

    Planned trajectories by default; with --policy.path=… the real rollouts of that policy, or, with
    --env.type=world_model, its imagined ones. The same command again continues an interrupted recording, or
    reports that it is complete.
    `--recipe=FILE` stands for the flags in a YAML file, `--preset=tiny|demo|cpu|gpu|paper` for one of the
    recipes that come with the package; flags further right override them. `--env.type=wmrl_maniskill --help`
    lists the simulator's own flags.
    """

    path_fields: ClassVar[list[str]] = ["policy"]

    output_dir: Path | None = None
    """Root of the dataset; it appears when everything is recorded."""

    repo_id: str | None = None
    """Name of the dataset, user/name to publish it; local/<folder> by default."""

    num_episodes: int = 100
    """How many to record."""

    seed: int = 0
    """Of the first episode; episode i has seed + i."""

    tasks: list[str] = field(default_factory=list)
    """Recorded in turn; the environment's own by default."""

    env: EnvConfig = field(default_factory=WmrlManiSkillEnv)
    """Task, scenes, cameras and image size (--env.type=wmrl_maniskill --env.task=push …), or a world model,
    and the dataset whose first frames it begins with (--env.type=world_model --env.world_model_path=…)."""

    depth: bool = False
    """Record every camera's depth too, as LeRobot's depth maps (observation.images.<camera>_depth)."""

    kinds: dict[str, float] = field(default_factory=default_kinds)
    """Share of each trajectory kind (planned trajectories only)."""

    planner: str = "cartesian"
    """How the gripper gets from one waypoint of a planned trajectory to the next. cartesian: in straight
    lines. mplib: as MPLib plans it in joint space, around the table, the container and, before it is to be
    touched, the object."""

    num_workers: int = 2
    """Simulating processes."""

    part_episodes: int = 20
    """Episodes a sub-dataset, the piece of work an interruption can cost each worker."""

    shard: str = "0/1"
    """i/n records every n-th sub-dataset from the i-th (from 0) on, for n machines."""

    merge_shards: list[Path] = field(default_factory=list)
    """Folders of all shards: put them together as output_dir, and stop."""

    policy: PreTrainedConfig | None = None
    """A LeRobot policy to roll out, given as --policy.path=…."""

    exploration: float = 0.0
    """Largest standard deviation of the noise added to a policy's translations, as a share of the action box;
    each episode draws its own level up to it, and the noise lasts a while."""

    push_to_hub: bool = False
    """Publish the dataset as repo_id on the Hugging Face hub when it is complete."""

    private: bool = False
    """Publish it privately."""

    list_scenes: bool = False
    """Print the table of scenes and stop."""

    def __post_init__(self) -> None:
        path = parser.get_path_arg("policy")
        if path:
            self.policy = read_policy_config(path, parser.get_cli_overrides("policy") or [])

    def validate(self) -> None:
        """ValueError that names the field, its value and the remedy."""
        if self.output_dir is None:
            raise ValueError("--output_dir is missing: give the folder in which the dataset is to appear")
        if not isinstance(self.env, WmrlManiSkillEnv | WorldModelEnv):
            raise ValueError(f"--env.type={self.env.type}: choose wmrl_maniskill or world_model")
        for name in ("num_episodes", "num_workers", "part_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name}={getattr(self, name)}: must be at least 1")
        if self.seed < 0 or (self.policy is None and self.seed + self.num_episodes > EVALUATION_SEED):
            raise ValueError(
                f"--seed={self.seed}: the seeds of planned trajectories are from 0 to {EVALUATION_SEED - 1}; "
                "those above are for evaluation"
            )
        if not 0 <= self.exploration <= 1 or (self.exploration and self.policy is None):
            raise ValueError(
                f"--exploration={self.exploration}: a share of the action box, 0 to 1, for --policy.path only"
            )
        if self.shard_of[1] > -(-self.num_episodes // self.part_episodes):
            raise ValueError(f"--shard={self.shard}: there are fewer sub-datasets than shards")
        if self.planner not in MOTIONS:
            raise ValueError(f"--planner={self.planner}: unknown; choose one of {', '.join(MOTIONS)}")
        self._validate_kinds()
        if self.push_to_hub:
            self._validate_publishing()
        if isinstance(self.env, WorldModelEnv):
            self._validate_imagination()
        else:
            self.env.selected_scenes()
        for task in self.tasks:
            task_of(task)

    def _validate_imagination(self) -> None:
        """What only the simulator can do is not asked of a world model."""
        if self.policy is None:
            raise ValueError(
                "--env.type=world_model: give the policy that is to be imagined, --policy.path=…"
            )
        for name in ("depth", "tasks"):
            if getattr(self, name):
                raise ValueError(
                    f"--{name}={getattr(self, name)}: cannot be chosen in a world model; leave it out "
                    "(--env.dataset.tasks chooses among the starts)"
                )
        if self.imagination is not None and self.imagination.dataset.past:
            raise ValueError(
                f"--env.dataset.past={self.imagination.dataset.past}: recorded episodes begin where real "
                "ones did, so that they can be repeated in the simulator; leave it out"
            )

    def _validate_kinds(self) -> None:
        planned = [kind for kind in KINDS if kind != POLICY_KIND]
        unknown = [kind for kind in self.kinds if kind not in planned]
        if unknown or min(self.kinds.values(), default=0) < 0 or sum(self.kinds.values()) <= 0:
            raise ValueError(
                f"--kinds={self.kinds}: give shares of {', '.join(planned)}, at least one above 0"
            )

    def _validate_publishing(self) -> None:
        """What can be known before anything is recorded: the dataset's name, and that there is a token."""
        namespace, _, name = self.dataset_id.partition("/")
        if not name or namespace == LOCAL:
            raise ValueError(
                f"--push_to_hub=true: the dataset is called {self.dataset_id}; "
                "give its name on the hub, --repo_id=user/name"
            )
        if self.shard_of[1] > 1 and not self.merge_shards:
            raise ValueError(
                f"--push_to_hub=true: --shard={self.shard} is only a part; record all shards, then publish "
                "with --merge_shards"
            )
        try:
            validate_repo_id(self.dataset_id)
        except HFValidationError as error:
            raise ValueError(f"--repo_id={self.repo_id}: {error}") from error
        if get_token() is None:
            raise ValueError("--push_to_hub=true: nobody is logged in to the hub here; run `hf auth login`")

    @property
    def root(self) -> Path:
        """Of the dataset, once `validate` has made sure that it is given."""
        assert self.output_dir is not None
        return self.output_dir

    @property
    def imagination(self) -> WorldModelEnv | None:
        """The environment, if it is a world model."""
        return self.env if isinstance(self.env, WorldModelEnv) else None

    @property
    def maniskill(self) -> WmrlManiSkillEnv:
        """The environment, once `validate` has made sure of its type."""
        assert isinstance(self.env, WmrlManiSkillEnv)
        return self.env

    @property
    def shard_of(self) -> tuple[int, int]:
        """(i, n). ValueError if `shard` is not written so."""
        match = re.fullmatch(r"(\d+)/(\d+)", self.shard)
        if not match or int(match[1]) >= int(match[2]):
            raise ValueError(f"--shard={self.shard}: write i/n, with i from 0 to n - 1, as in 0/4")
        return int(match[1]), int(match[2])

    @property
    def recorded_tasks(self) -> list[str]:
        """Names of the tasks, in turn."""
        return self.tasks or [str(self.maniskill.task)]

    @property
    def dataset_id(self) -> str:
        return self.repo_id or f"{LOCAL}/{self.root.name}"

    def recorded_content(self) -> dict[str, Any]:
        """What decides the episodes, and so whether a folder continues this recording. JSON values only."""
        return {
            **(self._simulated_content() if self.imagination is None else imagined_content(self.imagination)),
            "depth": self.depth,
            "episode_length": self.env.episode_length,
            "num_episodes": self.num_episodes,
            "part_episodes": self.part_episodes,
            "shard": list(self.shard_of),
            "seed": self.seed,
            "kinds": self.kinds if self.policy is None else {POLICY_KIND: 1.0},
            "planner": self.planner if self.policy is None else None,
            "policy": None if self.policy is None else str(self.policy.pretrained_path),
            "exploration": self.exploration,
        }

    def _simulated_content(self) -> dict[str, Any]:
        env = self.maniskill
        return {
            "tasks": self.recorded_tasks,
            "scenes": [scene.index for scene in env.selected_scenes()],
            "cameras": list(env.cameras),
            "image_size": env.image_size,
            "light_jitter": env.light_jitter,
            "camera_jitter": env.camera_jitter,
            "assets": env.describe_assets(),
            "robot_mesh_detail": env.robot_mesh_detail,
        }


def imagined_content(env: WorldModelEnv) -> dict[str, Any]:
    """What decides the frames of imagined episodes, beside the policy."""
    from lerobot_wmrl.world_models.checkpoint import read_config

    model: Any = read_config(env.world_model_path, "action_world_model")
    return {
        "world_model": env.world_model_path,
        "starts": asdict(env.dataset),
        "cameras": list(model.cameras),
        "image_size": model.image_size,
        "done_threshold": env.done_threshold,
        "done_frames": env.done_frames,
        "reward": env.reward.type,
    }

"""What to record: the flags of `lerobot-wmrl-record`."""

import re
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar

import draccus
from huggingface_hub.errors import HFValidationError
from huggingface_hub.utils import validate_repo_id
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.rewards import RewardModelConfig
from lerobot.envs.configs import EnvConfig

from lerobot_dataset_maniskill.planners import MOTIONS
from lerobot_wmrl.common.checkpoints import PARTS, checkpoint_digest, resolved_name
from lerobot_wmrl.common.command_line import RunConfig
from lerobot_wmrl.common.constants import KINDS, POLICY
from lerobot_wmrl.common.errors import FieldError, require_at_least, require_choice
from lerobot_wmrl.common.files import require_no_mount
from lerobot_wmrl.common.hub import check_login
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.common.policy_checks import require_trained
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.data.dataset import DatasetSource
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.maniskill.tasks import task_of

LOCAL = "local"
"""Namespace of datasets that are not on the hub."""


def default_kinds() -> dict[str, float]:
    """Return the default share of each trajectory kind; shares need not sum to 1."""
    return {"optimal": 0.20, "waypoint": 0.06, "interpolated": 0.06, "noisy": 0.13, "near_miss": 0.55}


@dataclass
class RecordConfig(RunConfig):
    """Record trajectories in ManiSkill as a LeRobotDataset.

    By default trajectories are planned. With --policy.path=… a policy is rolled out, in ManiSkill or, with
    --env.type=world_model, in a world model. The same command again continues an interrupted recording, or
    reports that it is complete.

    `--recipe=FILE` stands for the flags in a YAML file, `--preset=tiny|demo|cpu|gpu|paper` for a recipe of
    the package; flags further right override them. `--env.type=wmrl_maniskill --help` lists the simulator's
    flags."""

    path_fields: ClassVar[list[str]] = ["policy"]

    output_dir: Path | None = None
    """Folder of the dataset; it appears when everything is recorded."""

    repo_id: str | None = None
    """Name of the dataset: user/name to publish it; local/<folder> by default."""

    num_episodes: int = 100
    """Number of episodes to record."""

    seed: int = 0
    """Seed of the first episode; episode i has seed + i. Seeds from 1,000,000 on are for evaluation."""

    tasks: list[str] = field(default_factory=list)
    """Tasks, recorded in turn; the environment's own task by default."""

    env: EnvConfig = field(default_factory=WmrlManiSkillEnv)
    """ManiSkill with a task, scenes, cameras and an image size (--env.type=wmrl_maniskill --env.task=push …),
    or a world model and the dataset with its start frames (--env.type=world_model
    --env.world_model_path=…)."""

    like: DatasetSource = field(default_factory=DatasetSource)
    """For an environment that is not ManiSkill: a dataset of the same robot, `like.root` or `like.repo_id`,
    with which the recording can then be merged. Its columns, their names, how frames are stored and the range
    of the actions are taken from it. Without it, columns are LeRobot's, and actions have numbers for names. A
    world model knows names and range itself: there only columns are taken."""

    like_columns: bool = True
    """Take the columns of `like`. False takes names and the range of the actions alone, where the dataset has
    columns that the environment does not show."""

    max_frames: int | None = None
    """Frames of an episode at most, in LeRobot's other environments, if their own limit is not lower. Without
    success until then an episode has failed. ManiSkill and world models have `env.episode_length`."""

    depth: bool = False
    """Also record every camera's depth, as LeRobot's depth maps (observation.images.<camera>_depth)."""

    video: bool = True
    """Store the cameras as videos. As images (false) the dataset takes more space, and lerobot-train reads it
    faster: single frames need no decoding of a video."""

    kinds: dict[str, float] = field(default_factory=default_kinds)
    """Share of each kind of planned trajectory; the shares need not sum to 1."""

    planner: str = "cartesian"
    """Motion between the waypoints of a planned trajectory. cartesian: straight lines. mplib: paths that
    MPLib plans in joint space, around the table, the container and, until it must be touched, the object."""

    num_workers: int = 2
    """Number of processes that simulate."""

    part_episodes: int = 20
    """Episodes per sub-dataset. An interruption costs each worker at most one sub-dataset."""

    shard: str = "0/1"
    """i/n: on the i-th (from 0) of n machines, record the i-th of n parts of the sub-datasets."""

    merge_shards: list[Path] = field(default_factory=list)
    """Folders of all shards: merge them into output_dir, and stop."""

    policy: PreTrainedConfig | None = None
    """Policy to roll out: --policy.path=FOLDER of a checkpoint, or a planner, which has none:
    --policy.type=wm_mpc --policy.world_model_path=…"""

    exploration: float = 0.0
    """Noise on a policy's actions: the largest standard deviation, as a share of half the range of each
    component; in ManiSkill on translations alone, in a world model on what varied in its data. Each
    episode draws its own level from 0 to this one. The noise is correlated over about ten steps."""

    budget: Path | None = None
    """Ledger of the real episodes that a method may learn from, a JSON file with limits (docs/protocol.md).
    The recording is entered there, and refused if it is beyond a limit, has evaluation seeds or unseen
    scenes. Imagined episodes cost nothing."""

    push_to_hub: bool = False
    """Publish the dataset as repo_id on the Hugging Face hub when it is complete."""

    private: bool = False
    """Publish it privately."""

    list_scenes: bool = False
    """Print the table of scenes and stop."""

    def validate(self) -> None:
        """Read the policy's configuration. FieldError for the first setting that cannot be."""
        path, settings = self.given["policy"]
        if path:
            self.policy = read_policy_config(path, settings)
        if self.output_dir is None:
            raise FieldError("output_dir", None, "missing", "give the folder for the dataset")
        require_no_mount("output_dir", self.root)
        require_at_least(self, 1, "num_episodes", "num_workers", "part_episodes")
        if self.max_frames is not None:
            require_at_least(self, 1, "max_frames")
            if isinstance(self.env, WmrlManiSkillEnv | WorldModelEnv):
                raise FieldError(
                    "max_frames",
                    self.max_frames,
                    f"{self.env.type} has a setting of its own",
                    "set `env.episode_length`",
                )
        self._validate_numbers()
        require_choice(self, "planner", MOTIONS)
        if self.in_maniskill and self.maniskill.batched:
            raise FieldError(
                "env.batched", True, "a recording has a simulation in each process", "leave it out"
            )
        if self.policy is not None:
            require_trained(self.policy)
        self._validate_kinds()
        if self.push_to_hub:
            self._validate_publishing()
        if not self.in_maniskill:
            self._validate_rollouts()
        else:
            self.maniskill.selected_scenes()
            if self.like.given:
                problem = "episodes of ManiSkill's robot have columns of their own"
                raise FieldError("like.root", self.like.name, problem, "leave it out")
        for task in self.tasks:
            task_of(task)

    def _validate_numbers(self) -> None:
        """Raise FieldError for a seed, an exploration or a shard that cannot be."""
        if self.seed < 0 or (self.policy is None and self.seed + self.num_episodes > EVALUATION_SEED):
            raise FieldError(
                "seed",
                self.seed,
                f"the seeds of planned trajectories are from 0 to {EVALUATION_SEED - 1}, those above are for "
                "evaluation",
                "choose a smaller one",
            )
        if not 0 <= self.exploration <= 1 or (self.exploration and self.policy is None):
            problem = "must be a share of the action box, 0 to 1, for a policy's rollouts only"
            raise FieldError("exploration", self.exploration, problem, "give `policy.path`, or leave it out")
        if self.shard_of[1] > -(-self.num_episodes // self.part_episodes):
            raise FieldError(
                "shard",
                self.shard,
                "there are fewer sub-datasets than shards",
                "take fewer shards, or lower `part_episodes`",
            )

    def _validate_rollouts(self) -> None:
        """Raise FieldError for a setting that needs the simulator, or for a missing policy."""
        if self.policy is None:
            raise FieldError("env.type", self.env.type, "needs a policy", "give `policy.path`, or a planner")
        for name in ("depth", "tasks"):
            if getattr(self, name):
                raise FieldError(
                    name,
                    getattr(self, name),
                    "can be chosen in ManiSkill alone",
                    "leave it out (in a world model, `env.dataset.tasks` chooses among the starts)",
                )
        if isinstance(self.env, WorldModelEnv) and self.env.dataset.branches:
            raise FieldError(
                "env.dataset.branches",
                self.env.dataset.branches,
                "recorded episodes begin with first frames",
                "leave it out",
            )
        if self.shard_of[1] > 1:
            raise FieldError("shard", self.shard, "divides recordings in ManiSkill alone", "leave it out")

    def _validate_kinds(self) -> None:
        planned = [kind for kind in KINDS if kind != POLICY]
        unknown = [kind for kind in self.kinds if kind not in planned]
        if unknown or min(self.kinds.values(), default=0) < 0 or sum(self.kinds.values()) <= 0:
            problem = f"must be shares of {', '.join(planned)}, at least one above 0"
            raise FieldError("kinds", self.kinds, problem, "name some of these, as in {optimal: 1}")

    def _validate_publishing(self) -> None:
        """Raise FieldError, before anything is recorded, if the name or the hub's token is missing."""
        namespace, _, name = self.dataset_id.partition("/")
        if not name or namespace == LOCAL:
            problem = f"the dataset is called {self.dataset_id}"
            raise FieldError(
                "push_to_hub", "true", problem, "give its name on the hub, user/name, as `repo_id`"
            )
        if self.shard_of[1] > 1 and not self.merge_shards:
            raise FieldError(
                "push_to_hub",
                "true",
                f"the shard {self.shard} is only a part",
                "record all shards, then publish with `merge_shards`",
            )
        try:
            validate_repo_id(self.dataset_id)
        except HFValidationError as error:
            raise FieldError("repo_id", self.repo_id, str(error)) from error
        check_login()

    @property
    def root(self) -> Path:
        """Root of the dataset, for use after `validate`. Of a link it is what that leads to: what is not
        finished yet stands beside it, on the same disk."""
        assert self.output_dir is not None
        return self.output_dir.resolve() if self.output_dir.is_symlink() else self.output_dir

    @property
    def in_maniskill(self) -> bool:
        """Whether the episodes are simulated in ManiSkill."""
        return isinstance(self.env, WmrlManiSkillEnv)

    @property
    def maniskill(self) -> WmrlManiSkillEnv:
        """The environment, in the simulator."""
        assert isinstance(self.env, WmrlManiSkillEnv)
        return self.env

    @property
    def shard_of(self) -> tuple[int, int]:
        """(i, n). Raises FieldError if `shard` is not written as i/n."""
        match = re.fullmatch(r"(\d+)/(\d+)", self.shard)
        if not match or int(match[1]) >= int(match[2]):
            raise FieldError("shard", self.shard, "must be i/n, with i from 0 to n - 1, as in 0/4")
        return int(match[1]), int(match[2])

    @property
    def recorded_tasks(self) -> list[str]:
        """Names of the tasks, in turn."""
        return self.tasks or self.maniskill.task_names

    @property
    def dataset_id(self) -> str:
        """Name of the dataset."""
        assert self.output_dir is not None
        return self.repo_id or f"{LOCAL}/{self.output_dir.name}"

    def recorded_content(self) -> dict[str, Any]:
        """Return the settings that decide the episodes. A folder with the same continues this recording.

        Returns:
            JSON values only.
        """
        return {
            **self._env_content(),
            "depth": self.depth,
            "video": self.video,
            "episode_length": getattr(self.env, "episode_length", None),
            "num_episodes": self.num_episodes,
            "part_episodes": self.part_episodes,
            "shard": list(self.shard_of),
            "seed": self.seed,
            "kinds": self.kinds if self.policy is None else {POLICY: 1.0},
            "planner": self.planner if self.policy is None else None,
            **self._policy_content(),
            "exploration": self.exploration,
        }

    def _env_content(self) -> dict[str, Any]:
        if self.in_maniskill:
            return self._simulated_content()
        env = (
            imagined_content(self.env)
            if isinstance(self.env, WorldModelEnv)
            else {"env": draccus.encode(self.env, EnvConfig)}
        )
        return {
            **env,
            "like": asdict(self.like),
            "like_columns": self.like_columns,
            "max_frames": self.max_frames,
        }

    def _policy_content(self) -> dict[str, Any]:
        """Return what decides a policy's actions: its checkpoint, or its own settings if it has none."""
        if self.policy is None:
            return {"policy": None}
        if self.policy.pretrained_path:
            path = resolved_name(str(self.policy.pretrained_path))
            return {
                "policy": path,
                "policy_settings": self.given["policy"].settings,
                "policy_content": checkpoint_digest(path),
            }
        names = {each.name for each in fields(self.policy)} - {each.name for each in fields(PreTrainedConfig)}
        settings = draccus.encode(self.policy)
        parts = {name: checkpoint_digest(settings[name]) for name in PARTS if settings.get(name)}
        return {
            "policy": self.policy.type,
            **{f"policy.{name}": settings[name] for name in sorted(names)},
            "policy_content": parts,
        }

    def _simulated_content(self) -> dict[str, Any]:
        env = self.maniskill
        return {
            "tasks": self.recorded_tasks,
            "scenes": [scene.index for scene in env.selected_scenes()],
            "cameras": list(env.cameras),
            "image_size": env.image_size,
            "assets": env.describe_assets(),
            "robot_mesh_detail": env.robot_mesh_detail,
        }


def imagined_content(env: WorldModelEnv) -> dict[str, Any]:
    """Return the settings that decide the frames of imagined episodes, beside the policy."""
    from lerobot_wmrl.envs.content import content_of
    from lerobot_wmrl.world_models.checkpoint import read_config

    model = read_config(env.world_model_path, "action_world_model")
    reward = draccus.encode(env.reward, RewardModelConfig)
    general = {each.name for each in fields(RewardModelConfig)} - {"pretrained_path"}  # device, hub
    return {
        "world_model": env.world_model_path,
        "starts": draccus.encode(env.dataset),
        "cameras": list(model.trained_tokenizer.cameras),
        "image_size": model.trained_tokenizer.square_side,
        "done_threshold": env.done_threshold,
        "done_frames": env.done_frames,
        "reward": env.reward.type,
        "reward_settings": {name: value for name, value in reward.items() if name not in general},
        "text_world_model": env.text_world_model_path,
        "content": content_of(env),
    }

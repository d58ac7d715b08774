"""Configuration of lerobot-wmrl-improve."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Final

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.common.command_line import RunConfig
from lerobot_wmrl.common.errors import FieldError, require_at_least, require_choice, require_share
from lerobot_wmrl.common.flags import Flags
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.common.policy_checks import require_chunks, require_distillable, require_trained
from lerobot_wmrl.common.seeds import EVALUATION_SEED, require_seed
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv

SIZES: Final = ("auto", "tiny", "demo", "cpu")
"""Presets of the stages; `auto` is `cpu` with CUDA and `demo` without."""

ROLLOUT_SEED_OFFSET: Final = 50_000
"""Offset of the seeds of rollouts: episodes of the dataset may have been recorded with the same seed."""

ALGORITHMS: Final[dict[str, Flags]] = {
    "cnn": {"algorithm.type": "ppo", "algorithm.train_encoder": False},
    "act": {"algorithm.type": "distillation", "algorithm.recorded": False},
    "openvla": {"algorithm.type": "ppo", "algorithm.initial_std": "null"},
}
"""How policies of a type are trained: `cnn` and `act` as was best in the studies of docs/results.md."""

OTHERS: Final[Flags] = {"algorithm.type": "distillation"}
"""How all others are: they are fitted to a planner in the world model."""

DISTILLED_TYPES: Final = ("cnn",)
"""Types that are fitted to a planner after PPO too. Others were not measured."""


@dataclass
class ImproveConfig(RunConfig):
    """Improve a policy with a dataset, inside a world model that learns from it.

    The command looks at the data and says what it has and lacks. It trains the policy further on all episodes
    that succeed, and trains a frame tokenizer, a world model and, in imagination, the policy. A `cnn` is then
    fitted to a planner in imagination (distillation). In the end it compares the policy before, trained
    further, and improved: in `real_env` if there is one, else in imagination, which proves nothing about the
    real world. In `real_env` it also chooses the policy to use, on other starts: training in imagination can
    make a policy worse. Every stage is a command that you could call yourself; it is printed. Running the
    same command again continues. The page to read is `report.html`.

    Args:
        policy: `--policy.path=FOLDER` or a name on the hub: the policy to improve, cloned from such data.
            Settings of its own hold for all stages, such as `--policy.n_action_steps=8` for ACT.
        dataset: `--dataset.repo_id=USER/NAME` or `--dataset.root=FOLDER`: episodes with actions, the cameras
            that the policy sees, and next.success. Failures belong into it.
        check: `--check.root=FOLDER` or `--check.repo_id=USER/NAME`: labelled episodes that are not in
            `dataset`, rollouts of the policy at best, to check the world model on; some succeed and some
            fail. By default held-out episodes of the dataset, or all of it where these are few.
        real_env: `--real_env.type=…` and its settings: one of LeRobot's environments or wmrl_maniskill, to
            record rollouts and to measure success in.
        rollouts: rollouts of the policy that are recorded in `real_env` first, and learnt from. Columns of
            the dataset that these lack are left out of what is learnt from.
        exploration: noise on the actions of these rollouts, as a share of half their range.
        max_frames: frames after which a rollout has failed; by default twice as many as the dataset's longest
            episode has. In ManiSkill set `real_env.episode_length`.
        size: how large models are and how long they train: `demo` (an hour on two cores), `cpu` (several),
            `tiny` (a minute, to try the command), or `auto`.
        iterations: of PPO, or of distillation if the policy is not trained by PPO; by default those of the
            size.
        selection_episodes: starts in `real_env` on which every policy is measured, to choose the one to use.
            RL's checkpoint is chosen among at most five on half as many others. 0: take the last policy and
            checkpoint. Nothing is trained on these episodes.
        eval_episodes: starts of the comparison that is reported. No choice is made on them, except in LIBERO,
            where the number of resets decides the start.
        seed: of recording and training. Evaluation has seeds of its own, from 1,000,000 on, selection from
            2,000,000, the gate from 3,000,000.
        output_dir: folder of everything.
    """

    path_fields: ClassVar[list[str]] = ["policy"]

    policy: PreTrainedConfig | None = None
    dataset: ChosenEpisodes = field(default_factory=ChosenEpisodes)
    check: ChosenEpisodes = field(default_factory=ChosenEpisodes)
    real_env: EnvConfig | None = None
    rollouts: int = 0
    exploration: float = 0.2
    max_frames: int | None = None
    size: str = "auto"
    iterations: int | None = None
    selection_episodes: int = 50
    eval_episodes: int = 100
    seed: int = 0
    output_dir: Path = Path("outputs/improve")

    @property
    def policy_flags(self) -> list[str]:
        """The settings of the policy that the command line changes: `--n_action_steps=8`."""
        return self.given["policy"].settings

    def validate(self) -> None:
        """Read the policy's configuration. FieldError for a setting that cannot be."""
        if path := self.given["policy"].path:
            self.policy = read_policy_config(path, self.policy_flags)
        if self.policy is None:
            raise FieldError("policy.path", None, "is missing", "give the policy to improve")
        require_trained(self.policy)
        if self.policy.type not in ALGORITHMS:
            require_distillable(self.policy)
        if self.policy.type == "act":
            require_chunks(self.policy)
        if not self.dataset.given:
            raise FieldError("dataset.root", "", "is missing", "give `dataset.root` or `dataset.repo_id`")
        for name in ("episodes", "revision"):
            if getattr(self.check, name) is not None and not self.check.given:
                raise FieldError(
                    f"check.{name}",
                    getattr(self.check, name),
                    "is one of a dataset to check on, and none is named",
                    "give `check.root` or `check.repo_id`, the dataset's own if these are its episodes",
                )
        require_choice(self, "size", SIZES)
        require_at_least(self, 0, "rollouts", "selection_episodes")
        require_at_least(self, 1, "eval_episodes")
        require_share(self, "exploration")
        if self.iterations is not None:
            require_at_least(self, 1, "iterations")
        if self.rollouts and self.real_env is None:
            raise FieldError(
                "rollouts", self.rollouts, "are recorded in a real environment", "give `real_env.type`"
            )
        if self.rollouts and isinstance(self.real_env, WmrlManiSkillEnv) and self.real_env.split == "ood":
            raise FieldError(
                "real_env.split",
                "ood",
                "results are reported on unseen scenes: nothing may be learnt in them",
                "choose ind, or leave `rollouts` out",
            )
        if self.max_frames is not None:
            self._check_max_frames()
        last = EVALUATION_SEED - (self.rollouts + ROLLOUT_SEED_OFFSET if self.rollouts else 1)
        require_seed(self, last)

    def _check_max_frames(self) -> None:
        require_at_least(self, 1, "max_frames")
        if not self.rollouts or isinstance(self.real_env, WmrlManiSkillEnv):
            remedy = "set `real_env.episode_length`" if self.rollouts else "leave it out"
            raise FieldError(
                "max_frames", self.max_frames, "limits rollouts in environments other than ManiSkill", remedy
            )

    @property
    def preset(self) -> str:
        """The stages' preset."""
        automatic = "cpu" if torch.cuda.is_available() else "demo"
        return automatic if self.size == "auto" else self.size

    @property
    def selects(self) -> bool:
        """Whether episodes in `real_env` choose checkpoint and policy."""
        return self.real_env is not None and self.selection_episodes > 0

    @property
    def algorithm(self) -> Flags:
        """How a policy of this type is trained."""
        assert self.policy is not None
        return ALGORITHMS.get(self.policy.type, OTHERS)

    @property
    def distils(self) -> bool:
        """Whether the policy is fitted to a planner after PPO."""
        return self.policy is not None and self.policy.type in DISTILLED_TYPES

"""What is decided for an improvement before its first stage, from its configuration and the data."""

from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.constants import ACTION, DEFAULT_FEATURES, DONE, REWARD

from lerobot_wmrl.common.checkpoints import best_model, last_model, resolved_path
from lerobot_wmrl.common.constants import START_KIND, START_SEED
from lerobot_wmrl.common.errors import renamed
from lerobot_wmrl.common.flags import Flags
from lerobot_wmrl.common.forks import in_fork
from lerobot_wmrl.common.policies import copy_checkpoint, load_processors
from lerobot_wmrl.common.policy_checks import check_units
from lerobot_wmrl.data.dataset import ChosenEpisodes, DatasetSource
from lerobot_wmrl.data.embodiment import Embodiment, read_embodiment
from lerobot_wmrl.data.episodes import SUCCESS, read_episodes
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.lerobot_env import check_frame_rate, check_real_env
from lerobot_wmrl.improve.configuration_improve import ImproveConfig
from lerobot_wmrl.improve.findings import (
    LONGEST_IMAGINATION,
    Findings,
    inspect_dataset,
    require_checkable,
    require_mergeable,
)
from lerobot_wmrl.improve.own_cameras import with_own_cameras, without_renaming
from lerobot_wmrl.improve.sizes import Sizes
from lerobot_wmrl.improve.stage_names import StageName
from lerobot_wmrl.maniskill.recordings import require_unreported
from lerobot_wmrl.rewards.general import default_discount

DURATIONS: Final = {
    "tiny": "about a minute on two cores",
    "demo": "about an hour on two cores",
    "cpu": "several hours on two cores, not measured with an accelerator",
}
"""How long all stages but those in `real_env` take."""

SLOWEST: Final = 2
"""A rollout may take this many times as long as the longest recorded episode: what a stuck one does beyond
would fill the data."""

ROLLOUT_COLUMNS: Final = (*DEFAULT_FEATURES, ACTION, REWARD, SUCCESS, DONE, START_SEED, START_KIND)
"""Columns of recorded rollouts, beside those that the policy sees and the environment declares."""

STRICT_DONE_FRAMES: Final = 2
"""Consecutive done frames that make an imagined success, if the data shows that many."""

STRICT_DONE_THRESHOLD: Final = 0.95
"""RL finds every failure that the world model takes for a success: the threshold is strict."""


@dataclass(frozen=True)
class Plan:
    """The improvement of one policy with one dataset; paths are relative to where the command runs.

    Args:
        config: the command's configuration.
        findings: what was found in the dataset.
        preprocessor: the policy's, where a copy of the policy has the dataset's cameras in place of its own.
    """

    config: ImproveConfig
    findings: Findings
    preprocessor: Any = None

    @classmethod
    def of(cls, config: ImproveConfig) -> "Plan":
        """Look at the dataset, and at the real environment if there is one.

        Raises:
            FieldError: the policy cannot be improved with the dataset, or cannot act in the environment.
        """
        assert config.policy is not None
        opened = DatasetSource.open if config.rollouts else ChosenEpisodes.open  # whole ones can be merged
        table = read_episodes(opened(config.dataset))
        preprocessor, postprocessor = load_processors(config.policy)
        policy = with_own_cameras(config.policy, preprocessor, table.dataset.features)
        adapted = without_renaming(preprocessor, policy) if policy is not config.policy else None
        findings = inspect_dataset(table, policy, config.dataset.episodes, config.rollouts)
        chosen = np.flatnonzero(table.among(config.dataset.episodes))
        require_unreported(table, chosen, "choose others with `dataset.episodes`")
        if config.rollouts and isinstance(config.real_env, WmrlManiSkillEnv):
            require_mergeable(table.dataset, config.real_env)
        robot = read_embodiment(table.dataset.meta, Embodiment(), config.dataset.episodes)
        check = config.check
        if check.given:
            with renamed("dataset", "check"):
                checked = read_episodes(check.open())
                require_checkable(checked, check.episodes, table, robot, [*policy.image_features])
            check = check.pinned(checked.dataset.root)
        check_units(
            policy,
            postprocessor,
            robot.action_names,
            torch.tensor(robot.action_low),
            torch.tensor(robot.action_high),
            "the dataset",
        )
        if config.real_env is not None:
            starts = max(config.eval_episodes, config.selection_episodes)
            # not in this process: stages are forks of it that render too
            in_fork(check_real_env, policy, config.real_env, starts)
            check_frame_rate(config.real_env, table.dataset.fps, "the dataset")
        planned = copy(config)
        planned.policy = policy
        planned.dataset, planned.check = config.dataset.pinned(table.dataset.root), check
        return cls(planned, findings, adapted)

    @property
    def duration(self) -> str:
        """The expected duration, as text."""
        size, real = self.config.preset, self.config.real_env
        beside = "" if real is None else f", plus the time in {real.type}"
        return f"size {size}: {DURATIONS[size]}{beside}; each stage shows the time left"

    @property
    def out(self) -> Path:
        return self.config.output_dir

    @property
    def policy(self) -> str:
        """Path or name of the policy that is improved, or that of its copy if there is one.

        It is a checkpoint's, and not the link `last`, which a longer training moves on.
        """
        assert self.config.policy is not None
        if self.copies:
            return str(self.out / "policy")
        return resolved_path(str(self.config.policy.pretrained_path))

    @property
    def copies(self) -> bool:
        """Whether every stage reads a copy of the policy: with settings that were given, or other cameras."""
        return bool(self.config.policy_flags) or self.preprocessor is not None

    def copy_policy(self) -> None:
        """Make that copy, if there is to be one."""
        assert self.config.policy is not None
        if self.copies:
            copy_checkpoint(self.config.policy, self.out / "policy", self.preprocessor)

    @property
    def clones(self) -> bool:
        """Whether a policy is cloned from the successes alone. If all episodes succeed, this one was."""
        return bool(self.config.rollouts or self.findings.failures)

    def folder(self, stage: StageName) -> Path:
        """Return the folder that a stage fills."""
        return self.out / stage

    @property
    def rl_checkpoint(self) -> Path:
        """RL's checkpoint: the best one with selection, else the last. It exists too if RL stopped early."""
        folder = self.folder(StageName.RL)
        return best_model(folder) if self.config.selects else last_model(folder)

    @property
    def rl_selection_episodes(self) -> int:
        """Starts on which RL's checkpoint is chosen. The policy is chosen on those after them."""
        return (self.config.selection_episodes + 1) // 2

    @property
    def extra_columns(self) -> list[str]:
        """Columns of the dataset that the rollouts lack, which cannot be merged."""
        real, policy = self.config.real_env, self.config.policy
        if not self.config.rollouts or self.in_maniskill:
            return []
        assert real is not None
        assert policy is not None
        recorded = {*ROLLOUT_COLUMNS, *policy.input_features, *env_to_policy_features(real)}
        return [name for name in self.findings.columns if name not in recorded]

    @property
    def mergeable(self) -> Path:
        """Folder of the dataset with the columns that rollouts have too."""
        return self.folder(StageName.COLUMNS) if self.extra_columns else self.findings.root

    @property
    def data(self) -> ChosenEpisodes:
        """The episodes that are learnt from: the dataset's, and the rollouts, which are merged with it."""
        dataset, count = self.config.dataset, self.config.rollouts
        if not count:
            return dataset
        chosen = dataset.episodes
        if chosen is not None:
            chosen = [*chosen, *self.rollout_numbers()]
        return ChosenEpisodes(root=str(self.folder(StageName.MERGED)), episodes=chosen)

    def rollout_numbers(self) -> range:
        """Return the numbers of the rollouts among the merged episodes."""
        return range(self.findings.total, self.findings.total + self.config.rollouts)

    @property
    def in_maniskill(self) -> bool:
        """Whether rollouts are recorded in ManiSkill, where they get the recorder's columns."""
        return isinstance(self.config.real_env, WmrlManiSkillEnv)

    @property
    def frame_limit(self) -> int:
        """Frames that an episode may take, beyond which it fails."""
        real = self.config.real_env
        if isinstance(real, WmrlManiSkillEnv):
            return real.horizon
        if not self.config.rollouts:
            return self.findings.longest
        return self.config.max_frames or self.findings.longest * SLOWEST

    @property
    def length(self) -> int:
        """Frames of an imagined episode."""
        return min(self.findings.longest, LONGEST_IMAGINATION)

    @property
    def discount(self) -> float:
        """PPO's discount factor: that of the real episodes, which may be longer than the imagined ones."""
        return default_discount(self.frame_limit)

    @property
    def sizes(self) -> Sizes:
        """How large frames, batches and rollouts are."""
        assert self.config.policy is not None
        observations = len(self.config.policy.observation_delta_indices or [0])
        findings, cameras = self.findings, len(self.findings.cameras)
        return Sizes(
            self.config.preset, findings.frame_side, findings.pixels, cameras, self.length, observations
        )

    def strict_criterion(self) -> Flags:
        """Return the success criterion of the check. Imagination has it too, unless it recognises none of the
        recorded successes."""
        return {
            "done_threshold": STRICT_DONE_THRESHOLD,
            "done_frames": min(STRICT_DONE_FRAMES, max(1, self.findings.held)),
        }

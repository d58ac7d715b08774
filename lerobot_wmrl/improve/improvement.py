"""What is decided for an improvement, from its configuration, the data and what finished stages left."""

import json
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.constants import ACTION, DEFAULT_FEATURES, DONE, REWARD

from lerobot_wmrl.common.checkpoints import best_checkpoint, last_checkpoint, resolved_path
from lerobot_wmrl.common.constants import START_KIND, START_SEED, START_TASK
from lerobot_wmrl.common.policies import check_units, copy_checkpoint, load_processors
from lerobot_wmrl.common.presets import Flags
from lerobot_wmrl.common.stages import FAILED, in_fork, read_record
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.data.embodiment import Embodiment, read_embodiment
from lerobot_wmrl.data.episodes import SUCCESS, EpisodeTable, read_episodes
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.envs.lerobot_env import check_frame_rate, check_real_env
from lerobot_wmrl.envs.start_frames import chosen_episodes
from lerobot_wmrl.evaluation.comparison import RESULTS, chosen_policy, most_successful
from lerobot_wmrl.improve.configuration_improve import ImproveConfig
from lerobot_wmrl.improve.findings import LONGEST_IMAGINATION, Findings, look, require_mergeable, usual_length
from lerobot_wmrl.improve.own_cameras import with_own_cameras, without_renaming
from lerobot_wmrl.improve.sizes import Sizes
from lerobot_wmrl.maniskill.recordings import require_unreported
from lerobot_wmrl.rewards.general import default_discount

SFT: Final = "SFT policy"
CLONED: Final = "further BC on successes"
PPO: Final = "PPO in imagination"
FITTED: Final = "planner distilled"
DISTILLED: Final = "PPO, then planner distilled"
"""What the compared policies are."""

DURATIONS: Final = {
    "tiny": "about a minute on two cores", "demo": "about an hour on two cores",
    "cpu": "several hours on two cores, not measured with an accelerator",
}  # fmt: skip
"""How long all stages but those in `real_env` take."""

ENOUGH_HELD_OUT: Final = 10
"""If fewer episodes are held out, the check takes all, most of which were learnt from: a few say too little
about a threshold."""

SLOWEST: Final = 2
"""A rollout may take this many times as long as the longest recorded episode: what a stuck one does beyond
would fill the data."""

ROLLOUT_COLUMNS: Final = (*DEFAULT_FEATURES, ACTION, REWARD, SUCCESS, DONE, START_SEED, START_KIND)
"""Columns of recorded rollouts, beside those that the policy sees and the environment declares."""

MAX_STARTS: Final = 1024
"""Frames in which imagination may begin, in all."""

DONE_FRAMES: Final = 2
"""Consecutive done frames that make an imagined success, if the data shows that many."""

DONE_THRESHOLD: Final = 0.95
"""RL finds every failure that the world model takes for a success: the threshold is strict."""


@dataclass(frozen=True)
class Improvement:
    """The improvement of one policy with one dataset; paths are relative to where the command runs.

    Args:
        config: the command's configuration.
        found: what was found in the dataset.
        preprocessor: the policy's, where a copy of the policy has the dataset's cameras in place of its own.
    """

    config: ImproveConfig
    found: Findings
    preprocessor: Any = None

    @classmethod
    def of(cls, config: ImproveConfig) -> "Improvement":
        """Look at the dataset, and at the real environment if there is one.

        Raises:
            FieldError: the policy cannot be improved with the dataset, or cannot act in the environment.
        """
        assert config.policy is not None
        table = read_episodes(config.dataset.open())
        preprocessor, postprocessor = load_processors(config.policy)
        own = with_own_cameras(config.policy, preprocessor, table.dataset.features)
        adapted = without_renaming(preprocessor, own) if own is not config.policy else None
        config.policy = own
        found = look(table, config.policy, config.dataset.episodes, config.rollouts)
        chosen = np.flatnonzero(table.among(config.dataset.episodes))
        require_unreported(table, chosen, "choose others with `dataset.episodes`")
        if config.rollouts and isinstance(config.real_env, WmrlManiSkillEnv):
            require_mergeable(table.dataset, config.real_env)
        robot = read_embodiment(table.dataset.meta, Embodiment())
        check_units(
            config.policy, postprocessor, robot.action_names,
            torch.tensor(robot.action_low), torch.tensor(robot.action_high), "the dataset",
        )  # fmt: skip
        if config.real_env is not None:
            starts = max(config.eval_episodes, config.selection_episodes)
            # not in this process: stages are forks of it that render too
            in_fork(check_real_env, config.policy, config.real_env, starts)
            check_frame_rate(config.real_env, table.dataset.fps, "the dataset")
        return cls(config, found, adapted)

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
        return bool(self.config.rollouts or self.found.failures)

    @property
    def has_trained(self) -> bool:
        """Whether RL leaves a checkpoint, as it does unless it has stopped by a rule of its own before."""
        return not read_record(self.out, "rl").get(FAILED) or self.rl_checkpoint.exists()

    @property
    def kept_start(self) -> bool:
        """Whether RL's best checkpoint in the real environment is from before its first iteration."""
        step = self.rl_checkpoint.resolve().parent.name
        return self.config.selects and step.isdigit() and int(step) == 0

    @property
    def has_distilled(self) -> bool:
        """Whether the policy is fitted to a planner after PPO, and that has not failed."""
        return self.config.distils and not read_record(self.out, "distilled").get(FAILED)

    @property
    def policies(self) -> dict[str, str]:
        """Paths of the policies that are compared in the end, by what they are."""
        trained = {SFT: self.policy}
        if self.clones:
            trained[CLONED] = str(last_checkpoint(self.out / "cloned"))
        others = self.clones or self.has_distilled
        if changed := self.has_trained and not (self.kept_start and others):  # else it is one of the others
            fitted = self.config.algorithm["algorithm.type"] == "distillation"
            trained[FITTED if fitted else PPO] = str(self.rl_checkpoint)
        if self.has_distilled:
            trained[DISTILLED if changed else FITTED] = str(last_checkpoint(self.out / "distilled"))
        return trained

    @property
    def rl_checkpoint(self) -> Path:
        """RL's checkpoint: the best one with selection, else the last. It exists too if RL stopped early."""
        folder = self.out / "rl"
        return best_checkpoint(folder) if self.config.selects else last_checkpoint(folder)

    @property
    def rl_selection_episodes(self) -> int:
        """Starts on which RL's checkpoint is chosen. The policy is chosen on those after them."""
        return (self.config.selection_episodes + 1) // 2

    def chosen(self) -> str:
        """Return which policy to use: the most successful in the real environment, of equally good ones the
        earliest; without selection the last one."""
        *_, last = titles = [*self.policies]
        if not self.config.selects:
            return last
        found = json.loads((self.out / "choice" / RESULTS).read_text())
        return titles[list(found["policies"]).index(most_successful(found))]

    def start(self) -> str:
        """Return which policy RL begins with: the one that was cloned from the successes, unless the world
        model decides that the one before is better."""
        if not self.clones:
            return SFT
        found = json.loads((self.out / "start" / RESULTS).read_text())
        return (CLONED, SFT)[list(found["policies"]).index(chosen_policy(found))]

    def fitted(self) -> str:
        """Return the policy that is fitted to a planner after PPO: PPO's, or that before if it left none."""
        return str(self.rl_checkpoint) if self.has_trained else self.policies[self.start()]

    @property
    def extra_columns(self) -> list[str]:
        """Columns of the dataset that the rollouts lack, which cannot be merged."""
        real, policy = self.config.real_env, self.config.policy
        if not self.config.rollouts or self.in_maniskill:
            return []
        assert real is not None
        assert policy is not None
        recorded = {*ROLLOUT_COLUMNS, *policy.input_features, *env_to_policy_features(real)}
        return [name for name in self.found.columns if name not in recorded]

    @property
    def mergeable(self) -> Path:
        """Folder of the dataset with the columns that rollouts have too."""
        return self.out / "columns" if self.extra_columns else self.found.root

    @property
    def data(self) -> ChosenEpisodes:
        """The episodes that are learnt from: the dataset's, and the rollouts, which are merged with it."""
        given, count = self.config.dataset, self.config.rollouts
        if not count:
            return given
        chosen = given.episodes
        if chosen is not None:
            chosen = [*chosen, *self.rollout_numbers()]
        return ChosenEpisodes(root=str(self.out / "merged"), episodes=chosen)

    def rollout_numbers(self) -> range:
        """Return the numbers of the rollouts among the merged episodes."""
        return range(self.found.total, self.found.total + self.config.rollouts)

    @cached_property
    def table(self) -> EpisodeTable:
        """All episodes of the data that is learnt from, chosen or not; there once rollouts are merged."""
        return read_episodes(self.data.open())

    def learnt(self) -> EpisodeTable:
        """Read the episodes that are learnt from."""
        table = self.table
        return table.subset(table.among(self.data.episodes))

    def success_frames(self) -> int:
        """Return the frames of all successful episodes that are learnt from."""
        if not self.config.rollouts:
            return self.found.success_frames
        learnt = self.learnt()
        return int(learnt.length[learnt.success].sum())

    def fewest_starts(self) -> int:
        """Return the number of episodes that imagination begins in, of the task that has the fewest."""
        branches = self.branches()
        if not self.config.rollouts and self.found.total * (1 + branches) <= MAX_STARTS:
            return self.found.fewest
        table = self.learnt()
        begun = chosen_episodes(table, StartFrames(max_starts=MAX_STARTS, branches=branches))
        return int(np.unique(table.column(START_TASK)[begun], return_counts=True)[1].min())

    def spread(self, starts: int) -> int:
        """Return how many starts imagination takes in a comparison on `starts` of them: those of as many
        episodes, spread evenly over the dataset. Of several tasks it takes all, because some may have few."""
        tasks = len(np.unique(self.learnt().column(START_TASK))) if self.config.rollouts else self.found.tasks
        return min(starts * (1 + self.branches()), MAX_STARTS) if tasks == 1 else MAX_STARTS

    def checked(self) -> tuple[Flags, str]:
        """Return the flags of the dataset that the world model is checked on, and its split.

        Held-out episodes are better than others, and rollouts better than the dataset: the policy that is
        trained will act like them. But they must both succeed and fail.
        """
        holds_out = self.found.held_out >= ENOUGH_HELD_OUT
        data = self.config.dataset.flags(), "validation" if holds_out else "all"
        if self.config.rollouts < ENOUGH_HELD_OUT:
            return data
        table, numbers = self.table, list(self.rollout_numbers())
        success, validation = table.success[numbers], table.validation[numbers]
        held_out = success[validation]
        rollouts = replace(self.data, episodes=numbers).flags()
        if len(held_out) >= ENOUGH_HELD_OUT and held_out.any() and not held_out.all():
            return rollouts, "validation"
        if holds_out or success.all() or not success.any():
            return data
        return rollouts, "all"

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
            return self.found.longest
        return self.config.max_frames or self.found.longest * SLOWEST

    @property
    def length(self) -> int:
        """Frames of an imagined episode."""
        return min(self.found.longest, LONGEST_IMAGINATION)

    def branches(self) -> int:
        """Return the number of frames beyond the first from which imagination of a recorded episode begins.

        They are no farther apart than an imagined episode is long, so that it can end as the recorded one
        does. Where it is as long as the dataset's longest, a rollout of a few more frames has none.
        """
        usual = usual_length(self.learnt()) if self.config.rollouts else self.found.usual
        parts = usual / self.length
        return max(0, (ceil(parts) if self.length == LONGEST_IMAGINATION else round(parts)) - 1)

    @property
    def discount(self) -> float:
        """PPO's discount factor: that of the real episodes, which may be longer than the imagined ones."""
        return default_discount(self.frame_limit)

    @property
    def sizes(self) -> Sizes:
        """How large frames, batches and rollouts are."""
        assert self.config.policy is not None
        observations = len(self.config.policy.observation_delta_indices or [0])
        found, cameras = self.found, len(self.found.cameras)
        return Sizes(self.config.preset, found.frame_side, found.pixels, cameras, self.length, observations)

    def strict_criterion(self) -> Flags:
        """Return when the check sees success, and imagination too unless that recognises nothing."""
        return {"done_threshold": DONE_THRESHOLD, "done_frames": min(DONE_FRAMES, max(1, self.found.held))}

    def relaxed_criterion(self) -> dict[str, Any] | None:
        """Return the operating point that the check found, if no recorded success is recognised at the strict
        threshold: imagination sees success there instead."""
        metrics = self.out / "check" / "metrics.json"
        if not metrics.is_file():
            return None
        found: dict[str, Any] = json.loads(metrics.read_text())
        return None if found["true_positives"] else found["operating_point"]

    def criterion(self) -> Flags:
        """Return when imagination sees success."""
        point = self.relaxed_criterion() or self.strict_criterion()
        return {name: point[name] for name in ("done_threshold", "done_frames")}

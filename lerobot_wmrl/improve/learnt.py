"""The episodes that an improvement learns from, once its rollouts are recorded and merged."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import Final

import numpy as np

from lerobot_wmrl.common.constants import START_TASK
from lerobot_wmrl.common.flags import Flags
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.envs.configuration_world_model import StartFrames
from lerobot_wmrl.envs.start_frames import chosen_episodes
from lerobot_wmrl.improve.findings import LONGEST_IMAGINATION, tell_apart, usual_length
from lerobot_wmrl.improve.plan import Plan

ENOUGH_HELD_OUT: Final = 10
"""If fewer episodes are held out, the check takes all, most of which were learnt from: a few say too little
about a threshold."""

MAX_STARTS: Final = 1024
"""Frames in which imagination may begin, in all."""


@dataclass(frozen=True)
class LearntEpisodes:
    """The episodes of a plan's data. Of data without rollouts, what was found before the stages is not read
    again."""

    plan: Plan

    @cached_property
    def table(self) -> EpisodeTable:
        """All episodes of the data that is learnt from, chosen or not."""
        return read_episodes(self.plan.data.open())

    def chosen(self) -> EpisodeTable:
        """Read the episodes that are learnt from."""
        return self.table.subset(self.table.among(self.plan.data.episodes))

    def success_frames(self) -> int:
        """Return the frames of all successful episodes that are learnt from."""
        if not self.plan.config.rollouts:
            return self.plan.findings.success_frames
        chosen = self.chosen()
        return int(chosen.length[chosen.success].sum())

    def fewest_starts(self) -> int:
        """Return the number of episodes that imagination begins in, of the task that has the fewest."""
        branches = self.branches()
        if not self.plan.config.rollouts and self.plan.findings.total * (1 + branches) <= MAX_STARTS:
            return self.plan.findings.fewest
        table = self.chosen()
        begun = chosen_episodes(table, StartFrames(max_starts=MAX_STARTS, branches=branches))
        return int(np.unique(table.column(START_TASK)[begun], return_counts=True)[1].min())

    def evenly_chosen(self, starts: int) -> int:
        """Return `max_starts` of imagination for a comparison on the starts of as many episodes, spread
        evenly over the dataset. Of several tasks it takes all, because some may have few."""
        tasks = self.plan.findings.tasks
        if self.plan.config.rollouts:
            tasks = len(np.unique(self.chosen().column(START_TASK)))
        return min(starts * (1 + self.branches()), MAX_STARTS) if tasks == 1 else MAX_STARTS

    def branches(self) -> int:
        """Return the number of frames beyond the first from which imagination of a recorded episode begins.

        They are no farther apart than an imagined episode is long, so that it can end as the recorded one
        does. Where it is as long as the dataset's longest, a rollout of a few more frames has none.
        """
        length = self.plan.length
        usual = usual_length(self.chosen()) if self.plan.config.rollouts else self.plan.findings.usual
        return max(0, (ceil if length == LONGEST_IMAGINATION else round)(usual / length) - 1)

    def checked(self) -> tuple[Flags, str]:
        """Return the flags of the dataset that the world model is checked on, and its split.

        Those that were given for it come first. Held-out episodes are better than others, and rollouts better
        than the dataset: the policy that is trained will act like them. But they must both succeed and fail,
        if any do.
        """
        config, findings = self.plan.config, self.plan.findings
        if config.check.given:
            return config.check.flags(), "all"
        dataset, holds_out = config.dataset.flags(), findings.held_out >= ENOUGH_HELD_OUT
        numbers = list(self.plan.rollout_numbers())
        rollouts = replace(self.plan.data, episodes=numbers).flags()
        success: np.ndarray = np.zeros(0, bool)  # of the rollouts, if there are enough
        validation = success
        if len(numbers) >= ENOUGH_HELD_OUT:
            success, validation = self.table.success[numbers], self.table.validation[numbers]
        choices = [
            (
                validation.sum() >= ENOUGH_HELD_OUT and tell_apart(success[validation]),
                (rollouts, "validation"),
            ),
            (holds_out and findings.held_out_tell, (dataset, "validation")),
            (tell_apart(success), (rollouts, "all")),
            (findings.failures > 0 and findings.success_frames > 0, (dataset, "all")),
        ]
        unknown = dataset, "validation" if holds_out else "all"
        return next((choice for possible, choice in choices if possible), unknown)

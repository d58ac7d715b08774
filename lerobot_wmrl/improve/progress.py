"""What an improvement has come to, from what finished stages left: its policies, and which to take."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

from lerobot_wmrl.common.checkpoints import last_model
from lerobot_wmrl.common.flags import Flags
from lerobot_wmrl.common.stages import FAILED, read_record
from lerobot_wmrl.evaluation.comparison import COMPARISON_FILE, chosen_policy, most_successful
from lerobot_wmrl.improve.learnt import LearntEpisodes
from lerobot_wmrl.improve.plan import Plan
from lerobot_wmrl.improve.results import CHECK, read_check, read_json
from lerobot_wmrl.improve.stage_names import StageName

SFT: Final = "SFT policy"
CLONED: Final = "further BC on successes"
PPO: Final = "PPO in imagination"
FITTED: Final = "planner distilled"
DISTILLED: Final = "PPO, then planner distilled"
"""What the compared policies are."""


@dataclass(frozen=True)
class Progress:
    """An improvement that has begun."""

    plan: Plan

    @cached_property
    def learnt(self) -> LearntEpisodes:
        """The episodes that are learnt from."""
        return LearntEpisodes(self.plan)

    @property
    def has_trained(self) -> bool:
        """Whether RL leaves a checkpoint, as it does unless it has stopped by a rule of its own before."""
        return not read_record(self.plan.out, StageName.RL).get(FAILED) or self.plan.rl_checkpoint.exists()

    @property
    def kept_start(self) -> bool:
        """Whether RL's best checkpoint in the real environment is from before its first iteration."""
        step = self.plan.rl_checkpoint.resolve().parent.name
        return self.plan.config.selects and step.isdigit() and int(step) == 0

    @property
    def has_distilled(self) -> bool:
        """Whether the policy is fitted to a planner after PPO, and that has not failed."""
        return self.plan.config.distils and not read_record(self.plan.out, StageName.DISTILLED).get(FAILED)

    @property
    def policies(self) -> dict[str, str]:
        """Paths of the policies that are compared in the end, by what they are."""
        plan = self.plan
        trained = {SFT: plan.policy}
        if plan.clones:
            trained[CLONED] = str(last_model(plan.folder(StageName.CLONED)))
        has_others = plan.clones or self.has_distilled
        if changed := self.has_trained and not (self.kept_start and has_others):  # else it is one of them
            fitted = plan.config.algorithm["algorithm.type"] == "distillation"
            trained[FITTED if fitted else PPO] = str(plan.rl_checkpoint)
        if self.has_distilled:
            trained[DISTILLED if changed else FITTED] = str(last_model(plan.folder(StageName.DISTILLED)))
        return trained

    def chosen(self) -> str:
        """Return which policy to use: the most successful in the real environment, of equally good ones the
        earliest; without selection the last one."""
        titles = [*self.policies]
        return (
            self._decided(StageName.CHOICE, most_successful, titles)
            if self.plan.config.selects
            else titles[-1]
        )

    def start(self) -> str:
        """Return which policy RL begins with: the one that was cloned from the successes, unless the world
        model decides that the one before is better."""
        return self._decided(StageName.START, chosen_policy, (CLONED, SFT)) if self.plan.clones else SFT

    def _decided(
        self, stage: StageName, decide: Callable[[Mapping[str, Any]], str], titles: Sequence[str]
    ) -> str:
        """Return which of the policies with these titles a comparison decides for."""
        results = read_json(self.plan.folder(stage) / COMPARISON_FILE)
        return titles[[*results["policies"]].index(decide(results))]

    def distillation_start(self) -> str:
        """Return the policy that distillation begins with: PPO's checkpoint, else the policy that PPO began
        with."""
        return str(self.plan.rl_checkpoint) if self.has_trained else self.policies[self.start()]

    def relaxed_criterion(self) -> dict[str, Any] | None:
        """Return the operating point that the check found, if no recorded success is recognised at the strict
        threshold: imagination sees success there instead."""
        if not (self.plan.out / CHECK).is_file():
            return None
        check = read_check(self.plan.out)
        return None if check["true_positives"] else check["operating_point"]

    def criterion(self) -> Flags:
        """Return when imagination sees success."""
        point = self.relaxed_criterion() or self.plan.strict_criterion()
        return {name: point[name] for name in ("done_threshold", "done_frames")}

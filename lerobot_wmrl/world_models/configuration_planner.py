"""Settings of the planner, which a policy (`wm_mpc`) and an algorithm (`distillation`) share."""

from dataclasses import dataclass

from lerobot_wmrl.common.errors import FieldError, require_at_least, require_positive


@dataclass
class PlannerSettings:
    """How far a planner looks ahead, and how it searches.

    Args:
        horizon: frames that are imagined ahead. Planning is fastest up to `clip_length` of the world model.
        execute: actions that are executed before planning again.
        samples: sequences sampled in each iteration.
        elites: best sequences, to whose mean the mean moves.
        iterations: iterations of the cross-entropy method.
        knots: actions of a sequence that are sampled, evenly spaced; those between are interpolated.
        spread: standard deviation of the first samples, as a share of that of the dataset's actions.
    """

    horizon: int = 40
    execute: int = 8
    samples: int = 64
    elites: int = 8
    iterations: int = 4
    knots: int = 6
    spread: float = 1.0

    def check_planner(self) -> None:
        """Raise FieldError for a setting that cannot be."""
        require_at_least(self, 1, "horizon", "execute", "samples", "elites", "iterations")
        require_positive(self, "spread")
        if not 2 <= self.knots <= self.horizon:
            raise FieldError("knots", self.knots, f"must be from 2 to `horizon`, {self.horizon}")
        for name, most in (("elites", "samples"), ("execute", "horizon")):
            if getattr(self, name) > getattr(self, most):
                raise FieldError(
                    name, getattr(self, name), f"must be at most `{most}`, {getattr(self, most)}"
                )

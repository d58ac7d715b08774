"""What seeds of environments are for. No range overlaps another, so that what is chosen is chosen on other
starts than those that are trained on or reported.

| from      | below     | starts                                                                          |
|-----------|-----------|---------------------------------------------------------------------------------|
| 0         | 1,000,000 | of recording and training; from 900,000 on of Dyna's rollouts too               |
| 1,000,000 | 2,000,000 | of evaluation: what is reported, and nothing else                               |
| 2,000,000 | 3,000,000 | of selection: the best of a training's checkpoints, or of several policies      |
| 3,000,000 | 4,000,000 | of the gate: rollouts that a world model is asked about while a policy trains   |
"""

from typing import Any, Final

from lerobot_wmrl.common.errors import FieldError

EVALUATION_SEED: Final = 1_000_000
SELECTION_SEED: Final = 2_000_000
GATE_SEED: Final = 3_000_000
"""First seeds of their ranges."""

DYNA_SEEDS: Final = 100_000
"""Number of seeds just below `EVALUATION_SEED` that Dyna records on."""

GATE_SEEDS: Final = 1_000_000
"""Number of seeds from `GATE_SEED` on."""


def dyna_seed(place: int, episodes: int) -> int:
    """Return the first of the seeds of `episodes` consecutive rollouts, `place` seeds on among Dyna's."""
    return EVALUATION_SEED - DYNA_SEEDS + place % (DYNA_SEEDS - episodes)


def gate_seed(place: int, episodes: int) -> int:
    """Return the first of the seeds of `episodes` consecutive rollouts, `place` seeds on among the gate's."""
    return GATE_SEED + place % (GATE_SEEDS - episodes)


def require_seed(settings: Any, last: int = EVALUATION_SEED - 1) -> None:
    """Raise FieldError unless `settings.seed` is from 0 to `last`, so that nothing learns from an evaluation
    seed."""
    if not 0 <= settings.seed <= last:
        raise FieldError(
            "seed", settings.seed, f"must be from 0 to {last}, so that no evaluation seed is trained on"
        )

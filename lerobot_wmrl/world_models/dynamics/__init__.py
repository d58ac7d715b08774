"""How frames follow each other: from the frame before, or from the first frame and the way since."""

from typing import Any, Final

from lerobot_wmrl.world_models.dynamics.anchored import AnchoredDynamics
from lerobot_wmrl.world_models.dynamics.autoregressive import AutoregressiveDynamics, Dynamics

__all__ = ["DYNAMICS", "AnchoredDynamics", "AutoregressiveDynamics", "Dynamics", "make_dynamics"]

DYNAMICS: Final[dict[str, type[Dynamics]]] = {
    "autoregressive": AutoregressiveDynamics,
    "anchored": AnchoredDynamics,
}


def make_dynamics(config: Any) -> Dynamics:
    """What `--model.dynamics` names. ValueError for anything else."""
    if config.dynamics not in DYNAMICS:
        raise ValueError(f"--model.dynamics={config.dynamics}: choose one of {', '.join(DYNAMICS)}")
    return DYNAMICS[config.dynamics](config)

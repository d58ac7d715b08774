"""What a recording in a world model has beside those in other environments."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION, TRUNCATED

from lerobot_wmrl.common.errors import FieldError, renamed
from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.data.embodiment import Embodiment, check_same_robot, recorded_range
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv


@dataclass(frozen=True)
class World:
    """What a recording needs to know of a world model and of the starts of its episodes.

    Args:
        robot: the robot that it has learnt from.
        done_frames: the frames at an episode's end that make it a success.
        varied: which components of the actions varied in its data: the others get no noise. (A,)
        starts: how many starts there are.
        origins: how the recorded episodes began that they are taken from, (K,) each: start.task, start.scene
            and start.seed, as far as they are known.
    """

    robot: Embodiment
    done_frames: int
    varied: np.ndarray
    starts: int
    origins: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, config: WorldModelEnv, env: Any, policy: LoadedPolicy, like: Any | None) -> "World":
        """Read it from an environment.

        Raises:
            FieldError: the policy acts in other units, or the dataset whose columns the recording gets is of
                another robot.
        """
        imagination = env.env
        imagination.accept(policy)
        robot = imagination.model.config.embodiment
        if like is not None:
            with renamed("dataset", "like"):
                check_same_robot(robot, like)
                check_same_range(robot, like)
        return cls(
            robot,
            config.done_frames,
            imagination.model.action_deviation().cpu().numpy() > 0,
            len(imagination.starts),
            imagination.starts.origins,
        )

    def features(self) -> dict[str, dict[str, Any]]:
        """Describe the columns beside those of any rollout."""
        flag, whole = ({"dtype": kind, "shape": (1,), "names": None} for kind in ("bool", "int64"))
        return {TRUNCATED: flag, **dict.fromkeys(self.origins, whole)}

    def begun(self, seed: int) -> dict[str, np.ndarray]:
        """Return the origins of the start in which the episode of a seed begins. (1,) each"""
        return {name: values[[seed % self.starts]] for name, values in self.origins.items()}


def check_same_range(robot: Embodiment, meta: Any) -> None:
    """Raise FieldError if a dataset says that its actions have another range than a robot's."""
    limits = recorded_range(meta.features[ACTION])
    if limits is None or np.allclose(limits, (robot.action_low, robot.action_high)):
        return
    low, high = ([float(f"{value:.4g}") for value in ends] for ends in limits)
    raise FieldError(
        "dataset.root",
        meta.root,
        f"its actions range from {low} to {high}, those of the world model: {robot.range_text()}",
        "use a dataset of the same robot, or `like_columns=false` if nothing is to be merged",
    )

"""What a recording in a world model has beside those in other environments."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION, TRUNCATED

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.data.embodiment import Embodiment, component_names, recorded_range
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
            require_same_actions(like, robot)
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


def require_same_actions(like: Any, robot: Embodiment) -> None:
    """Raise FieldError if a dataset (its metadata) names other actions than a robot has, or another range."""
    names, limits = component_names(like.features[ACTION]), recorded_range(like.features[ACTION])
    own = (robot.action_low, robot.action_high)
    if names == robot.action_names and (limits is None or np.allclose(limits, own)):
        return
    ends = "" if limits is None else f" (from {list(limits[0])} to {list(limits[1])})"
    raise FieldError(
        "like.root",
        like.root,
        f"its actions are {', '.join(names)}{ends}, those of the world model {robot.range_text()}",
        "give a dataset of the same robot, or `like_columns=false` if nothing is to be merged",
    )

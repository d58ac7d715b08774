"""Configuration of an environment of Hugging Face's hub (LeRobot's EnvHub), `--env.type=hub`."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from huggingface_hub.errors import HFValidationError
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs import make_env
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION

from lerobot_wmrl.common.errors import FieldError, first_line


@EnvConfig.register_subclass("hub")
@dataclass
class HubEnv(EnvConfig):
    """An environment whose code lies on Hugging Face's hub: LeRobot's EnvHub, for every command.

    LeRobot opens these in Python, `make_env("user/name", trust_remote_code=True)`; this names one on a
    command line, that of `lerobot-eval` too. What its actions are is known once it has been made: `features`.

    Args:
        hub_path: `user/name`, `user/name@revision` or `user/name@revision:file.py`; by default `env.py` on
            the main branch. The file defines `make_env(n_envs, use_async_envs)`.
        trust_remote_code: run that file here. It can do whatever you can: read it first, and name the commit
            that you have read as the revision.
        fps: frames a second of what the environment shows; it decides those of a recording.
    """

    hub_path: str = ""
    trust_remote_code: bool = False

    def __post_init__(self) -> None:
        """Raise FieldError if there is a path whose code may not run. Its actions are not known yet."""
        self.features.clear()
        self.features_map.clear()
        if self.hub_path and not self.trust_remote_code:
            raise FieldError(
                "trust_remote_code",
                False,
                f"the code of {self.hub_path} would run on this machine",
                "read it, then set this to true",
            )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Nothing: the hub's file knows how it makes its environment."""
        return {}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Make the environments, as {suite: {task: vector of `n_envs`}}.

        FieldError if there is no path, the file cannot be had, or makes another number of environments.
        """
        if not self.hub_path:
            raise FieldError("hub_path", "", "no environment is named", "give user/name, as on the hub")
        try:
            made: dict[str, dict[int, gym.vector.VectorEnv]] = make_env(
                self.hub_path, n_envs, use_async_envs, trust_remote_code=self.trust_remote_code
            )
        except (OSError, HFValidationError) as error:
            raise FieldError("hub_path", self.hub_path, f"cannot be had: {first_line(error)}") from error
        every = [env for tasks in made.values() for env in tasks.values()]
        counts = {env.num_envs for env in every}
        if counts != {n_envs}:
            raise FieldError(
                "hub_path",
                self.hub_path,
                f"asked for {n_envs} environments at once, its make_env made {sorted(counts) or 'none'}",
                "it must heed `n_envs`; or ask for one at a time",
            )
        space = every[0].single_action_space
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise FieldError(
                "hub_path",
                self.hub_path,
                f"its actions are {space}",
                "policies act by a vector (Box)",
            )
        # lerobot-eval asks for them once the environment is made
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, space.shape)}
        self.features_map = {ACTION: ACTION}
        return made

"""Real rollouts of a policy as a LeRobotDataset, by lerobot-wmrl-record in a process of its own."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import draccus
from lerobot.utils.constants import PRETRAINED_MODEL_DIR

from lerobot_wmrl.common.presets import Flags, format_flags
from lerobot_wmrl.common.subcommand import run_subcommand
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv

DERIVED = ("features", "features_map", "cameras")
"""Settings of the environment that follow from others, or are given apart."""


@dataclass(frozen=True)
class RolloutRecorder:
    """Records in this environment, with `num_workers` simulators, what these cameras see, with their depth if
    asked for."""

    env: WmrlManiSkillEnv
    num_workers: int
    cameras: Sequence[str]
    depth: bool

    def record(
        self, checkpoint: Path, episodes: int, seed: int, folder: Path, exploration: float = 0.0
    ) -> None:
        """A dataset in `folder`, which the same call completes if it was killed; episode i has `seed` + i."""
        flags: Flags = {
            "policy.path": str(checkpoint / PRETRAINED_MODEL_DIR), **env_flags(self.env),
            "env.cameras": str(list(self.cameras)), "depth": self.depth, "num_workers": self.num_workers,
            "num_episodes": episodes, "seed": seed, "exploration": exploration, "output_dir": str(folder),
        }  # fmt: skip
        run_subcommand(["lerobot-wmrl-record", *format_flags(flags)])


def env_flags(env: WmrlManiSkillEnv) -> Flags:
    """What is not as by default, `--env.type` included."""
    given, default = (draccus.encode(each) for each in (env, type(env)()))
    return {
        "env.type": env.type,
        **{
            f"env.{name}": value
            for name, value in given.items()
            if name not in DERIVED and value != default[name]
        },
    }

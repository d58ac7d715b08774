"""Recording what a policy does outside the world model, for the gate and for Dyna rounds."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from tqdm import trange

from lerobot_wmrl.common.flags import Flags, env_flags, program_call
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.common.processes import run_subcommand
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.embodiment import Embodiment
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.ledger import ROLLOUTS, Ledger, budget_flags
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.rollout_recorder import RolloutRecorder


class Recorder(Protocol):
    """Records what a policy does in `real_env`."""

    def record(
        self, checkpoint: Path, episodes: int, seed: int, folder: Path, exploration: float = 0.0
    ) -> None:
        """Record a dataset in `folder`, unless it is there: one episode from each of `seed`, `seed` + 1, …

        Args:
            checkpoint: checkpoint of the policy.
            episodes: how many.
            seed: seed of the first episode.
            folder: folder of the dataset.
            exploration: largest noise on the actions, as a share of half their range.
        """


@dataclass(frozen=True)
class ManiSkillRecorder:
    """Records in ManiSkill with lerobot-wmrl-record, in a process of its own.

    Args:
        env: the environment.
        num_workers: simulators at once.
        cameras: names of the recorded cameras.
        depth: whether depth is recorded too.
        budget: ledger in which the episodes are entered; None without.
    """

    env: WmrlManiSkillEnv
    num_workers: int
    cameras: Sequence[str]
    depth: bool
    budget: Path | None = None

    def record(
        self, checkpoint: Path, episodes: int, seed: int, folder: Path, exploration: float = 0.0
    ) -> None:
        flags: Flags = {
            "policy.path": str(checkpoint / PRETRAINED_MODEL_DIR),
            "num_workers": self.num_workers,
            **env_flags(replace(self.env, batched=False)),  # each worker has a simulation of its own
            "env.cameras": list(self.cameras),
            "depth": self.depth,
            "num_episodes": episodes,
            "seed": seed,
            "exploration": exploration,
            "output_dir": str(folder),
            **budget_flags(self.budget),
        }
        run_subcommand(program_call("lerobot-wmrl-record", flags))


@dataclass(frozen=True)
class EnvRecorder:
    """Records in any environment of LeRobot's with LeRobot's own rollout.

    Args:
        env: the environment; if it has several tasks, they take turns.
        robot: names and range of the actions, and names of the state, as the world model has them.
        device: device of the policy.
        budget: ledger in which the episodes are entered; None without.
        num_envs: episodes at once.
    """

    env: EnvConfig
    robot: Embodiment
    device: str
    budget: Path | None = None
    num_envs: int = 1

    def record(
        self, checkpoint: Path, episodes: int, seed: int, folder: Path, exploration: float = 0.0
    ) -> None:
        ledger = None if self.budget is None else Ledger(self.budget)
        if not folder.is_dir():
            if ledger is not None:
                ledger.require_left({ROLLOUTS: episodes})
            path = str(checkpoint / PRETRAINED_MODEL_DIR)
            policy = read_policy_config(path, [f"--device={self.device}"])
            rollouts = RolloutRecorder(
                self.env, policy, self.robot, exploration, num_envs=min(self.num_envs, episodes)
            )
            with trange(episodes, desc="Recording rollouts", unit="episode") as bar, closing(rollouts):
                rollouts.record(folder, range(seed, seed + episodes), lambda success: bar.update())
        if ledger is not None:
            ledger.charge(read_episodes(open_dataset(folder)), ROLLOUTS)

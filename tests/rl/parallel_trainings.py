"""Trainings in the point environment by as many processes as there are, for `torchrun`.

The argument is the folder to write to. The policy's noise is a function of what it sees, so that an
environment's episodes do not depend on which process it is in.
"""

import sys
import time
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from accelerate import PartialState

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "rl"))

from chunk_policy import ACTIONS, ChunkPolicy, Sample
from point_env import PointEnv

from lerobot_wmrl.common.distributed import broadcast_buffers, rank_and_size, reseed_other_ranks
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.rl.callbacks import Record
from lerobot_wmrl.rl.configuration_algorithms import PolicyGradientConfig, PPOConfig
from lerobot_wmrl.rl.configuration_grpo import GRPOConfig
from lerobot_wmrl.rl.rollout import RolloutBuffer
from lerobot_wmrl.rl.trainer import Schedule, make_algorithm, train

ENVS, STEPS, ITERATIONS = 24, 12, 3
GROUP = 4
WHOLE: dict[str, Any] = {"policy_lr": 1e-3, "minibatch_size": 10_000, "target_kl": 0.05}
"""A minibatch holds the whole rollout, so that a step is the same whichever process has which decisions."""

RUNS: dict[str, tuple[PolicyGradientConfig, int]] = {
    "ppo": (PPOConfig(value_iterations=1, value_normalisation=True, epochs=6, **WHOLE), 1),
    "ppo_in_passes": (PPOConfig(value_iterations=0, micro_batch_size=7, ratio="token", **WHOLE), 1),
    "ppo_in_chunks": (PPOConfig(value_iterations=0, **WHOLE), 3),
    "grpo": (GRPOConfig(group_size=GROUP, least_group_std=0.3, **WHOLE), 1),
}
"""Configurations, and steps of a decision."""


class SeeingIsDeciding(ChunkPolicy):
    """Its noise is a function of the observation, a smooth one: rounding errors must stay small."""

    def sample(self, observation: dict[str, Any]) -> Sample:
        distribution = self._distribution(observation)
        keys = torch.arange(1, self.chunk * ACTIONS + 1) * 2.0
        turned = (observation["observation.state"].sum(dim=1, keepdim=True) * keys).sin()
        noise = 1.4 * turned.view(-1, self.chunk, ACTIONS)
        raw_action = distribution.mean + distribution.stddev * noise
        return Sample(raw_action, distribution.log_prob(raw_action), self.value(observation))


class ApartPointEnv(PointEnv):
    """Its episodes start from seeds that do not depend on which process they are in, also within a group:
    where noise follows from what is seen, episodes from one start would all be the same."""

    resets = 0

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self.resets += 1
        return super().reset(seed=100 * self.resets + rank_and_size()[0] * self.num_envs)


class Pause:
    """Before the first update."""

    name = "pause"

    def due(self, iteration: int) -> bool:
        return iteration == 0

    def run(self, iteration: int, checkpoint: Path, folder: Path) -> Record:
        return {"checkpoint": int(checkpoint.name)}

    def apply(self, records: Mapping[int, Record]) -> None:
        """There is no conclusion."""


def run(name: str, output_dir: Path) -> None:
    """One training, of this process's environments. The second process comes to it late."""
    config, chunk = RUNS[name]
    torch.manual_seed(0)
    policy = SeeingIsDeciding(chunk)
    algorithm = make_algorithm(policy, config, output_dir)
    num_envs = ENVS // rank_and_size()[1]
    buffer = RolloutBuffer(STEPS, num_envs, "cpu")
    pipeline = Pipeline(prepare=lambda observation: observation, to_action=lambda raw: raw * 0.1)

    def save_pretrained(folder: Path) -> None:
        folder.mkdir(parents=True)
        torch.save(policy.state_dict(), folder / "policy.pt")

    output_dir.mkdir(parents=True, exist_ok=True)
    world = ApartPointEnv if isinstance(config, GRPOConfig) else PointEnv
    env, schedule = world(num_envs, horizon=6), Schedule(ITERATIONS, 1, seed=5)
    time.sleep(0.5 * rank_and_size()[0])
    train(env, algorithm, pipeline, buffer, schedule, output_dir, save_pretrained, [Pause()])


if __name__ == "__main__":
    PartialState(cpu=True, timeout=timedelta(minutes=4))  # for a process to wait for the other
    for each in RUNS:
        run(each, Path(sys.argv[1]) / each)
    rank, module = rank_and_size()[0], torch.nn.BatchNorm1d(2)
    torch.manual_seed(0)
    reseed_other_ranks(0)
    module(torch.rand(8, 2))
    broadcast_buffers(module)
    torch.save((torch.rand(3), module.running_mean), Path(sys.argv[1]) / f"apart-{rank}.pt")
    PartialState().destroy_process_group()

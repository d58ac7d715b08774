"""Where an iteration of PPO spends its time, in the world model and in ManiSkill, and what its buffer holds.

    python benchmarks/ppo.py --world_model=outputs/gate/action_world_model \\
        --text_world_model=outputs/imagined_ppo/text_world_model --dataset.root=outputs/gate/rollouts
    python benchmarks/ppo.py … --simulators=0 --device=cuda --num_envs=256

The loop of lerobot-wmrl-train with an untrained small policy, which costs what a trained one does. Of every
iteration: the world model (steps, pictures, restarts) or the simulator, the policy (in rollouts), the reward
(similarity to the goal too), the update, and the rest, which is the loop's own cost: at most 20 %. The first
iteration does not count. In the world model once more with the policy's encoder kept as it is
(`--algorithm.train_encoder=false`). With ManiSkill the same number of steps is taken by `--simulators`
processes. Writes docs/results/ppo_speed.json.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins

from imagined_env import add_world_models, world_model_env
from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_policy_cnn.modeling_cnn import CnnPolicy
from lerobot_policy_cnn.processor_cnn import make_cnn_pre_post_processors
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.pipeline import make_pipeline, unchanged
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.rl.configuration_algorithms import PPOConfig
from lerobot_wmrl.rl.ppo import PPO
from lerobot_wmrl.rl.rollout import RolloutBuffer, collect
from lerobot_wmrl.world_models.checkpoint import read_config

RESULTS: Final = Path(__file__).parents[1] / "docs" / "results" / "ppo_speed.json"
WORLD: Final = {"world_model": ("step", "decode", "restart", "start"), "reward": ("compute_reward",)}


class Stopwatch:
    """Seconds spent in methods, by what they are for. One inside another belongs to the outer."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.seconds, self.running = device, dict[str, float](), False

    def now(self) -> float:
        """After the device has done all it was given."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()

    def watch(self, owner: Any, part: str, *methods: str) -> None:
        """Count what `owner`'s methods take as `part`."""
        for name in methods:
            setattr(owner, name, self._timed(getattr(owner, name), part))

    def _timed(self, method: Callable[..., Any], part: str) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            if self.running:
                return method(*args, **kwargs)
            self.running, began = True, self.now()
            try:
                return method(*args, **kwargs)
            finally:
                self.running = False
                self.seconds[part] = self.seconds.get(part, 0.0) + self.now() - began

        return timed


def untrained_policy(env: gym.vector.VectorEnv, device: str) -> tuple[CnnPolicy, Any]:
    """A small policy for what the environment shows, and its pipeline."""
    shown = {name: value for name, value in env.reset(seed=0)[0].items() if isinstance(value, torch.Tensor)}
    kinds = {name: FeatureType.STATE if name == OBS_STATE else FeatureType.VISUAL for name in shown}
    inputs = {name: PolicyFeature(kinds[name], tuple(value.shape[1:])) for name, value in shown.items()}
    size = env.single_action_space.shape[0]
    output = {ACTION: PolicyFeature(FeatureType.ACTION, (size,))}
    config = CnnConfig(device=device, input_features=inputs, output_features=output)
    state = inputs[OBS_STATE].shape if OBS_STATE in inputs else (1,)
    stats = {
        name: {"mean": torch.zeros(shape), "std": torch.full(shape, 0.01)}
        for name, shape in {ACTION: (size,), OBS_STATE: state}.items()
    }
    processors = make_cnn_pre_post_processors(config, stats)
    stretched = env.store_compact() if hasattr(env, "store_compact") else unchanged
    return CnnPolicy(config).to(device).eval(), make_pipeline(config, *processors, shown=stretched)


def buffer_bytes(buffer: RolloutBuffer) -> int:
    """Return the bytes of everything that is kept of an iteration."""
    kept = [*vars(buffer).values(), *buffer.observations.tensors.values(), *buffer.columns.values()]
    return sum(value.numel() * value.element_size() for value in kept if isinstance(value, torch.Tensor))


def measure(env: Any, steps: int, iterations: int, device: str, train_encoder: bool = True) -> dict[str, Any]:
    """Shares of an iteration, medians of `iterations` after one that does not count."""
    policy, pipeline = untrained_policy(env, device)
    config = PPOConfig(value_iterations=0, target_kl=1e9, max_reference_kl=1e9, train_encoder=train_encoder)
    algorithm = PPO(policy, config)
    pipeline = algorithm.with_frozen_encoder(pipeline)
    buffer, watch = RolloutBuffer(steps, env.num_envs, device), Stopwatch(torch.device(device))
    if hasattr(env, "model"):
        for part, methods in WORLD.items():
            watch.watch({"world_model": env.model, "reward": env.reward}[part], part, *methods)
        watch.watch(env, "reward", "_progress")
    else:
        watch.watch(env, "simulator", "step", "reset")
    watch.watch(policy, "policy", "sample", "value", "encode")
    watch.watch(algorithm, "update", "make_minibatches", "update")
    found: list[dict[str, float]] = []
    for iteration in range(1 + iterations):
        watch.seconds, began = {}, watch.now()
        collect(env, policy, pipeline, buffer, iteration * env.num_envs)
        minibatches, _ = algorithm.make_minibatches(buffer, pipeline)
        algorithm.update(iter(minibatches))
        whole = watch.now() - began
        found.append({**watch.seconds, "rest": whole - sum(watch.seconds.values()), "iteration": whole})
    seconds = {name: float(np.median([each[name] for each in found[1:]])) for name in found[-1]}
    held = buffer_bytes(buffer)
    return {
        "environments": env.num_envs,
        "steps": buffer.steps * buffer.num_envs,
        "seconds": {name: round(value, 4) for name, value in seconds.items()},
        "shares": {name: round(value / seconds["iteration"], 3) for name, value in seconds.items()},
        "steps_per_s": round(buffer.steps * buffer.num_envs / seconds["iteration"], 1),
        "buffer_mbyte": round(held / 1e6, 2),
        "buffer_bytes_a_step": round(held / (buffer.steps * buffer.num_envs)),
    }


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_world_models(parser)
    parser.add_argument("--num_envs", type=int, default=64, help="imaginations at once")
    parser.add_argument("--steps", type=int, default=40, help="frames of each an iteration")
    parser.add_argument("--simulators", type=int, default=2, help="processes of ManiSkill; 0 leaves it out")
    parser.add_argument("--iterations", type=int, default=5, help="that count")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--output", type=Path, default=RESULTS, help="JSON file")
    return parser


def main() -> None:
    """Measure both worlds, print them, write them."""
    register_third_party_plugins()
    given = make_parser().parse_args()
    imagination = world_model_env(given, episode_length=given.steps, device=given.device)
    worlds: dict[str, tuple[Any, int]] = {"world_model": (imagination, given.num_envs)}
    if given.simulators:
        tokenizer = read_config(given.world_model, "action_world_model").trained_tokenizer
        simulator = WmrlManiSkillEnv(
            cameras=list(tokenizer.cameras),
            image_size=tokenizer.image_size,
            episode_length=given.steps,
        )
        worlds["maniskill"] = (simulator, given.simulators)
    results: dict[str, Any] = {"device": given.device, "threads": torch.get_num_threads()}
    for name, (config, num_envs) in worlds.items():
        env = config.create_tensor_env(num_envs, given.device)
        steps = given.steps * given.num_envs // num_envs
        results[name] = measure(env, steps, given.iterations, given.device)
        if name == "world_model":
            results["encoder_kept"] = measure(env, steps, given.iterations, given.device, train_encoder=False)
        env.close()
    print(json.dumps(results, indent=2))
    write_json(given.output, results)


if __name__ == "__main__":
    main()

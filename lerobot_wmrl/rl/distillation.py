"""Distillation of a planner into a policy, in imagination. T time, B environments, A action components."""

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from lerobot.rl.algorithms.configs import TrainingStats
from lerobot.utils.constants import OBS_STATE
from torch import Tensor, nn
from torch.optim import Optimizer
from tqdm import tqdm

from lerobot_wmrl.common.constants import INSTRUCTIONS, Observation
from lerobot_wmrl.common.distributed import (
    average_gradients,
    broadcast_buffers,
    gather_counts,
    hidden_progress,
    mean_over_processes,
    rank_and_size,
)
from lerobot_wmrl.common.errors import FieldError, TrainingStopped
from lerobot_wmrl.common.pipeline import Pipeline
from lerobot_wmrl.common.policies import unwrapped
from lerobot_wmrl.envs.world_model_env import WorldModelVectorEnv
from lerobot_wmrl.rl.algorithm import Algorithm
from lerobot_wmrl.rl.compatibility import require_encoder
from lerobot_wmrl.rl.configuration_distillation import DistillationConfig
from lerobot_wmrl.rl.expert_labels import (
    ExpertLabels,
    Windows,
    imagined_labels,
    recorded_successes,
    require_memory,
    successes,
)
from lerobot_wmrl.rl.observations import as_read_back
from lerobot_wmrl.rl.rollout import RolloutBuffer
from lerobot_wmrl.rl.seeds import seeded_noise
from lerobot_wmrl.world_models.planning import Planner

LABELS_FOLDER = "labels"

LEAST_STD_SHARE = 0.05
"""A component of actions is learnt if one normalised unit of the policy is at least this share of the
component's standard deviation in the world model's data. Otherwise it hardly varied where the policy was
trained, and its errors would outweigh all others in the loss."""


class Demonstrated(NamedTuple):
    """A rollout in which the planner took over: its actions (T, B, A), the steps of the planner in episodes
    that succeeded (T, B) bool, and metrics."""

    actions: Tensor
    labelled: Tensor
    metrics: dict[str, float]


class Distillation(Algorithm):
    """Fit a policy to a planner's actions in states that the policy leads to (DAgger, Ross et al. 2011).

    In each iteration the policy acts for some steps, and then the planner until success or the end. Its
    actions in episodes that succeeded become labels, and the policy takes steps on its supervised loss over
    the labels of all iterations and the successful episodes of the dataset.

    Args:
        policy: any policy of LeRobot that is cloned from observations and actions, trained in place.
        config: the algorithm's configuration.
        output_dir: the training's folder, where the labels are kept.
    """

    config_class = DistillationConfig
    name = "distillation"
    config: DistillationConfig

    def __init__(self, policy: Any, config: DistillationConfig, output_dir: Path) -> None:
        super().__init__(policy)
        self.config = config
        if not config.train_encoder:
            require_encoder(policy)
            unwrapped(policy).freeze_encoder()
        self.preset = policy.config.get_optimizer_preset()
        if self.preset is None:
            raise FieldError(
                "policy.type", policy.config.type, "has nothing to train", "distil into another policy"
            )
        self.parameters = [each for each in policy.parameters() if each.requires_grad]
        self.optimizer = self.make_optimizers_and_scheduler()[self.name]
        self.windows = Windows.of(policy.config)
        self.labels = ExpertLabels(output_dir / LABELS_FOLDER, rank_and_size()[0])
        self.has_read = not config.recorded
        """Whether nothing recorded is left to read."""

    def make_optimizers_and_scheduler(self) -> dict[str, Optimizer]:
        """Return the policy's own optimizer in lerobot-train, at a constant rate."""
        return {self.name: self.preset.build(self.lerobot_policy.get_optim_params())}

    def load_weights(self, weights: dict[str, Any], device: str | torch.device = "cpu") -> None:
        """Load the policy's weights from a checkpoint, and the labels of the iterations before it."""
        super().load_weights(weights, device)
        self.labels.load(self.iteration)

    def state_dict(self) -> dict[str, Tensor]:
        """Return nothing: the policy's checkpoint has all weights."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Tensor], device: str | torch.device = "cpu") -> None:
        """Do nothing, as there is nothing in `state_dict`."""

    def iterate(
        self, env: WorldModelVectorEnv, pipeline: Pipeline, rollout: RolloutBuffer, seed: int, last: bool
    ) -> dict[str, float]:
        started = time.perf_counter()
        if not self.has_read:
            self.has_read = True
            seen = self.lerobot_policy.config.input_features
            state_size = env.model.config.state_size if OBS_STATE in seen else 0
            self.labels.recorded = recorded_successes(
                env.config.dataset, self.seen_shapes(env), state_size, self.windows
            )
        shown = self.demonstrate(env, pipeline, rollout, seed)
        part = imagined_labels(rollout.observations, shown.actions, shown.labelled, self.windows)
        self.labels.add(self.iteration, part)
        imagined = gather_counts(sum(map(len, self.labels.imagined)), env.device)
        if not sum(imagined):
            raise TrainingStopped(
                f"iteration {self.iteration + 1}: the planner has not succeeded in any imagined episode, so "
                "there is nothing to learn from: raise `algorithm.planner.samples` or "
                "`algorithm.planner.iterations`, lower `env.done_threshold`, or train the world model longer",
                before_update=True,
            )
        if not min(gather_counts(len(self.labels), env.device)):
            raise TrainingStopped(
                f"iteration {self.iteration + 1}: in {imagined.count(0)} of {len(imagined)} processes the "
                "planner has not succeeded in any imagined episode: raise `num_envs`, or use fewer processes",
                before_update=True,
            )
        collected = time.perf_counter()
        updates = self.config.last_updates if last else self.config.updates
        stats = self.update(self.batches(updates, pipeline))
        return {
            **shown.metrics,
            **stats.to_log_dict(),
            "labels": float(len(self.labels)),
            "rollout_s": collected - started,
            "update_s": time.perf_counter() - collected,
        }

    @torch.no_grad()
    def demonstrate(
        self, env: WorldModelVectorEnv, pipeline: Pipeline, rollout: RolloutBuffer, seed: int
    ) -> Demonstrated:
        """Let the policy act for some steps, and then the planner, until every first episode has ended.

        The planner changes what the policy would do, of which a policy of several observations has seen one.
        """
        policy, steps, count = self.lerobot_policy.eval(), rollout.steps, env.num_envs
        horizon = self.config.planner.horizon

        def act(observation: Observation) -> Tensor:
            return pipeline.to_action(policy.select_action(pipeline.prepare(as_read_back(observation))))

        policy.reset()
        planner = self.make_planner(env, seed, self.learnt_components(env, pipeline))
        generator = torch.Generator().manual_seed(seed)
        longest = min(self.config.longest_lead, steps - 1, env.max_episode_steps - 1)
        lead = int(torch.randint(longest + 1, (), generator=generator)) if self.iteration else 0
        actions = torch.zeros(steps, count, env.single_action_space.shape[0], device=env.device)
        acting = torch.zeros(steps, count, dtype=torch.bool, device=env.device)
        alive = torch.ones(count, dtype=torch.bool, device=env.device)
        success, planned = torch.zeros_like(alive), torch.arange(count, device=env.device)
        observation, _ = env.reset(seed=seed)
        with seeded_noise(seed, env.device):
            for step in tqdm(range(steps), "rollout", leave=False, unit="step", disable=hidden_progress()):
                rollout.observations.write(step, pipeline.store(observation))
                if step < lead:
                    inputs = pipeline.prepare(rollout.observations.read_step(step))
                    actions[step] = pipeline.to_action(policy.select_action(inputs)).to(env.device)
                else:
                    ahead = (step - lead) % self.config.planner.execute
                    if not ahead:
                        planned = planned[alive[planned]]
                        tasks = [observation[INSTRUCTIONS][row] for row in planned.tolist()]
                        policy.reset()
                        proposed = env.policy_actions(act, planned, horizon)
                        left = env.max_episode_steps - step
                        chunk = planner.plan(env.newest_frames()[planned], tasks, proposed, left)
                    actions[step, planned] = chunk[:, ahead]
                    acting[step] = alive
                observation, _, terminated, truncated, _ = env.step(actions[step])
                success |= terminated & alive
                alive &= ~(terminated | truncated)
                if not alive.any():
                    break
        metrics = {"success_rate": success.float().mean().item(), "lead": float(lead)}
        return Demonstrated(actions, acting & success, mean_over_processes(metrics, env.device))

    def make_planner(self, env: WorldModelVectorEnv, seed: int, learnt: Tensor) -> Planner:
        """Return a planner in the environment's world model, with its criterion of success.

        It follows averages: labels vary less, and a policy fitted to them succeeds more often.
        """
        return Planner(
            env.model,
            None,
            self.config.planner,
            env.config.done_frames,
            averaged=True,
            low=env.action_low,
            high=env.action_high,
            seed=seed,
            searched=learnt,
        )

    def learnt_components(self, env: WorldModelVectorEnv, pipeline: Pipeline) -> Tensor:
        """Return which components of actions the policy can learn, see `LEAST_STD_SHARE`. (A,)"""
        deviation = env.model.action_deviation()
        if pipeline.action_unit is None:
            return torch.ones_like(deviation, dtype=torch.bool)
        return pipeline.action_unit.to(env.device) >= LEAST_STD_SHARE * deviation

    def seen_shapes(self, env: WorldModelVectorEnv) -> dict[str, tuple[int, int, int]]:
        """Return the shapes (3, H, W) of the frames that the policy sees, by camera."""
        shapes, seen = env.model.config.tokenizer.frame_shapes, self.lerobot_policy.config.input_features
        return {camera: shape for camera, shape in shapes.items() if camera in seen}

    def check_dataset(self, env: WorldModelVectorEnv, pipeline: Pipeline) -> None:
        """Raise FieldError if recorded successes are learnt from, and do not fit into memory or vary in what
        the policy cannot learn."""
        source = env.config.dataset
        if not (self.config.recorded and source.given):
            return
        table, episodes = successes(source)
        if not len(episodes):
            return
        require_memory(int(table.length[episodes].sum()), self.seen_shapes(env))
        strange = (~self.learnt_components(env, pipeline)).nonzero().flatten().tolist()
        if strange:
            name = env.model.config.embodiment.action_names[strange[0]]
            raise FieldError(
                "algorithm.recorded",
                True,
                f"{name} varies in the recorded episodes, and hardly where the policy was trained: its "
                "errors would outweigh all others",
                "set it to false, or train the policy further on these episodes first (lerobot-train "
                "--policy.path)",
            )

    def batches(self, updates: int, pipeline: Pipeline) -> Iterator[dict[str, Any]]:
        """Draw that many batches of labels."""
        for _ in tqdm(range(updates), "update", leave=False, unit="step", disable=hidden_progress()):
            yield pipeline.prepare(self.labels.draw(self.config.batch_size, pipeline.shown))

    def update(self, batch_iterator: Iterator[dict[str, Any]]) -> TrainingStats:
        """Take one optimizer step on each batch.

        Raises:
            TrainingStopped: a loss or gradient is not finite; the last checkpoint is kept.
        """
        losses, norms = [], []
        self.lerobot_policy.train()
        for batch in batch_iterator:
            loss, _ = self.lerobot_policy.forward(batch)
            self.optimizer.zero_grad()
            loss.backward()
            average_gradients(self.parameters)
            norm = nn.utils.clip_grad_norm_(self.parameters, self.preset.grad_clip_norm or math.inf)
            if not (torch.isfinite(loss) and torch.isfinite(norm)):
                raise TrainingStopped(
                    f"iteration {self.iteration + 1}: the loss or its gradient is not finite; the last "
                    "checkpoint is kept: lower `policy.optimizer_lr`"
                )
            self.optimizer.step()
            self.optimization_step += 1
            losses.append(loss.item())
            norms.append(norm.item())
        self.lerobot_policy.eval()
        broadcast_buffers(self.lerobot_policy)
        self.iteration += 1
        count = max(len(losses), 1)
        means = {"loss": sum(losses) / count, "norm": sum(norms) / count}
        means = mean_over_processes(means, self.parameters[0].device)
        extra = {"updates": float(len(losses))}
        return TrainingStats({"policy_loss": means["loss"]}, {"policy": means["norm"]}, extra=extra)

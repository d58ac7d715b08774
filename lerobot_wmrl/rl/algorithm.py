"""Base of the algorithms: policy and reference, optimiser, checkpoints, and reasons to stop."""

import copy
import math
from abc import abstractmethod
from typing import Any

import torch
from lerobot.rl.algorithms.base import RLAlgorithm
from lerobot.rl.algorithms.configs import TrainingStats
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer

from lerobot_wmrl.common.errors import FieldError, Stopped, within
from lerobot_wmrl.common.policies import load_trained_weights, unwrapped
from lerobot_wmrl.common.precision import require_exact_updates
from lerobot_wmrl.rl.configuration_algorithms import PolicyGradientConfig
from lerobot_wmrl.rl.policy_adapters import as_stochastic
from lerobot_wmrl.rl.protocol import EncodingPolicy

RATIO_ERROR, LOSS, NORM = "ratio_error", "_loss", "_grad_norm"


class TrainingStopped(Stopped):
    """Training cannot go on; the last checkpoint is good."""


class Algorithm(RLAlgorithm):
    """A policy, its frozen reference, and the optimiser of its parameters, as LeRobot's trainers expect them.

    Args:
        policy: LeRobot's policy, trained in place and kept as `lerobot_policy`. `self.policy` is a
            StochasticPolicy: the same object, or an adapter around it. `self.reference` is a copy of
            `self.policy` before training, the SFT policy.
        config: the algorithm's configuration.
    """

    config: PolicyGradientConfig
    iteration: int
    """Rollouts that were trained on."""

    def __init__(self, policy: Any, config: PolicyGradientConfig) -> None:
        self.lerobot_policy, self.policy = policy, as_stochastic(policy)
        self.config, self.iteration = config, 0
        if config.initial_std is not None:
            if not hasattr(self.policy, "set_std"):
                raise FieldError(
                    "algorithm.initial_std", config.initial_std,
                    "this policy has no standard deviation", "set it to null",
                )  # fmt: skip
            if self.policy is policy and unwrapped(policy) is not policy:
                raise FieldError(
                    "algorithm.initial_std", config.initial_std,
                    "is none of the adapters' parameters, which checkpoints hold alone",
                    "set it to null, or train without adapters",
                )  # fmt: skip
            with within("algorithm"):
                self.policy.set_std(config.initial_std)
        if not config.train_encoder:
            if not isinstance(unwrapped(self.policy), EncodingPolicy):
                raise FieldError(
                    "algorithm.train_encoder", config.train_encoder,
                    "this policy has no encoder that can be kept", "set it to true, or take the policy cnn",
                )  # fmt: skip
            self.policy.freeze_encoder()
        self.policy.eval()
        self.reference = frozen_copy(self.policy)
        self.value_parameters = list(self.policy.value_parameters())
        owned = {id(parameter) for parameter in self.value_parameters}
        self.policy_parameters = [
            p for p in self.policy.parameters() if p.requires_grad and id(p) not in owned
        ]
        if not (config.train_encoder or self.policy_parameters):
            raise FieldError(
                "algorithm.train_encoder", config.train_encoder,
                "leaves nothing of the policy to train: its adapters are all in the encoder",
                "set it to true, or give adapters to other layers (`peft.target_modules`)",
            )  # fmt: skip
        require_exact_updates(self.policy_parameters)
        self.optimizer = self.make_optimizers_and_scheduler()[self.name]

    @property
    def group_size(self) -> int:
        """Neighbouring environments that start from the same state."""
        return 1

    @abstractmethod
    def parameter_groups(self) -> dict[str, tuple[list[nn.Parameter], float]]:
        """Return parameters and learning rates by name."""

    def make_optimizers_and_scheduler(self) -> dict[str, Optimizer]:
        """Return AdamW with a constant rate for each parameter group."""
        groups = [{"params": params, "lr": rate} for params, rate in self.parameter_groups().values()]
        return {self.name: AdamW(groups, weight_decay=0.0)}

    def get_optimizers(self) -> dict[str, Optimizer]:
        """Return the optimiser in use, with its moments; `make_optimizers_and_scheduler` makes a new one."""
        return {self.name: self.optimizer}

    def load_weights(self, weights: dict[str, Any], device: str | torch.device = "cpu") -> None:
        """Load a checkpoint's weights into `lerobot_policy`. Reference and adapter stay as they are."""
        load_trained_weights(self.lerobot_policy, weights)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the tensors that the policy's own checkpoint lacks: its adapter's. Subclasses add theirs."""
        added = {} if self.policy is self.lerobot_policy else self.policy.own_tensors()
        return {f"adapter.{name}": value for name, value in added.items()}

    @torch.no_grad()
    def load_state_dict(self, state_dict: dict[str, Tensor], device: str | torch.device = "cpu") -> None:
        """Copy the tensors of `state_dict` into this algorithm's own."""
        own = self.state_dict()
        if state_dict.keys() != own.keys():
            raise ValueError(
                f"algorithm.type={self.name}: its tensors are {sorted(own)}, got {sorted(state_dict)}"
            )
        for name, value in own.items():
            value.copy_(state_dict[name])

    def check_finite(self, record: dict[str, float]) -> None:
        """Raise TrainingStopped if a logged number is not finite."""
        broken = [name for name, value in record.items() if not math.isfinite(value)]
        if broken:
            raise TrainingStopped(
                f"iteration {self.iteration + 1}: {', '.join(broken)} is not finite; the last checkpoint is "
                "kept: lower `algorithm.policy_lr`, or `algorithm.value_lr` of PPO"
            )

    def check_reference_kl(self, kl: float) -> None:
        """Raise TrainingStopped if the policy is further from the SFT policy than `max_reference_kl`."""
        if kl > self.config.max_reference_kl:
            raise TrainingStopped(
                f"iteration {self.iteration + 1}: the policy is {kl:.1f} nats a step from the "
                f"SFT policy, above `algorithm.max_reference_kl` ({self.config.max_reference_kl}); raise "
                "`algorithm.reference_coefficient` or lower `algorithm.policy_lr`"
            )


def frozen_copy(policy: Any) -> Any:
    """Return a copy that is not trained. It shares the parameters that the policy does not train either, such
    as a large network under LoRA's adapters."""
    frozen = {id(each): each for each in policy.parameters() if not each.requires_grad}
    return copy.deepcopy(policy, frozen).requires_grad_(False)


def training_stats(records: list[dict[str, float]], updates: int) -> TrainingStats:
    """Return each metric's mean over minibatches, and the first minibatch's ratio error, which is 0 up to
    rounding if `sample` and `evaluate` agree."""
    names = dict.fromkeys(name for record in records for name in record)
    seen = {name: [record[name] for record in records if name in record] for name in names}
    mean = {name: sum(values) / len(values) for name, values in seen.items()}
    losses = {name: mean.pop(name) for name in names if name.endswith(LOSS)}
    norms = {name.removesuffix(NORM): mean.pop(name) for name in names if name.endswith(NORM)}
    first = {"first_ratio_error": records[0][RATIO_ERROR]} if records else {}
    return TrainingStats(losses, norms, extra={**mean, **first, "updates": float(updates)})

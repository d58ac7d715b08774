"""What every algorithm's configuration says; PPO, `algorithm.type` ppo, and what it shares with GRPO."""

import logging
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.rl.algorithms.configs import RLAlgorithmConfig

from lerobot_wmrl.common.errors import require_at_least, require_choice, require_positive, require_share
from lerobot_wmrl.rewards.general import default_discount


@dataclass
class AlgorithmConfig(RLAlgorithmConfig):
    """What a training asks of every algorithm."""

    compares_starts: ClassVar[bool] = False
    """Whether episodes from the same start are compared with each other."""

    imitates_planner: ClassVar[bool] = False
    """Whether the policy learns what a planner does, and not from rewards."""

    discounts: ClassVar[bool] = True
    """Whether later rewards count less."""

    @classmethod
    def from_policy_config(cls, policy_cfg: Any) -> Self:
        """Return the defaults, which depend on no policy."""
        return cls()

    def check(self, num_envs: int, iterations: int, env: EnvConfig) -> None:
        """Raise FieldError if it cannot train in so many environments; warn if it would learn nothing."""

    def check_policy(self, policy: PreTrainedConfig) -> None:
        """Raise FieldError for a policy that it cannot train."""

    def discount(self, longest: int) -> float | None:
        """Return the discount factor of rewards in episodes of up to `longest` steps, None if it learns from
        no reward."""
        return None


@dataclass
class PolicyGradientConfig(AlgorithmConfig):
    """Options that PPO and GRPO share: ascent on a clipped objective, several epochs a rollout.

    Args:
        epochs: passes over the policy's decisions of each rollout. A decision is one call of the policy: an
            action, or a chunk of actions.
        minibatch_size: decisions in one optimizer step, in each process of `torchrun`.
        micro_batch_size: decisions in one forward and backward pass, if a whole minibatch does not fit into
            memory. The gradient stays the same; by default the whole minibatch.
        policy_lr: learning rate of the policy (AdamW).
        ratio: probability ratio that is clipped: of the whole `action`, or of each `token` (component) of it.
        reference_coefficient: weight of the KL penalty towards the SFT policy that training starts from, for
            each step that a decision covers.
        target_kl: KL to the policy that collected the rollout, in nats for each step that a decision covers.
            Above it, the updates of this iteration end early. A step of the optimiser that moves the policy
            ten times as far is undone, and the learning rate falls.
        max_reference_kl: KL to the SFT policy, in the same unit. Above it, the training stops.
        patience: iterations in a row without any reward (GRPO: without a group whose returns differ), after
            which the training stops: there is nothing to learn from.
        initial_std: standard deviation of exploration in normalised actions; by default the policy's own.
        train_encoder: train the policy's encoder of observations too. `false` keeps it as it was cloned, so
            that every frame is encoded once, and an update takes a small part of the time. For the policy
            `cnn`.
    """

    epochs: int = 3
    minibatch_size: int = 384
    micro_batch_size: int | None = None
    policy_lr: float = 1e-4
    ratio: str = "action"
    reference_coefficient: float = 0.02
    target_kl: float = 0.015
    max_reference_kl: float = 20.0
    patience: int = 5
    initial_std: float | None = None
    train_encoder: bool = True

    def __post_init__(self) -> None:
        require_positive(self, "epochs", "minibatch_size", "policy_lr", "target_kl", "max_reference_kl")
        require_at_least(self, 0, "reference_coefficient")
        require_at_least(self, 1, "patience")
        require_choice(self, "ratio", ("action", "token"))
        if self.micro_batch_size is not None:
            require_at_least(self, 1, "micro_batch_size")
        if self.initial_std is not None:
            require_positive(self, "initial_std")


@RLAlgorithmConfig.register_subclass("ppo")
@dataclass
class PPOConfig(PolicyGradientConfig):
    """Proximal policy optimisation (Schulman et al. 2017) with a KL penalty towards the SFT policy.

    Args:
        gamma: discount factor; by default 0.3 ** (1 / L) for episodes of up to L steps, which leaves 0.3 of a
            success in the last step: 0.97 for 40, 0.989 for 110, at most 0.999.
        gae_lambda: λ of generalised advantage estimation.
        clip: half-width of the interval around 1 in which the ratio may move.
        value_lr: learning rate of the value function (AdamW).
        value_iterations: number of iterations at the beginning in which only the value function learns.
        value_normalisation: normalise the value's targets by the returns' running mean and standard
            deviation, for returns far from 1 in size.
    """

    gamma: float | None = None
    gae_lambda: float = 0.95
    clip: float = 0.2
    value_lr: float = 5e-4
    value_iterations: int = 3
    value_normalisation: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "clip", "value_lr")
        require_at_least(self, 0, "value_iterations")
        require_share(self, "gae_lambda", "clip")
        if self.gamma is not None:
            require_positive(self, "gamma")
            require_share(self, "gamma")

    def check(self, num_envs: int, iterations: int, env: EnvConfig) -> None:
        """Warn if the value function alone would learn."""
        if self.value_iterations >= iterations:
            logging.warning(
                "iterations=%d: the policy stays as it is, because the value function alone learns in the "
                "first %d (algorithm.value_iterations)",
                iterations,
                self.value_iterations,
            )

    def discount(self, longest: int) -> float:
        """Return the discount factor of rewards in episodes of up to `longest` steps."""
        return default_discount(longest) if self.gamma is None else self.gamma

"""What the configurations of PPO and GRPO have in common."""

from dataclasses import dataclass
from typing import Any, Self

from lerobot.rl.algorithms.configs import RLAlgorithmConfig

RATIOS = ("action", "token")
SCHEDULES = ("constant", "linear", "cosine")


@dataclass
class PolicyGradientConfig(RLAlgorithmConfig):
    """Ascent on a clipped objective, several times on what one rollout has shown.

    Fields explain themselves below, where `--help` of the classes that inherit them finds it.
    """

    epochs: int = 3
    """Passes over each iteration's decisions."""
    minibatch_size: int = 384
    """Decisions an update, of all processes together."""
    micro_batch_size: int | None = None
    """Decisions in memory at once, where a minibatch is too large; the gradient is the same."""
    policy_lr: float = 1e-4
    """AdamW's learning rate."""
    lr_schedule: str = "constant"
    """Of the learning rates: constant, or linear or cosine towards 0 at the end of the run."""
    grad_clip_norm: float = 1.0
    """Largest norm of a gradient, of the policy's and of the value's separately."""
    ratio: str = "action"
    """What the objective clips: the ratio of a whole action, or that of each token, its components."""
    reference_coefficient: float = 0.02
    """Weight of KL(policy || cloned policy)."""
    entropy_coefficient: float = 0.0
    """Weight of the entropy bonus."""
    target_kl: float = 0.015
    """An iteration's updates stop once the policy has moved this far from its start."""
    max_reference_kl: float = 20.0
    """Training stops beyond this distance from the cloned policy, in nats a decision."""
    initial_std: float | None = None
    """Standard deviation of exploration, in normalised actions; by default the policy's own."""

    def __post_init__(self) -> None:
        self.require_positive("epochs", "minibatch_size", "policy_lr", "grad_clip_norm", "target_kl")
        self.require_choice("ratio", RATIOS)
        self.require_choice("lr_schedule", SCHEDULES)
        if self.micro_batch_size is not None:
            self.require_positive("micro_batch_size")

    def require_positive(self, *names: str) -> None:
        """ValueError names the first that is not."""
        for name in names:
            if getattr(self, name) <= 0:
                raise ValueError(f"algorithm.{name}={getattr(self, name)}: must be above 0")

    def require_share(self, *names: str) -> None:
        """ValueError names the first that is not in (0, 1]."""
        for name in names:
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"algorithm.{name}={getattr(self, name)}: must be above 0 and at most 1")

    def require_choice(self, name: str, choices: tuple[str, ...]) -> None:
        """ValueError unless the field is one of them."""
        if getattr(self, name) not in choices:
            raise ValueError(f"algorithm.{name}={getattr(self, name)}: choose one of {', '.join(choices)}")

    @classmethod
    def from_policy_config(cls, policy_cfg: Any) -> Self:
        """The defaults: nothing in them depends on the policy."""
        return cls()

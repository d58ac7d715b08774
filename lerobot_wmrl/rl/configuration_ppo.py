"""Configuration of PPO, `--algorithm.type=ppo`."""

from dataclasses import dataclass

from lerobot.rl.algorithms.configs import RLAlgorithmConfig

from lerobot_wmrl.rl.configuration_policy_gradient import PolicyGradientConfig

VALUE_LOSSES = ("huber", "clipped")


@RLAlgorithmConfig.register_subclass("ppo")
@dataclass
class PPOConfig(PolicyGradientConfig):
    """Proximal policy optimisation (Schulman et al. 2017) with a penalty for leaving the cloned policy.

    Args:
        gamma, gae_lambda: discount, and the λ of generalised advantage estimation.
        clip: half-width of the interval in which the ratio is free to move.
        value_lr: AdamW's learning rate of the value.
        value_iterations: first iterations, in which only the value learns.
        value_loss: `huber`, or `clipped`: squared, without gain from moving further than `value_clip`.
        value_clip: how far that is, in the value's own units.
        value_normalisation: whether the value learns returns in units of their standard deviation, as far as
            they are known by then: for returns that are not about 1 in size.
    """

    gamma: float = 0.97
    gae_lambda: float = 0.95
    clip: float = 0.2
    value_lr: float = 5e-4
    value_iterations: int = 3
    value_loss: str = "huber"
    value_clip: float = 0.2
    value_normalisation: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_share("gamma", "gae_lambda", "clip")
        self.require_positive("value_lr", "value_clip")
        self.require_choice("value_loss", VALUE_LOSSES)

"""The small image policy: what lerobot-train clones, lerobot-eval runs and PPO improves."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from huggingface_hub import ModelCard
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from torch import Tensor, nn
from torch.distributions import Normal

from lerobot_policy_cnn.configuration_cnn import CnnConfig
from lerobot_policy_cnn.networks import Trunk, random_shift

STATE_LIMIT = 10.0
"""Normalised states are clamped here: a state far from the demonstrations must not drown the image."""

CONSTANT_RANGE = 1e-3
"""A component of the normalised action that varies less than this in the demonstrations is constant."""

STD_MARGIN = 0.01
"""A standard deviation starts at least this share of the way from its bounds: at them it cannot learn."""

UNKNOWN_POLICY = "This is a **cnn** policy trained with [LeRobot](https://github.com/huggingface/lerobot)."
"""What LeRobot's card says of policies that are not its own."""

SUMMARY = (
    "A small convolutional policy, fast enough for a CPU: pictures of one or several cameras, the robot's "
    "state and the instruction in, a Gaussian of one action out. It is cloned by `lerobot-train`; the "
    "Gaussian's spread is then that of cloning's residuals, and its value network is untrained until "
    "`lerobot-wmrl-train` improves the policy by reinforcement learning, in a world model or in ManiSkill."
)
"""What the card says instead."""

Observation = dict[str, Any]


class Sample(NamedTuple):
    """What was sampled: unclipped actions and log-probs (B, K), values (B,)."""

    raw_action: Tensor
    log_prob: Tensor
    value: Tensor


class CnnPolicy(PreTrainedPolicy):
    """π(a|o) = N(mean(o), std) in normalised actions, one std a component; and a value V(o).

    Components that never varied in the demonstrations (rotations and gripper when pushing) are kept at
    their constant: they are not sampled, and their log-probability is 0. K components in all.
    """

    config_class = CnnConfig
    name = "cnn"

    target_low: Tensor
    target_high: Tensor

    def __init__(self, config: CnnConfig, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.cameras = sorted(config.image_features)
        state = config.state_feature
        inputs = (len(self.cameras), state.shape[0] if state else 0)
        sizes = (config.hidden_size, config.language_buckets, config.language_size)
        actions = config.action_feature.shape[0]
        self.actor = Trunk(*inputs, config.width, *sizes, outputs=actions)
        self.critic = Trunk(*inputs, config.value_width, *sizes, outputs=1)
        self.std_logit = nn.Parameter(torch.zeros(actions))
        self.set_std(config.initial_std)
        self.register_buffer("target_low", torch.full((actions,), torch.inf))
        self.register_buffer("target_high", torch.full((actions,), -torch.inf))

    def get_optim_params(self) -> list[dict[str, Any]]:
        """What cloning trains: everything but the value. The standard deviation has its own rate."""
        rate = self.config.optimizer_lr * self.config.std_lr_factor
        return [
            {"params": list(self.actor.parameters())},
            {"params": [self.std_logit], "lr": rate, "weight_decay": 0.0},
        ]

    def value_parameters(self) -> Iterator[nn.Parameter]:
        """The critic's own parameters: it shares nothing with the actor."""
        return self.critic.parameters()

    def reset(self) -> None:
        """Nothing is kept between steps."""

    def generate_model_card(self, *args: Any, **kwargs: Any) -> ModelCard:
        """LeRobot's card, which says what this policy is."""
        card = super().generate_model_card(*args, **kwargs)
        card.text = card.text.replace(UNKNOWN_POLICY, SUMMARY)
        return card

    def forward(self, batch: Observation, reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Cloning: Huber loss of the mean, and the Gaussian's log-likelihood for its std alone. → (), numbers

        `reduction="none"` gives one loss a row, (B,).
        """
        target = batch[ACTION].reshape(len(batch[ACTION]), -1)
        if self.training:
            self._widen_range(target)
        mean = self._mean(batch, augment=self.training)
        fit = F.huber_loss(mean, target, reduction="none").mean(dim=1)
        likelihood = Normal(mean.detach(), self.std(), validate_args=False).log_prob(target)
        loss = fit - (likelihood * self.varies()).mean(dim=1)
        metrics = {"fit_loss": fit.mean().item(), "std": self.std().mean().item()}
        return (loss.mean() if reduction == "mean" else loss), metrics

    @torch.no_grad()
    def predict_action_chunk(self, batch: Observation, **_: Any) -> Tensor:
        """A chunk of one action, the mean. → (B, 1, K)"""
        return self.select_action(batch)[:, None]

    @torch.no_grad()
    def select_action(self, batch: Observation, **_: Any) -> Tensor:
        """The mean action. → (B, K)"""
        self.eval()
        return self._mean(batch)

    def sample(self, observation: Observation) -> Sample:
        """Draw actions; `evaluate` gives these log-probs again."""
        mean = self._mean(observation)
        raw_action = torch.where(
            self.varies(), Normal(mean, self.std(), validate_args=False).sample(), mean
        ).detach()
        return Sample(raw_action, self._log_prob(mean, raw_action), self.value(observation))

    def evaluate(self, observation: Observation, raw_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """→ log-probs (B, K), entropies (B,), values (B,)"""
        mean = self._mean(observation)
        entropy = (Normal(mean, self.std(), validate_args=False).entropy() * self.varies()).sum(dim=1)
        return self._log_prob(mean, raw_action), entropy, self.value(observation)

    def value(self, observation: Observation) -> Tensor:
        """V(o). → (B,)"""
        return self.critic(*self._inputs(observation)).squeeze(1)

    def std(self) -> Tensor:
        """Standard deviation in normalised actions, smoothly within its bounds. → (K,)"""
        low, high = math.log(self.config.min_std), math.log(self.config.max_std)
        return (low + (high - low) * self.std_logit.sigmoid()).exp()

    @torch.no_grad()
    def set_std(self, std: float) -> None:
        """Start exploration from `std` in every component. ValueError outside the bounds."""
        low, high = self.config.min_std, self.config.max_std
        if not low <= std <= high:
            raise ValueError(f"initial_std={std}: must be between {low} and {high}, the policy's bounds")
        share = math.log(std / low) / max(math.log(high / low), 1e-8)
        self.std_logit.copy_(torch.full_like(self.std_logit, share).logit(STD_MARGIN))

    def varies(self) -> Tensor:
        """Components that the demonstrations vary; all of them before there were any. → (K,) bool"""
        unseen = self.target_high < self.target_low
        return unseen | (self.target_high - self.target_low > CONSTANT_RANGE)

    @torch.no_grad()
    def _widen_range(self, target: Tensor) -> None:
        self.target_low.copy_(torch.minimum(self.target_low, target.amin(dim=0)))
        self.target_high.copy_(torch.maximum(self.target_high, target.amax(dim=0)))

    def _mean(self, observation: Observation, augment: bool = False) -> Tensor:
        images, state, instructions = self._inputs(observation)
        if augment and self.config.max_shift:
            images = [random_shift(image, self.config.max_shift) for image in images]
        return torch.where(self.varies(), self.actor(images, state, instructions), self.target_low)

    def _log_prob(self, mean: Tensor, raw_action: Tensor) -> Tensor:
        return Normal(mean, self.std(), validate_args=False).log_prob(raw_action) * self.varies()

    def _inputs(self, observation: Observation) -> tuple[list[Tensor], Tensor | None, Sequence[str]]:
        """The observation after the preprocessor → images in [0, 1], clamped state, instructions."""
        missing = [camera for camera in self.cameras if camera not in observation]
        if missing:
            shown = ", ".join(name for name in observation if name.startswith(OBS_IMAGES)) or "none"
            raise ValueError(
                f"the policy needs {', '.join(missing)}, the environment or dataset shows {shown}: use "
                "one with the cameras that the policy was trained on"
            )
        images = [observation[camera].float() for camera in self.cameras]
        state = observation[OBS_STATE] if self.config.state_feature else None
        batch = len(images[0]) if images else len(observation[OBS_STATE])
        instructions = observation.get("task") or [""] * batch
        if isinstance(instructions, str):
            instructions = [instructions] * batch
        return images, None if state is None else state.float().clamp(-STATE_LIMIT, STATE_LIMIT), instructions

"""The small image policy: lerobot-train fits it to demonstrations, PPO improves it."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from huggingface_hub import ModelCard
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE
from torch import Tensor, nn
from torch.distributions import Normal

from lerobot_policy_cnn.configuration_cnn import MAX_STD, MIN_STD, CnnConfig, check_std
from lerobot_policy_cnn.networks import ObservationEncoder, Readout
from lerobot_policy_cnn.processor_cnn import bounded_statistics
from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.images import random_shift

STATE_LIMIT = 10.0
"""Normalised states are clamped to ± this: a state far from the demonstrations must not drown the image."""

CONSTANT_RANGE = 1e-3
"""A component of the normalised action counts as constant if its range in the demonstrations is smaller."""

STD_MARGIN = 0.01
"""Smallest distance of the initial standard deviation from its bounds, as a share of the way between them.
At a bound its gradient vanishes."""

STD_LR_FACTOR = 20.0
"""Learning rate of the standard deviation relative to the rest, in supervised training."""

FEATURES = "observation.features"
"""Name of the features of an encoded observation."""

UNKNOWN_POLICY = "This is a **cnn** policy trained with [LeRobot](https://github.com/huggingface/lerobot)."
"""The sentence on LeRobot's card of policies that are not its own, which SUMMARY replaces."""

SUMMARY = (
    "A small convolutional policy, fast enough for a CPU. From images of one or several cameras, the robot's "
    "state and the instruction it predicts a Gaussian of one action. `lerobot-train` fits it to "
    "demonstrations; the Gaussian's standard deviation is then that of the residuals, and the value network "
    "is untrained until `lerobot-wmrl-train` improves the policy by reinforcement learning, in a world model "
    "or in ManiSkill."
)


class GaussianSample(NamedTuple):
    """Sampled actions before clipping (B, K) in normalised units, log-probabilities (B, K), values (B,)."""

    raw_action: Tensor
    log_prob: Tensor
    value: Tensor


class CnnPolicy(PreTrainedPolicy):
    """π(a|o) = N(mean(o), std) over K normalised action components, one std for each; and a value V(o).

    Components that never varied in the demonstrations (rotations and gripper when pushing) keep their
    constant value. They are not sampled, and their log-probability is 0.
    """

    config_class = CnnConfig
    name = "cnn"

    target_low: Tensor
    target_high: Tensor

    def __init__(self, config: CnnConfig, dataset_meta: Any = None, **_: Any) -> None:
        super().__init__(config)
        if dataset_meta is not None and dataset_meta.stats:
            # lerobot-train normalises by these where it trains a policy further
            dataset_meta.stats.update(bounded_statistics(dataset_meta.stats))
        config.validate_features()
        self.cameras = sorted(config.image_features)
        state = config.state_feature
        inputs = (len(self.cameras), state.shape[0] if state else 0)
        actions = config.action_feature.shape[0]
        self.encoder = ObservationEncoder(*inputs, config.width)
        self.actor = Readout(self.encoder.size, config.hidden_size, outputs=actions)
        self.critic = Readout(self.encoder.size, config.hidden_size, outputs=1)
        self.std_logit = nn.Parameter(torch.zeros(actions))
        self.set_std(config.initial_std)
        self.register_buffer("target_low", torch.full((actions,), torch.inf))
        self.register_buffer("target_high", torch.full((actions,), -torch.inf))

    def get_optim_params(self) -> list[dict[str, Any]]:
        """Return the parameters that lerobot-train trains: all but the critic's."""
        rate = self.config.optimizer_lr * STD_LR_FACTOR
        return [
            {"params": [*self.encoder.parameters(), *self.actor.parameters()]},
            {"params": [self.std_logit], "lr": rate, "weight_decay": 0.0},
        ]

    def value_parameters(self) -> Iterator[nn.Parameter]:
        """Return the critic's parameters, none of which the actor shares."""
        return self.critic.parameters()

    def _get_default_peft_targets(self) -> dict[str, Any]:
        """Return what is trained beside adapters: the critic. `target_modules` must be given."""
        return {"modules_to_save": ["critic"]}

    def freeze_encoder(self) -> None:
        """Train actor and critic alone from now on, on what `encode` returns."""
        self.encoder.requires_grad_(False)

    def encode(self, observation: Observation) -> Observation:
        """Return an observation that all methods take in place of a preprocessed one: its features (B, F)."""
        return {FEATURES: self._features(observation)}

    def reset(self) -> None:
        """Do nothing: the policy has no state."""

    def generate_model_card(self, *args: Any, **kwargs: Any) -> ModelCard:
        """Return LeRobot's model card with a summary of this policy."""
        card = super().generate_model_card(*args, **kwargs)
        card.text = card.text.replace(UNKNOWN_POLICY, SUMMARY)
        return card

    def forward(self, batch: Observation, reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Return the supervised loss: Huber loss of the mean, and the log-likelihood for the std alone.

        Args:
            batch: preprocessed observations and `action`, (B, K) or (B, 1, K).
            reduction: `mean` → (), `none` → (B,).
        """
        target = batch[ACTION].reshape(len(batch[ACTION]), -1)
        if self.training:
            self._widen_range(target)
        mean = self._mean(self._features(batch, augment=self.training))
        fit = F.huber_loss(mean, target, reduction="none").mean(dim=1)
        likelihood = Normal(mean.detach(), self.std(), validate_args=False).log_prob(target)
        loss = fit - (likelihood * self.varies()).mean(dim=1)
        metrics = {"fit_loss": fit.mean().item(), "std": self.std().mean().item()}
        return (loss.mean() if reduction == "mean" else loss), metrics

    @torch.no_grad()
    def predict_action_chunk(self, batch: Observation, **_: Any) -> Tensor:
        """Return a chunk of one action, the mean. → (B, 1, K)"""
        return self.select_action(batch)[:, None]

    @torch.no_grad()
    def select_action(self, batch: Observation, **_: Any) -> Tensor:
        """Return the mean action. → (B, K)"""
        self.eval()
        return self._mean(self._features(batch))

    def sample(self, observation: Observation) -> GaussianSample:
        """Sample actions from the distribution that `evaluate` measures."""
        features = self._features(observation)
        mean = self._mean(features)
        raw_action = torch.where(
            self.varies(), Normal(mean, self.std(), validate_args=False).sample(), mean
        ).detach()
        return GaussianSample(raw_action, self._log_prob(mean, raw_action), self._value(features))

    def evaluate(self, observation: Observation, raw_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log-probabilities (B, K) of actions (B, K), entropies (B,) and values (B,)."""
        features = self._features(observation)
        mean = self._mean(features)
        entropy = (Normal(mean, self.std(), validate_args=False).entropy() * self.varies()).sum(dim=1)
        return self._log_prob(mean, raw_action), entropy, self._value(features)

    def value(self, observation: Observation) -> Tensor:
        """Return V(o). → (B,)"""
        return self._value(self._features(observation))

    def std(self) -> Tensor:
        """Return the standard deviation in normalised actions, within its bounds by a sigmoid. → (K,)"""
        low, high = math.log(MIN_STD), math.log(MAX_STD)
        return (low + (high - low) * self.std_logit.sigmoid()).exp()

    @torch.no_grad()
    def set_std(self, std: float) -> None:
        """Set the standard deviation of every component. FieldError outside its bounds."""
        check_std(std)
        share = math.log(std / MIN_STD) / math.log(MAX_STD / MIN_STD)
        self.std_logit.copy_(torch.full_like(self.std_logit, share).logit(STD_MARGIN))

    def varies(self) -> Tensor:
        """Return which components vary in the demonstrations; all of them before training. → (K,) bool"""
        unseen = self.target_high < self.target_low
        return unseen | (self.target_high - self.target_low > CONSTANT_RANGE)

    @torch.no_grad()
    def _widen_range(self, target: Tensor) -> None:
        self.target_low.copy_(torch.minimum(self.target_low, target.amin(dim=0)))
        self.target_high.copy_(torch.maximum(self.target_high, target.amax(dim=0)))

    def _features(self, observation: Observation, augment: bool = False) -> Tensor:
        """Return the features of a preprocessed or encoded observation. → (B, F)"""
        if FEATURES in observation:
            encoded: Tensor = observation[FEATURES]
            return encoded
        images, state, instructions = self._inputs(observation)
        if augment and self.config.max_shift:
            images = [random_shift(image, self.config.max_shift) for image in images]
        return self.encoder(images, state, instructions)

    def _mean(self, features: Tensor) -> Tensor:
        return torch.where(self.varies(), self.actor(features), self.target_low)

    def _value(self, features: Tensor) -> Tensor:
        """Return the critic's value. The encoder does not learn from it. (B, F) → (B,)"""
        return self.critic(features.detach()).squeeze(1)

    def _log_prob(self, mean: Tensor, raw_action: Tensor) -> Tensor:
        return Normal(mean, self.std(), validate_args=False).log_prob(raw_action) * self.varies()

    def _inputs(self, observation: Observation) -> tuple[list[Tensor], Tensor | None, Sequence[str]]:
        """Return images in [0, 1], the clamped state and instructions of a preprocessed observation."""
        missing = [camera for camera in self.cameras if camera not in observation]
        if missing:
            shown = ", ".join(name for name in observation if name.startswith(OBS_IMAGE)) or "none"
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

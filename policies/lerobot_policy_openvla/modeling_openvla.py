"""OpenVLA as a LeRobot policy, for fine-tuning, evaluation and reinforcement learning.

B batch, L prompt tokens, A action tokens.
"""

from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
import torch.nn.functional as F
from accelerate import init_empty_weights
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from torch import Tensor, nn
from torch.distributions import Categorical

from lerobot_policy_openvla.actions import ActionTokenizer, adopt_statistics
from lerobot_policy_openvla.checkpoint import (
    TOKENIZER_FILE,
    Files,
    OpenVLACheckpoint,
    read_companions,
    read_tensors,
    resolve_folder,
    stored_bytes,
    weight_files,
)
from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_policy_openvla.images import to_pixel_values
from lerobot_policy_openvla.loading import (
    AS_STORED,
    CONVERTED,
    check_key,
    compute_dtype,
    fill,
    openvla_config,
    require_memory,
)
from lerobot_policy_openvla.network import OpenVLANetwork, Prefix, make_value_head
from lerobot_policy_openvla.prompts import (
    END_ID,
    PromptTokenizer,
    select_inputs,
    train_tokenizer,
)
from lerobot_policy_openvla.sizes import Sizes
from lerobot_wmrl.common.constants import Observation
from lerobot_wmrl.common.precision import require_exact_updates

VALUE_HEAD = "value_head"


class Sample(NamedTuple):
    """Sampled actions: token ids int64 (B, A), their log-probs float32 (B, A), values (B,)."""

    raw_action: Tensor
    log_prob: Tensor
    value: Tensor


class OpenVLAPolicy(PreTrainedPolicy):
    """OpenVLA: greedy action tokens to act, a categorical over the 256 action tokens and a value for RL.

    Actions are token ids everywhere; the postprocessor turns them into the robot's actions.

    Args:
        config: sizes, and in `output_features` the number of tokens of an action.
        files: the files beside the weights of a checkpoint. Without them, a tokenizer is trained on the
            dataset's instructions.
        dataset_meta: metadata of a LeRobotDataset, whose statistics apply from now on.
        empty: create the network on the meta device, to be filled.
    """

    config_class = OpenVLAConfig
    name = "openvla"

    def __init__(
        self,
        config: OpenVLAConfig,
        files: Files | None = None,
        dataset_meta: Any = None,
        empty: bool = False,
        **_: Any,
    ) -> None:
        super().__init__(config)
        if dataset_meta is not None:
            adopt_statistics(config, dataset_meta)
        config.validate_features()
        vocabulary = config.sizes.llama.tokenizer_size
        if not files:
            instructions = [] if dataset_meta is None else [str(task) for task in dataset_meta.tasks.index]
            files = {TOKENIZER_FILE: train_tokenizer(instructions, vocabulary).to_str().encode()}
        self.files = files
        self.prompts = PromptTokenizer(files[TOKENIZER_FILE].decode())
        self.action_tokens = ActionTokenizer(vocabulary)
        self.dtype = compute_dtype(config.dtype, config.device or "cpu", random_start=not empty)
        with init_empty_weights() if empty else nullcontext():
            self.model = OpenVLANetwork(config.sizes).in_format(self.dtype)
        if config.gradient_checkpointing:
            self.model.enable_checkpointing()
        self.value_head = make_value_head([config.sizes.llama.width, *config.value_sizes])

    @classmethod
    def from_openvla(
        cls,
        source: str | Path,
        *,
        unnorm_key: str | None = None,
        device: str = "cpu",
        dtype: str = "auto",
        as_stored: bool = False,
    ) -> Self:
        """Load a checkpoint in OpenVLA's own format.

        Args:
            source: a folder or a hub id.
            unnorm_key: the dataset whose statistics apply; the only one needs no naming.
            device, dtype: as in the configuration.
            as_stored: keep the weights' own format, to convert and not to compute.
        """
        checkpoint = OpenVLACheckpoint.open(source)
        config = openvla_config(checkpoint, unnorm_key, device, dtype)
        policy = cls(config, files=checkpoint.companions, empty=True)
        stored = stored_bytes(checkpoint.locations) if as_stored else None
        policy._fill(policy.model, checkpoint.tensors(), str(source), stored)
        return policy.to(device).eval()

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: PreTrainedConfig | None = None,
        revision: str | None = None,
        dataset_meta: Any = None,
        as_stored: bool = False,
        **_: Any,
    ) -> Self:
        """Load a checkpoint in LeRobot's format, in evaluation mode; every weight must be there.

        Other keywords of LeRobot's method are accepted and ignored.
        """
        folder = resolve_folder(pretrained_name_or_path, revision)
        config = config or PreTrainedConfig.from_pretrained(folder)
        files = read_companions(folder)
        if TOKENIZER_FILE not in files:
            raise ValueError(f"{pretrained_name_or_path}: {TOKENIZER_FILE} is missing beside the weights")
        if dataset_meta is None:
            check_key(config, pretrained_name_or_path, folder)
        policy = cls(config, files=files, dataset_meta=dataset_meta, empty=True)
        weights = weight_files(folder)
        stored = stored_bytes(weights) if as_stored else None
        policy._fill(policy, read_tensors(weights), str(pretrained_name_or_path), stored)
        return policy.to(config.device).eval()

    def _fill(
        self, module: nn.Module, tensors: Iterable[tuple[str, Tensor]], source: str, stored: int | None
    ) -> None:
        """Load weights, converted to the policy's number format; the value head keeps its own.

        `stored` is the size of all weights in bytes if they must keep the format they are stored in, else
        None."""
        device = self.config.device or "cpu"
        if stored is None:
            count = sum(parameter.numel() for parameter in module.parameters())
            require_memory(count * self.dtype.itemsize, device, CONVERTED)
        else:
            require_memory(stored, device, AS_STORED)

        def convert(name: str, tensor: Tensor) -> Tensor:
            as_it_is = stored is not None or name.startswith(VALUE_HEAD)
            return tensor if as_it_is else tensor.to(self.dtype)

        fill(module, ((name, convert(name, tensor)) for name, tensor in tensors), device, source)

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        super()._save_pretrained(save_directory, state_dict=state_dict)
        for name, content in self.files.items():
            (save_directory / name).write_bytes(content)

    def _get_default_peft_targets(self) -> dict[str, Any]:
        return adapter_targets(self.config.sizes)

    def get_optim_params(self) -> list[nn.Parameter]:
        """Return what fine-tuning trains: everything that is not frozen, except the value head.

        Raises:
            FieldError: if that includes weights in bfloat16.
        """
        value_ids = {id(parameter) for parameter in self.value_parameters()}
        trained = [p for p in self.parameters() if p.requires_grad and id(p) not in value_ids]
        require_exact_updates(trained)
        return trained

    def value_parameters(self) -> Iterator[nn.Parameter]:
        """Return the value head's parameters. Its gradient does not reach the state that it reads."""
        return (parameter for parameter in self.value_head.parameters() if parameter.requires_grad)

    def reset(self) -> None:
        """Do nothing: the policy keeps nothing between steps."""

    def forward(self, batch: Observation, reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Compute the cross-entropy of the action tokens and the end token after them.

        Args:
            batch: an observation with `action` (B, A), normalised; it is clipped to [-1, 1].
            reduction: "mean", or "none" for one loss per row.

        Returns:
            The loss, () or (B,), and metrics.
        """
        actions = batch[ACTION].reshape(len(batch[ACTION]), -1)
        ids = self.action_tokens.encode(actions)
        losses, greedy = self._token_losses(self._observed(batch), ids)
        guess = self.action_tokens.decode(greedy)
        metrics = {
            "action_accuracy": (greedy == ids).float().mean().item(),
            "l1": (guess - actions.clamp(-1, 1)).abs().mean().item(),
        }
        return (losses.mean() if reduction == "mean" else losses.mean(dim=1)), metrics

    def _token_losses(self, prefix: Prefix, ids: Tensor) -> tuple[Tensor, Tensor]:
        """Return losses (B, A + 1), and the likeliest ids of the whole vocabulary (B, A)."""
        ids = ids.to(prefix.embeddings.device)
        logits = self.model.logits(self.model.states(prefix, ids))
        labels = F.pad(ids, (0, 1), value=END_ID)
        losses = F.cross_entropy(logits.transpose(1, 2), labels, reduction="none")
        return losses, logits[:, :-1].argmax(dim=2)

    @torch.no_grad()
    def select_action(self, batch: Observation, **_: Any) -> Tensor:
        """Return token ids (B, A), int64: the likeliest, or with `sampling` drawn ones."""
        self.eval()
        if self.config.sampling:
            return self.sample(batch).raw_action
        return self._greedy(self._observed(batch), self.config.action_size)

    @torch.no_grad()
    def predict_action_chunk(self, batch: Observation, **_: Any) -> Tensor:
        """Return a chunk of one action (B, 1, A), int64."""
        return self.select_action(batch)[:, None]

    def _greedy(self, prefix: Prefix, num_ids: int) -> Tensor:
        return self.model.decode(prefix, num_ids, lambda logits: logits.argmax(dim=1))[0]

    def sample(self, observation: Observation) -> Sample:
        """Draw action tokens; `evaluate` gives the same log-probs. Image and prompt are encoded once."""
        log_probs: list[Tensor] = []

        def draw(logits: Tensor) -> Tensor:
            distribution = self._distribution(logits[:, self._action_columns])
            column = distribution.sample()
            log_probs.append(distribution.log_prob(column))
            return self.action_tokens.first_id + column

        ids, state = self.model.decode(self._observed(observation), self.config.action_size, draw)
        return Sample(ids, torch.stack(log_probs, dim=1), self._value(state))

    def evaluate(self, observation: Observation, raw_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log-probs (B, A), entropies (B,), values (B,). Raises ValueError if an id is no action."""
        columns = self.action_tokens.columns(raw_action)
        states = self.model.states(self._observed(observation), raw_action[:, :-1])
        distribution = self._distribution(self._action_logits(states))
        return distribution.log_prob(columns), distribution.entropy().sum(dim=1), self._value(states[:, 0])

    def value(self, observation: Observation) -> Tensor:
        """Return the values V(o) (B,)."""
        return self._value(self.model.last_state(self._observed(observation)))

    def _value(self, state: Tensor) -> Tensor:
        """Return the value of the state that predicts the first action token. (B, D) → (B,)"""
        return self.value_head(state.detach().float()).squeeze(1)

    def _observed(self, observation: Observation) -> Prefix:
        """Encode the images and instructions of an observation."""
        images, instructions = select_inputs(self.config, observation)
        pixel_values = to_pixel_values(images.to(self._device), self.config.sizes.image_size)
        ids, mask = self.prompts.batch(instructions)
        return self._encoded(pixel_values, ids, mask)

    def _encoded(self, pixel_values: Tensor, ids: Tensor, mask: Tensor | None) -> Prefix:
        device = self._device
        return self.model.prefix(
            pixel_values.to(device), ids.to(device), None if mask is None else mask.to(device)
        )

    @property
    def _device(self) -> torch.device:
        return next(self.value_head.parameters()).device

    @property
    def _action_columns(self) -> slice:
        return slice(self.action_tokens.first_id, self.action_tokens.vocabulary)

    def _action_logits(self, states: Tensor) -> Tensor:
        return self.model.logits(states)[..., self._action_columns]

    def _distribution(self, logits: Tensor) -> Categorical:
        """Return the distribution of the 256 action tokens at the temperature, for sampling and log-probs."""
        return Categorical(logits=logits / self.config.temperature, validate_args=False)


def adapter_targets(sizes: Sizes) -> dict[str, Any]:
    """Return PEFT's default targets: every linear layer that contributes, and the whole value head.

    It is OpenVLA's and RL4VLA's choice. The vision transformers' last blocks and the pooling head contribute
    nothing, so they get no adapters.
    """
    depths = {"featurizer": sizes.dino.depth, "fused_featurizer": sizes.siglip.depth}
    linear = r"(attn\.(qkv|proj)|mlp\.fc\d)"
    layers = [
        rf"vision_backbone\.{name}\.blocks\.({_any_below(depth - 1)})\.{linear}"
        for name, depth in depths.items()
    ]
    layers += [r"projector\.fc\d", r"language_model\.model\.layers\.\d+\.(self_attn|mlp)\.\w+_proj"]
    return {"target_modules": rf"model\.({'|'.join(layers)})", "modules_to_save": [VALUE_HEAD]}


def _any_below(count: int) -> str:
    return "|".join(map(str, range(count)))

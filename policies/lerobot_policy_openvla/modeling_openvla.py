"""OpenVLA as LeRobot trains, evaluates and improves it. B batch, L prompt tokens, A action tokens."""

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

from lerobot_policy_openvla.action_tokens import ActionTokenizer
from lerobot_policy_openvla.adapters import VALUE_HEAD, adapter_targets
from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig
from lerobot_policy_openvla.images import check_pixel_values, to_pixel_values
from lerobot_policy_openvla.loading import check_key, compute_dtype, fill, openvla_config
from lerobot_policy_openvla.memory import AS_STORED, CONVERTED, require_memory
from lerobot_policy_openvla.network import OpenVLANetwork, Prefix, make_value_head
from lerobot_policy_openvla.observations import look
from lerobot_policy_openvla.openvla_checkpoint import (
    TOKENIZER_FILE,
    Files,
    OpenVLACheckpoint,
    read_companions,
    read_tensors,
    resolve_folder,
    stored_bytes,
    weight_files,
)
from lerobot_policy_openvla.prompts import END_ID, PromptTokenizer, aligned_prompts, train_tokenizer
from lerobot_policy_openvla.statistics import adopt_statistics
from lerobot_wmrl.common.precision import require_exact_updates

Observation = dict[str, Any]


class Sample(NamedTuple):
    """What was sampled: token ids int64 (B, A), their log-probs float32 (B, A), values (B,)."""

    raw_action: Tensor
    log_prob: Tensor
    value: Tensor


class OpenVLAPolicy(PreTrainedPolicy):
    """Greedy action tokens to act; a categorical over the 256 action tokens, and a value, to improve by RL.

    Everything it answers with are token ids: the postprocessor turns them into the robot's actions.

    Args:
        config: says how large it is; `output_features` how many tokens an action has.
        files: what lies beside the weights of a checkpoint; without them, a tokenizer is learnt from the
            dataset's instructions.
        dataset_meta: a LeRobotDataset's, whose statistics from now on apply.
        empty: leave the network without memory, to be filled.
    """

    config_class = OpenVLAConfig
    name = "openvla"

    def __init__(
        self, config: OpenVLAConfig, files: Files | None = None, dataset_meta: Any = None,
        empty: bool = False, **_: Any,
    ) -> None:  # fmt: skip
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
        cls, source: str | Path, *, unnorm_key: str | None = None, device: str = "cpu", dtype: str = "auto",
        as_stored: bool = False,
    ) -> Self:  # fmt: skip
        """From OpenVLA's own format.

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
        cls, pretrained_name_or_path: str | Path, *, config: PreTrainedConfig | None = None,
        revision: str | None = None, dataset_meta: Any = None, as_stored: bool = False, **_: Any,
    ) -> Self:  # fmt: skip
        """From LeRobot's format, in evaluation mode; every weight must be there.

        Other keywords are those of LeRobot's method, accepted as it passes them.
        """
        folder = resolve_folder(pretrained_name_or_path, revision)
        config = config or PreTrainedConfig.from_pretrained(folder)
        files = read_companions(folder)
        if TOKENIZER_FILE not in files:
            raise ValueError(f"{pretrained_name_or_path}: {TOKENIZER_FILE} is missing beside the weights")
        if dataset_meta is None:
            check_key(config)
        policy = cls(config, files=files, dataset_meta=dataset_meta, empty=True)
        weights = weight_files(folder)
        stored = stored_bytes(weights) if as_stored else None
        policy._fill(policy, read_tensors(weights), str(pretrained_name_or_path), stored)
        return policy.to(config.device).eval()

    def _fill(
        self, module: nn.Module, tensors: Iterable[tuple[str, Tensor]], source: str, stored: int | None
    ) -> None:
        """Weights into the network, converted to what it computes in; the value head's stay as they are.

        `stored`: bytes that all take as they are stored, if they shall keep that format.
        """
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
        """What fine-tuning trains: everything that is not frozen, but for the value. ValueError if that
        includes weights in bfloat16."""
        own = {id(parameter) for parameter in self.value_parameters()}
        trained = [p for p in self.parameters() if p.requires_grad and id(p) not in own]
        require_exact_updates(trained)
        return trained

    def value_parameters(self) -> Iterator[nn.Parameter]:
        """The value head's: the state that it looks at does not learn from it."""
        return (parameter for parameter in self.value_head.parameters() if parameter.requires_grad)

    def reset(self) -> None:
        """Nothing is kept between steps."""

    def forward(self, batch: Observation, reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Cross-entropy of the action tokens and the end token after them. → (), numbers

        `batch["action"]` (B, A) is normalised; it is clipped to [-1, 1]. `reduction="none"` gives one loss a
        row, (B,).
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

    def token_losses(
        self, pixel_values: Tensor, input_ids: Tensor, attention_mask: Tensor, action_ids: Tensor
    ) -> Tensor:
        """−log p of every label: the action ids (B, A), then the end token. Arguments as `action_logits`'.

        → (B, A + 1). ValueError if an id is no action token.
        """
        self.action_tokens.columns(action_ids)
        return self._token_losses(self._prompted(pixel_values, input_ids, attention_mask), action_ids)[0]

    def _token_losses(self, prefix: Prefix, ids: Tensor) -> tuple[Tensor, Tensor]:
        """→ losses (B, A + 1), and the likeliest ids of the whole vocabulary (B, A)"""
        ids = ids.to(prefix.embeddings.device)
        logits = self.model.logits(self.model.states(prefix, ids))
        labels = F.pad(ids, (0, 1), value=END_ID)
        losses = F.cross_entropy(logits.transpose(1, 2), labels, reduction="none")
        return losses, logits[:, :-1].argmax(dim=2)

    @torch.no_grad()
    def select_action(self, batch: Observation, **_: Any) -> Tensor:
        """Token ids, for the postprocessor: the likeliest, or with `sampling` drawn ones. → int64 (B, A)"""
        self.eval()
        if self.config.sampling:
            return self.sample(batch).raw_action
        return self._greedy(self._observed(batch), self.config.action_size)

    @torch.no_grad()
    def predict_action_chunk(self, batch: Observation, **_: Any) -> Tensor:
        """A chunk of one action. → int64 (B, 1, A)"""
        return self.select_action(batch)[:, None]

    @torch.no_grad()
    def predict_action_ids(
        self, pixel_values: Tensor, input_ids: Tensor, attention_mask: Tensor, num_ids: int
    ) -> Tensor:
        """The likeliest id of the whole vocabulary, one after the other, as OpenVLA's own code predicts them.

        It always answers `num_ids` ids; the original stops at an end token, and then returns ids of the
        prompt. Arguments as `action_logits`'. → int64 (B, num_ids)
        """
        return self._greedy(self._prompted(pixel_values, input_ids, attention_mask), num_ids)

    def _greedy(self, prefix: Prefix, num_ids: int) -> Tensor:
        return self.model.decode(prefix, num_ids, lambda logits: logits.argmax(dim=1))[0]

    def action_logits(
        self, pixel_values: Tensor, input_ids: Tensor, attention_mask: Tensor, action_ids: Tensor
    ) -> Tensor:
        """Logits of the 256 action tokens by ascending id, at each of the given ids' places (teacher-forced).

        Args:
            pixel_values: (B, 6, H, W), normalised for DINOv2 and for SigLIP.
            input_ids: (B, L), prompts padded on the right; the lone space that OpenVLA puts between prompt
                and action is added where it is not there.
            attention_mask: (B, L), 0 where padded.
            action_ids: (B, A).

        Returns:
            float32 (B, A, 256).
        """
        prefix = self._prompted(pixel_values, input_ids, attention_mask)
        ids = action_ids.to(prefix.embeddings.device)
        return self._action_logits(self.model.states(prefix, ids[:, :-1]))

    def sample(self, observation: Observation) -> Sample:
        """Draw action tokens; `evaluate` gives these log-probs again. Picture and prompt are encoded once."""
        log_probs: list[Tensor] = []

        def draw(logits: Tensor) -> Tensor:
            distribution = self._distribution(logits[:, self._action_columns])
            column = distribution.sample()
            log_probs.append(distribution.log_prob(column))
            return self.action_tokens.first_id + column

        ids, state = self.model.decode(self._observed(observation), self.config.action_size, draw)
        return Sample(ids, torch.stack(log_probs, dim=1), self._value(state))

    def evaluate(self, observation: Observation, raw_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """→ log-probs (B, A), entropies (B,), values (B,). ValueError if an id is no action token."""
        columns = self.action_tokens.columns(raw_action)
        states = self.model.states(self._observed(observation), raw_action[:, :-1])
        distribution = self._distribution(self._action_logits(states))
        return distribution.log_prob(columns), distribution.entropy().sum(dim=1), self._value(states[:, 0])

    def value(self, observation: Observation) -> Tensor:
        """V(o). → (B,)"""
        return self._value(self.model.last_state(self._observed(observation)))

    def _value(self, state: Tensor) -> Tensor:
        """Of the state that predicts the first action token, (B, D) → (B,)"""
        return self.value_head(state.detach().float()).squeeze(1)

    def _observed(self, observation: Observation) -> Prefix:
        """Pictures and instructions of an observation, encoded."""
        images, instructions = look(self.config, observation)
        pixel_values = to_pixel_values(images.to(self._device), self.config.sizes.image_size)
        ids, mask = self.prompts.batch(instructions)
        return self._encoded(pixel_values, ids, mask)

    def _prompted(self, pixel_values: Tensor, input_ids: Tensor, attention_mask: Tensor) -> Prefix:
        """Pictures and prompts in OpenVLA's own form, encoded. ValueError if they have another."""
        check_pixel_values(pixel_values, self.config.sizes.image_size)
        ids, mask = aligned_prompts(input_ids, attention_mask, self.prompts.space_id)
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
        """What is sampled from and measured: the 256 action tokens at the temperature. (…, 256)"""
        return Categorical(logits=logits / self.config.temperature, validate_args=False)

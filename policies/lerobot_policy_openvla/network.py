"""The network: two vision transformers, a projector, a Llama. Weights have OpenVLA's names.

B batch, L prompt tokens, N patches, A action tokens, S = L + N, D width, V vocabulary.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import DynamicCache, LlamaConfig, LlamaForCausalLM

from lerobot_policy_openvla.sizes import CHANNELS, LlamaSizes, Sizes
from lerobot_policy_openvla.vision_transformer import VisionTransformer
from lerobot_wmrl.common.precision import compute_in

PROJECTOR_GROWTH = 4
"""Width of the projector's first layer relative to the features it gets."""


@dataclass(frozen=True)
class Prefix:
    """What the action tokens follow: begin of sequence, patches, instruction. All rows end together.

    Shorter instructions are padded between the patches and the text. `mask` (B, S) is False there, and
    `positions` (B, S) do not count it; both are None where nothing is padded.
    """

    embeddings: Tensor
    mask: Tensor | None = None
    positions: Tensor | None = None

    def followed_by(self, embeddings: Tensor) -> "Prefix":
        """Tokens (B, A, D) alone, for a cache that holds everything before; the mask covers both."""
        if self.mask is None or self.positions is None:
            return Prefix(embeddings)
        mask = torch.cat([self.mask, self.mask.new_ones(embeddings.shape[:2])], dim=1)
        return Prefix(embeddings, mask, contiguous_positions(mask)[:, -embeddings.shape[1] :])

    def extended(self, embeddings: Tensor) -> "Prefix":
        """With tokens (B, A, D) behind it."""
        added = self.followed_by(embeddings)
        joined = torch.cat([self.embeddings, embeddings], dim=1)
        return Prefix(joined, added.mask, None if added.mask is None else contiguous_positions(added.mask))


class VisionBackbone(nn.Module):
    """Features of both vision transformers side by side: DINOv2's channels, then SigLIP's."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.featurizer = VisionTransformer(sizes.dino, sizes.patches, sizes.patch_size)
        self.fused_featurizer = VisionTransformer(sizes.siglip, sizes.patches, sizes.patch_size)

    def forward(self, pixel_values: Tensor) -> Tensor:
        """(B, 6, H, W), the picture normalised for each of them → (B, N, D)"""
        dino, siglip = pixel_values.split(CHANNELS, dim=1)
        return torch.cat([self.featurizer(dino), self.fused_featurizer(siglip)], dim=2)


class Projector(nn.Module):
    """From image features to the language model's embeddings."""

    def __init__(self, features: int, width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(features, PROJECTOR_GROWTH * features)
        self.fc2 = nn.Linear(PROJECTOR_GROWTH * features, width)
        self.fc3 = nn.Linear(width, width)

    def forward(self, features: Tensor) -> Tensor:
        return self.fc3(F.gelu(self.fc2(F.gelu(self.fc1(features)))))


class OpenVLANetwork(nn.Module):
    """Pictures and prompts in, states of the language model that predict action tokens out."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.vision_backbone = VisionBackbone(sizes)
        self.projector = Projector(sizes.dino.width + sizes.siglip.width, sizes.llama.width)
        self.language_model = LlamaForCausalLM(llama_config(sizes.llama))

    def in_format(self, dtype: torch.dtype) -> Self:
        """Itself, with all weights in `dtype`. The rotary embedding's frequencies are none and stay in
        float32: rounded to bfloat16, they would turn position 280 by up to half a radian too far."""
        for parameter in self.parameters():
            parameter.data = parameter.data.to(dtype)
        return self

    def enable_checkpointing(self) -> None:
        """Recompute activations in the backward pass instead of keeping them (Chen et al. 2016)."""
        self.vision_backbone.featurizer.checkpointing = True
        self.vision_backbone.fused_featurizer.checkpointing = True
        self.language_model.gradient_checkpointing_enable({"use_reentrant": False})

    def prefix(self, pixel_values: Tensor, input_ids: Tensor, mask: Tensor | None = None) -> Prefix:
        """Encode pictures (B, 6, H, W) and prompts.

        Args:
            pixel_values: normalised for DINOv2 and for SigLIP.
            input_ids: (B, L), beginning with the begin-of-sequence token, ending with the last of the
                prompt: padded, where at all, behind the first token.
            mask: (B, L), False where padded; None means nowhere.
        """
        with self.computing():
            patches = self.projector(self.vision_backbone(pixel_values.to(self.dtype))).to(self.dtype)
        text = self.embed(input_ids)
        embeddings = torch.cat([text[:, :1], patches, text[:, 1:]], dim=1)
        if mask is None:
            return Prefix(embeddings)
        seen = torch.cat([mask[:, :1], mask.new_ones(patches.shape[:2]), mask[:, 1:]], dim=1).bool()
        return Prefix(embeddings, seen, contiguous_positions(seen))

    @property
    def dtype(self) -> torch.dtype:
        """Of the frozen weights, and of what is computed."""
        return self.language_model.lm_head.weight.dtype

    def computing(self) -> torch.autocast:
        """In bfloat16 adapters compute in bfloat16 too, though their weights are float32."""
        return compute_in(self.dtype, self.language_model.lm_head.weight.device)

    def embed(self, ids: Tensor) -> Tensor:
        """(B, L) → (B, L, D)"""
        return self.language_model.model.embed_tokens(ids)

    def states(self, prefix: Prefix, ids: Tensor) -> Tensor:
        """Teacher-forced: the states that predict `ids` (B, A) and the token after them. → (B, A + 1, D)"""
        whole = prefix.extended(self.embed(ids))
        with training_flags(self.language_model.model.layers, torch.is_grad_enabled()):
            return self._run(whole)[:, -1 - ids.shape[1] :]

    def last_state(self, prefix: Prefix) -> Tensor:
        """The state that predicts the first action token. → (B, D)"""
        return self._run(prefix)[:, -1]

    def decode(
        self, prefix: Prefix, num_ids: int, choose: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Token by token: `choose` turns logits (B, V) into ids (B,). The prefix is encoded once.

        → the ids (B, num_ids), and the state (B, D) that predicted the first of them.
        """
        cache = DynamicCache(config=self.language_model.config)
        first = state = self._run(prefix, cache)[:, -1]
        ids = [choose(self.logits(state))]
        while len(ids) < num_ids:
            prefix = prefix.followed_by(self.embed(ids[-1][:, None]))
            state = self._run(prefix, cache)[:, -1]
            ids.append(choose(self.logits(state)))
        return torch.stack(ids, dim=1), first

    def logits(self, states: Tensor) -> Tensor:
        """(…, D) → float32 (…, V)"""
        with self.computing():
            return self.language_model.lm_head(states).float()

    def _run(self, part: Prefix, cache: DynamicCache | None = None) -> Tensor:
        """States after the last norm, of `part`, which follows what the cache holds."""
        with self.computing():
            output = self.language_model.model(
                inputs_embeds=part.embeddings,
                attention_mask=part.mask,
                position_ids=part.positions,
                past_key_values=cache,
                use_cache=cache is not None,
            )
        return output.last_hidden_state


def contiguous_positions(mask: Tensor) -> Tensor:
    """0, 1, … over the True entries of (B, S). → (B, S)"""
    return (mask.long().cumsum(dim=1) - 1).clamp_min(0)


@contextmanager
def training_flags(layers: Iterable[nn.Module], enabled: bool) -> Iterator[None]:
    """Transformers checkpoints a layer in training mode only, and drops the cache there.

    PPO differentiates in evaluation mode and samples with a cache, so the flag is set on the layers alone
    (nothing below them: dropout stays off), while gradients are taken.
    """
    before = [layer.training for layer in layers]
    for layer in layers:
        layer.training = enabled
    try:
        yield
    finally:
        for layer, training in zip(layers, before, strict=True):
            layer.training = training


def llama_config(sizes: LlamaSizes) -> LlamaConfig:
    """As transformers has it. <PAD> is the first id after the tokenizer's own."""
    return LlamaConfig(
        hidden_size=sizes.width,
        num_hidden_layers=sizes.depth,
        num_attention_heads=sizes.heads,
        num_key_value_heads=sizes.kv_heads,
        intermediate_size=sizes.mlp_size,
        vocab_size=sizes.vocab_size,
        rms_norm_eps=sizes.norm_eps,
        rope_parameters={"rope_type": "default", "rope_theta": sizes.rope_theta},
        max_position_embeddings=sizes.max_positions,
        pad_token_id=sizes.tokenizer_size,
        attn_implementation="sdpa",
        tie_word_embeddings=False,
    )


def make_value_head(widths: Sequence[int]) -> nn.Sequential:
    """An MLP from `widths[0]` features through the others to one number, which starts as 0."""
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Linear(before, after), nn.GELU()]
    last = nn.Linear(widths[-1], 1)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(*layers, last)

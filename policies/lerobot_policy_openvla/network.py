"""The network: two vision transformers, a projector, a Llama. Weights have the names of OpenVLA and timm.

B batch, L prompt tokens, N patches, P prefix tokens of a vision transformer (class and registers), A action
tokens, S = L + N, D width, V vocabulary.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint
from transformers import DynamicCache, LlamaConfig, LlamaForCausalLM

from lerobot_policy_openvla.sizes import CHANNELS, LlamaSizes, Sizes, ViTSizes
from lerobot_wmrl.common.precision import compute_in

NORM_EPS = 1e-6
INITIAL_STD = 0.02

PROJECTOR_GROWTH = 4
"""Width of the projector's first layer relative to the features it gets."""


class LayerScale(nn.Module):
    """A learnt factor per channel (Touvron et al. 2021). OpenVLA calls it `scale_factor`, timm `gamma`."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale_factor = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.scale_factor


class Attention(nn.Module):
    """Multi-head self-attention without a mask. (B, N, D) → (B, N, D)"""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        query, key, value = self.qkv(x).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        attended = F.scaled_dot_product_attention(query, key, value)
        return self.proj(attended.transpose(1, 2).flatten(2))


class MLP(nn.Module):
    """Two layers with the exact GELU between them."""

    def __init__(self, width: int, hidden_size: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden_size)
        self.fc2 = nn.Linear(hidden_size, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class Block(nn.Module):
    """Pre-norm attention and MLP; DINOv2 scales both (`layer_scale`)."""

    def __init__(self, sizes: ViTSizes, layer_scale: bool) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(sizes.width, NORM_EPS)
        self.attn = Attention(sizes.width, sizes.heads)
        self.ls1 = LayerScale(sizes.width) if layer_scale else nn.Identity()
        self.norm2 = nn.LayerNorm(sizes.width, NORM_EPS)
        self.mlp = MLP(sizes.width, sizes.mlp_size)
        self.ls2 = LayerScale(sizes.width) if layer_scale else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class PatchEmbedding(nn.Module):
    """Embed patches as tokens. (B, 3, H, W) → (B, N, D)"""

    def __init__(self, patch_size: int, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(CHANNELS, width, patch_size, stride=patch_size)

    def forward(self, images: Tensor) -> Tensor:
        return self.proj(images).flatten(2).transpose(1, 2)


class AttentionPool(nn.Module):
    """SigLIP's pooling head. OpenVLA stores it and never runs it, so it has weights and no forward."""

    def __init__(self, sizes: ViTSizes) -> None:
        super().__init__()
        width = sizes.width
        self.latent = nn.Parameter(torch.zeros(1, 1, width))
        self.q = nn.Linear(width, width)
        self.kv = nn.Linear(width, 2 * width)
        self.proj = nn.Linear(width, width)
        self.norm = nn.LayerNorm(width, NORM_EPS)
        self.mlp = MLP(width, sizes.mlp_size)


class VisionTransformer(nn.Module):
    """Patch features of the block before the last, without the final norm and without prefix tokens.

    The last block, `norm` and `attn_pool` are stored by OpenVLA but do not contribute. They are here so that
    a checkpoint is exported as it was imported. DINOv2 has a class token, registers and LayerScale; SigLIP
    has the pooling head instead."""

    def __init__(self, sizes: ViTSizes, patches: int, patch_size: int) -> None:
        super().__init__()
        self.checkpointing = False
        prefix = {"cls_token": int(sizes.class_token), "reg_token": sizes.registers}
        self.prefix_names = [name for name, count in prefix.items() if count]
        self.prefix_tokens = sum(prefix.values())
        for name in self.prefix_names:
            self.register_parameter(name, nn.Parameter(torch.zeros(1, prefix[name], sizes.width)))
        self.pos_embed = nn.Parameter(torch.zeros(1, patches, sizes.width))
        self.patch_embed = PatchEmbedding(patch_size, sizes.width)
        self.blocks = nn.ModuleList(Block(sizes, sizes.class_token) for _ in range(sizes.depth))
        self.norm = nn.LayerNorm(sizes.width, NORM_EPS)
        if not sizes.class_token:
            self.attn_pool = AttentionPool(sizes)
        self.apply(_initialise_vit)

    def forward(self, images: Tensor) -> Tensor:
        """Normalised images (B, 3, H, W) → (B, N, D)"""
        x = self.patch_embed(images) + self.pos_embed
        prefix = [getattr(self, name).expand(len(x), -1, -1) for name in self.prefix_names]
        x = torch.cat([*prefix, x], dim=1)
        for block in self.blocks[:-1]:
            if self.checkpointing and torch.is_grad_enabled():
                x = checkpoint(block, x, use_reentrant=False)
            else:
                x = block(x)
        return x[:, self.prefix_tokens :]


def _initialise_vit(module: nn.Module) -> None:
    """Initialise as timm does: normal weights of std 0.02, also in embeddings and prefix tokens."""
    parameters = [parameter for _, parameter in module.named_parameters(recurse=False)]
    if isinstance(module, nn.Linear | nn.Conv2d):
        nn.init.trunc_normal_(module.weight, std=INITIAL_STD)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, VisionTransformer | AttentionPool):
        for parameter in parameters:
            nn.init.trunc_normal_(parameter, std=INITIAL_STD)


@dataclass(frozen=True)
class Prefix:
    """What the action tokens follow: begin of sequence, patches, instruction. All rows end together.

    Args:
        embeddings: (B, S, D). Shorter instructions are padded between the patches and the text.
        mask: (B, S), False where padded; None if nothing is padded.
        positions: (B, S), which do not count the padding; None if nothing is padded.
    """

    embeddings: Tensor
    mask: Tensor | None = None
    positions: Tensor | None = None

    def followed_by(self, embeddings: Tensor) -> "Prefix":
        """Return only the tokens (B, A, D), for a KV cache that holds the prefix; the mask covers both."""
        if self.mask is None or self.positions is None:
            return Prefix(embeddings)
        mask = torch.cat([self.mask, self.mask.new_ones(embeddings.shape[:2])], dim=1)
        return Prefix(embeddings, mask, contiguous_positions(mask)[:, -embeddings.shape[1] :])

    def extended(self, embeddings: Tensor) -> "Prefix":
        """Return the prefix with the tokens (B, A, D) behind it."""
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
        """Encode images normalised for each of the two. (B, 6, H, W) → (B, N, D)"""
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
    """Images and prompts in, states of the language model that predict action tokens out."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.vision_backbone = VisionBackbone(sizes)
        self.projector = Projector(sizes.dino.width + sizes.siglip.width, sizes.llama.width)
        self.language_model = LlamaForCausalLM(llama_config(sizes.llama))

    def in_format(self, dtype: torch.dtype) -> Self:
        """Convert all weights to `dtype`, and return the network.

        The rotary embedding's frequencies are no weights and stay in float32: rounded to bfloat16, they would
        turn position 280 by up to half a radian too far.
        """
        for parameter in self.parameters():
            parameter.data = parameter.data.to(dtype)
        return self

    def enable_checkpointing(self) -> None:
        """Recompute activations in the backward pass instead of keeping them (Chen et al. 2016)."""
        self.vision_backbone.featurizer.checkpointing = True
        self.vision_backbone.fused_featurizer.checkpointing = True
        self.language_model.gradient_checkpointing_enable({"use_reentrant": False})

    def prefix(self, pixel_values: Tensor, input_ids: Tensor, mask: Tensor | None = None) -> Prefix:
        """Encode images and prompts.

        Args:
            pixel_values: (B, 6, H, W), normalised for DINOv2 and for SigLIP.
            input_ids: (B, L), from the begin-of-sequence token to the last of the prompt. Padding stands
                behind the first token.
            mask: (B, L), False where padded; None if nothing is padded.
        """
        with self.computing():
            patches = self.projector(self.vision_backbone(pixel_values.to(self.dtype))).to(self.dtype)
        text = self.embed(input_ids)
        embeddings = torch.cat([text[:, :1], patches, text[:, 1:]], dim=1)
        if mask is None:
            return Prefix(embeddings)
        attended = torch.cat([mask[:, :1], mask.new_ones(patches.shape[:2]), mask[:, 1:]], dim=1).bool()
        return Prefix(embeddings, attended, contiguous_positions(attended))

    @property
    def dtype(self) -> torch.dtype:
        """Number format of the frozen weights and of the computation."""
        return self.language_model.lm_head.weight.dtype

    def computing(self) -> torch.autocast:
        """Return an autocast context: with bfloat16 weights, float32 adapters compute in bfloat16 too."""
        return compute_in(self.dtype, self.language_model.lm_head.weight.device)

    def embed(self, ids: Tensor) -> Tensor:
        """Embed token ids. (B, L) → (B, L, D)"""
        return self.language_model.model.embed_tokens(ids)

    def states(self, prefix: Prefix, ids: Tensor) -> Tensor:
        """Return the states that predict `ids` (B, A) and the token after them. → (B, A + 1, D)"""
        whole = prefix.extended(self.embed(ids))
        with training_flags(self.language_model.model.layers, torch.is_grad_enabled()):
            return self._run(whole)[:, -1 - ids.shape[1] :]

    def last_state(self, prefix: Prefix) -> Tensor:
        """Return the state that predicts the first action token. → (B, D)"""
        return self._run(prefix)[:, -1]

    def decode(
        self, prefix: Prefix, num_ids: int, choose: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Decode token by token with a KV cache; the prefix is encoded once.

        Args:
            prefix: what the tokens follow.
            num_ids: how many tokens.
            choose: turns logits (B, V) into ids (B,).

        Returns:
            The ids (B, num_ids), and the state (B, D) that predicted the first of them.
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
        """Return float32 logits. (…, D) → (…, V)"""
        with self.computing():
            return self.language_model.lm_head(states).float()

    def _run(self, part: Prefix, cache: DynamicCache | None = None) -> Tensor:
        """Return the states after the last norm of `part`, which follows what the KV cache holds."""
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
    """Number the True entries of (B, S) from 0. → (B, S)"""
    return (mask.long().cumsum(dim=1) - 1).clamp_min(0)


@contextmanager
def training_flags(layers: Iterable[nn.Module], enabled: bool) -> Iterator[None]:
    """Set the layers' training flag, to switch their gradient checkpointing.

    Transformers checkpoints a layer in training mode only, and drops the KV cache there. PPO differentiates
    in evaluation mode and samples with a cache. So the flag is set on the layers alone while gradients are
    taken; nothing below them changes, so dropout stays off."""
    before = [layer.training for layer in layers]
    for layer in layers:
        layer.training = enabled
    try:
        yield
    finally:
        for layer, training in zip(layers, before, strict=True):
            layer.training = training


def llama_config(sizes: LlamaSizes) -> LlamaConfig:
    """Return the sizes as transformers' configuration. <PAD> is the first id after the tokenizer's own."""
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
    """Return an MLP from `widths[0]` features through the other widths to one value, which starts as 0."""
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Linear(before, after), nn.GELU()]
    last = nn.Linear(widths[-1], 1)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(*layers, last)

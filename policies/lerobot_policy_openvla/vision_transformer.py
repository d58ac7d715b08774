"""The two vision transformers of OpenVLA, in timm's names for their weights. Plain torch.

B batch, N patches, P prefix tokens (class and registers), D width.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from lerobot_policy_openvla.sizes import CHANNELS, ViTSizes

NORM_EPS = 1e-6
INITIAL_STD = 0.02


class LayerScale(nn.Module):
    """A learnt factor a channel (Touvron et al. 2021). OpenVLA calls it `scale_factor`, timm `gamma`."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale_factor = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.scale_factor


class Attention(nn.Module):
    """Every token looks at every other. (B, N, D) → (B, N, D)"""

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
    """One token a patch. (B, 3, H, W) → (B, N, D)"""

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

    The last block, `norm` and `attn_pool` are stored by OpenVLA but do not contribute: they are here so
    that a checkpoint comes out as it went in. DINOv2 is the one with a class token: it also has registers
    and LayerScale; SigLIP has the pooling head instead.
    """

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
        self.apply(_initialise)

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


def _initialise(module: nn.Module) -> None:
    """For a random start: normal weights of std 0.02, as timm has them, also in embeddings and prefixes."""
    own = [parameter for _, parameter in module.named_parameters(recurse=False)]
    if isinstance(module, nn.Linear | nn.Conv2d):
        nn.init.trunc_normal_(module.weight, std=INITIAL_STD)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, VisionTransformer | AttentionPool):
        for parameter in own:
            nn.init.trunc_normal_(parameter, std=INITIAL_STD)

"""Frame tokenizer: RGB frames to a grid of discrete tokens and back (MAGVIT-2's role).

A token is the index of one quantised vector (`quantizer.py`). Several cameras share the weights; their grids
are concatenated. As an option both directions are given the episode's first frame (`autoencoder.py`).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_wmrl.data.frames import NO_CONTEXT, Context
from lerobot_wmrl.world_models.autoencoder import ContextEncoder, Decoder, Encoder
from lerobot_wmrl.world_models.codebook import make_codebook, perplexity
from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig
from lerobot_wmrl.world_models.quantizer import Quantized, make_quantizer
from lerobot_wmrl.world_models.success import SuccessClassifier

MOTION_THRESHOLD = 0.08
"""A pixel has moved when a colour, in [0, 1], differs by more from the episode's first frame."""

MOVED_PIXEL_WEIGHT = 4.0
"""How much more a pixel counts in the loss once it has moved."""

ImageLoss = Callable[[Tensor, Tensor], Tensor]
"""Reconstructions and images (F, 3, H, W) in [−1, 1] → a loss ()."""


class Decoded(NamedTuple):
    """Images (B, N, 3, H, W) in [0, 1] and the decoder's feature maps [(B·N, C, h, w), …]."""

    images: Tensor
    features: list[Tensor]


class FrameTokenizer(nn.Module):
    """Encode frames as tokens and decode them: `decode(encode(images, c), c)` is the reconstruction.

    With the option `context`, c is what the method `context` returns for the first frames of the episodes;
    without it, c is left out.

    Args:
        config: cameras, sizes, quantizer and levels, and whether tokens are conditioned on the first frame.
    """

    def __init__(self, config: TokenizerConfig) -> None:
        super().__init__()
        widths, context = config.widths, config.context
        self.image_size, self.num_cameras = config.image_size, len(config.cameras)
        self.grid = config.image_size // config.downsample
        channels = make_codebook(config.quantizer, config.levels).channels
        self.encoder = Encoder(widths, channels, context)
        self.normalise = nn.BatchNorm2d(channels, affine=False)
        self.decoder = Decoder(widths, channels, context)
        self.quantizer = make_quantizer(config.quantizer, config.levels)
        self.whiten = nn.ModuleList(nn.BatchNorm2d(width, affine=False) for width in (widths[-1], widths[0]))
        self.context_encoder = ContextEncoder(widths) if context else None
        reads = bool(config.instructions)
        self.success = SuccessClassifier(self.num_cameras, reads) if config.success else None

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return next(self.parameters()).device

    @property
    def tokens_per_frame(self) -> int:
        """S, over all cameras."""
        return self.num_cameras * self.grid**2

    def context(self, images: Tensor) -> Context:
        """Return the context of first frames (B, N, 3, H, W) in [0, 1], empty without the option."""
        self._check_images(images)
        if self.context_encoder is None:
            return NO_CONTEXT
        scales = self.context_encoder(images.flatten(0, 1) * 2 - 1)
        maps = (scales[0], *self.encoder.project(scales), *self.decoder.project(scales))
        return Context(tuple(each.unflatten(0, images.shape[:2]) for each in maps))

    def encode(self, images: Tensor, context: Context = NO_CONTEXT) -> Tensor:
        """Images (B, N, 3, H, W) in [0, 1] → tokens (B, S) int64. ValueError for other cameras or sizes."""
        self._check_images(images)
        self._check_context(context, len(images))
        return self._quantize(images.flatten(0, 1) * 2 - 1, context).tokens.reshape(len(images), -1)

    def decode_with_features(self, tokens: Tensor, context: Context = NO_CONTEXT) -> Decoded:
        """Tokens (B, S) → images and the whitened feature maps from which similarity is measured."""
        self._check_context(context, len(tokens))
        values = self.quantizer.values(tokens.reshape(-1, self.grid, self.grid))
        pixels, features = self.decoder(values, context.projections()[1:])
        images = ((pixels + 1) / 2).clamp(0, 1).unflatten(0, (len(tokens), self.num_cameras))
        return Decoded(images, self._whitened(features))

    def decode(self, tokens: Tensor, context: Context = NO_CONTEXT) -> Tensor:
        """Tokens (B, S) → images (B, N, 3, H, W) in [0, 1]."""
        return self.decode_with_features(tokens, context).images

    def success_features(self, first: Tensor, images: Tensor) -> Tensor:
        """Return the success classifier's features of frames.

        Args:
            first: first frames of their episodes, (B, N, 3, H, W) in [0, 1].
            images: (B, N, 3, H, W) in [0, 1].

        Returns:
            (B, F), of mean 0 and variance 1 over the training frames.

        Raises:
            ValueError: the tokenizer was trained without the option `success`.
        """
        if self.success is None:
            raise ValueError("this tokenizer has no success classifier; train one with `tokenizer.success`")
        self._check_images(first)
        self._check_images(images)
        return self.success.features(first, images)

    def _quantize(self, pixels: Tensor, context: Context) -> Quantized:
        """Pixels (F, 3, H, W) in [−1, 1] → their quantised vectors.

        Every channel of the vectors is brought to mean 0 and variance 1 over the training frames. Nothing
        else bounds the encoder: its vectors could grow until all are rounded to the same code.
        """
        vectors = self.encoder(pixels, context.projections()[:1])
        return self.quantizer(self.normalise(vectors))

    def _check_images(self, images: Tensor) -> None:
        expected = (self.num_cameras, 3, self.image_size, self.image_size)
        if images.shape[1:] != expected:
            raise ValueError(
                f"images of shape {tuple(images.shape)}: this tokenizer takes (B, N, 3, H, W) = "
                f"(B, {', '.join(map(str, expected))}); resize them or train a tokenizer for them"
            )

    def _check_context(self, context: Context, batch: int) -> None:
        wanted = 0 if self.context_encoder is None else batch
        if len(context) != wanted:
            raise ValueError(
                f"the context of {len(context)} first frames: this tokenizer needs that of {wanted} for a "
                f"batch of {batch}; give what `context` returns for the first frame of every row's episode"
            )

    def _whitened(self, features: list[Tensor]) -> list[Tensor]:
        """Bring every channel to zero mean and unit variance over the training frames.

        Without it, what all frames share hides how they differ. The statistics are learnt in training and
        fixed afterwards.
        """
        return [whiten(feature) for whiten, feature in zip(self.whiten, features, strict=True)]

    def forward(
        self,
        images: Tensor,
        weight: Tensor | None = None,
        perceptual: ImageLoss | None = None,
        context: Context = NO_CONTEXT,
    ) -> tuple[Tensor, dict[str, float]]:
        """Compute the reconstruction loss: weighted L1 plus L2, the quantizer's and the perceptual one.

        Args:
            images: (B, N, 3, H, W) in [0, 1].
            weight: (B, N, 1, H, W), what each pixel counts; 1 by default.
            perceptual: a further loss on reconstructions and images.
            context: context of the episodes' first frames, with the option `context`.

        Returns:
            The loss () and metrics, among them the PSNR in dB, the perplexity of the
            batch's tokens, and the number of distinct frames among them, as a share.
        """
        self._check_images(images)
        self._check_context(context, len(images))
        flat = images.flatten(0, 1) * 2 - 1
        quantized = self._quantize(flat, context)
        pixels, features = self.decoder(quantized.values, context.projections()[1:])
        if self.training:
            self._whitened([feature.detach() for feature in features])
        error = pixels - flat
        weighted = error.abs() + error.square()
        if weight is not None:
            weighted = weighted * weight.flatten(0, 1)
        mse = error.detach().square().mean() / 4
        loss = weighted.mean() + quantized.loss
        metrics = {
            "psnr": float(-10 * torch.log10(mse)),
            "token_perplexity": perplexity(quantized.tokens),
            "distinct_frames": len(quantized.tokens.reshape(len(images), -1).unique(dim=0)) / len(images),
        }
        if perceptual is not None:
            term = perceptual(pixels, flat)
            loss, metrics["perceptual_loss"] = loss + term, term.item()
        return loss, metrics | quantized.metrics


def motion_weight(images: Tensor, reference: Tensor) -> Tensor:
    """Weigh pixels by 1 on the static background and by 1 + MOVED_PIXEL_WEIGHT where something has moved.

    A static background otherwise dominates the mean error and hides what decides success.

    Args:
        images: (B, N, 3, H, W) in [0, 1].
        reference: their episodes' first frames, of the same shape.

    Returns:
        (B, N, 1, H, W).
    """
    change = (images - reference).abs().amax(dim=2, keepdim=True)
    moved = F.max_pool2d((change.flatten(0, 1) > MOTION_THRESHOLD).float(), 5, stride=1, padding=2)
    return 1 + MOVED_PIXEL_WEIGHT * moved.reshape(change.shape)


def feature_distance(features: Sequence[Tensor], goal: Sequence[Tensor]) -> Tensor:
    """Apply LPIPS's formula (Zhang et al. 2018, eq. 1, unit weights) to two lists [(F, C, h, w), …] → (F,).

    Each map is normalised over channels at every position; squared differences are summed over channels,
    averaged over positions and layers.
    """
    distances = [
        (F.normalize(a, dim=1) - F.normalize(b, dim=1)).square().sum(1).mean((1, 2))
        for a, b in zip(features, goal, strict=True)
    ]
    return torch.stack(distances).mean(0)

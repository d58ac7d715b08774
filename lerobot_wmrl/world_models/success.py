"""Success seen in pictures: a classifier of frames, whose features a world model learns to predict.

A world model that learns one outcome an episode from a few hundred episodes soon knows these by heart. Frames
are many, and shifted and brightened copies are more, so a classifier of frames needs few episodes. Its
features say where things are. A world model that predicts them in every frame (latent prediction, as in
TD-MPC2, Hansen et al. 2024) learns what decides success, and reads success from the predicted features.

Where a dataset has several instructions, each reads success from the same features in its own way: what one
asks for may happen while another is followed. What happens next does not depend on the instruction.

B frames of N cameras, F features, E numbers that an instruction becomes.
"""

from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_wmrl.common.images import coordinates, random_shift, soft_positions
from lerobot_wmrl.common.instructions import distinct
from lerobot_wmrl.world_models.text import ByteTextEncoder, check_one_each

WIDTH: Final = 16
"""Channels of the first convolution."""

HIDDEN: Final = 128
"""Features that combine all cameras."""

GRID: Final = 8
"""Cells on each side of the pooled feature map."""

GRID_CHANNELS: Final = 16
"""Channels of the pooled feature map."""

DROPOUT: Final = 0.3

POSITIVE_WEIGHT: Final = 5.0
"""Weight of a frame with success in the loss. Such frames are rare: episodes end soon after success."""

SCALE_MOMENTUM: Final = 0.01
"""Weight of a batch in the running mean and variance of features."""

MAX_SHIFT: Final = 4
"""Pixels by which pictures are shifted at most, in training."""

MAX_GAIN: Final = 0.2
"""Share by which contrast changes at most, in training; brightness changes by half as much."""


class PairEncoder(nn.Module):
    """Encode one camera's first and present frame: positions of C channels, and a coarse map."""

    def __init__(self) -> None:
        super().__init__()
        wide = 2 * WIDTH
        self.stem = nn.Conv2d(6 + 2, WIDTH, 5, stride=2, padding=2)
        self.down = nn.Conv2d(WIDTH, wide, 3, stride=2, padding=1)
        self.fine = nn.Conv2d(wide, wide, 3, padding=1)
        self.coarse = nn.Conv2d(wide, wide, 3, stride=2, padding=1)
        self.grid = nn.Conv2d(wide, GRID_CHANNELS, 1)
        self.sharpness = nn.Parameter(torch.full((wide, 1, 1), 2.0))

    def forward(self, pair: Tensor) -> tuple[Tensor, Tensor]:
        """pair (B, 6, H, W), centred → positions (B, 4·WIDTH), coarse map (B, GRID_CHANNELS·GRID²)."""
        where = torch.stack(coordinates(pair.shape[2], pair.shape[3], pair)).expand(len(pair), -1, -1, -1)
        x = F.relu(self.down(F.relu(self.stem(torch.cat([pair, where], 1)))))
        fine = self.fine(x)
        coarse = self.grid(F.relu(self.coarse(F.relu(fine))))
        positions = soft_positions(self.sharpness * F.layer_norm(fine, fine.shape[2:]))
        return positions, F.adaptive_avg_pool2d(coarse, GRID).flatten(1)


class SuccessHead(nn.Module):
    """Scale features, and read success from scaled ones.

    Args:
        cameras: N.
    """

    def __init__(self, cameras: int) -> None:
        super().__init__()
        self.scale = nn.BatchNorm1d(num_features(cameras), affine=False, momentum=SCALE_MOMENTUM)
        self.linear = nn.Linear(HIDDEN, 1)

    def forward(self, features: Tensor, weights: Tensor | None = None) -> Tensor:
        """Scaled features (…, F) → logits of success (…). weights: as `read` takes them."""
        hidden = slice(-HIDDEN, None)
        mean, variance = self.scale.running_mean, self.scale.running_var
        assert mean is not None
        assert variance is not None
        std = (variance[hidden] + self.scale.eps).sqrt()
        return self.read(features[..., hidden] * std + mean[hidden], weights)

    def read(self, hidden: Tensor, weights: Tensor | None) -> Tensor:
        """Return logits of success.

        Args:
            hidden: what all cameras show, unscaled, (…, HIDDEN).
            weights: what the instruction adds to weights and bias, (…, E = HIDDEN + 1). None: nothing.
        """
        logit: Tensor = self.linear(hidden).squeeze(-1)
        if weights is None:
            return logit
        return logit + (hidden * weights[..., :-1]).sum(-1) + weights[..., -1]


class InstructionReader(nn.Module):
    """What an instruction adds to the weights and the bias by which success is read; at first nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = ByteTextEncoder(HIDDEN + 1)
        nn.init.zeros_(self.encoder.project.weight)
        nn.init.zeros_(self.encoder.project.bias)

    def forward(self, instructions: Sequence[str]) -> Tensor:
        """B instructions → (B, E). ValueError for an empty one, and for one that is too long."""
        different, rows = distinct(instructions)
        return self.weights(**self.encoder.tokens(different))[rows]

    def weights(self, input_ids: Tensor, attention_mask: Tensor) -> Tensor:
        """Bytes as ByT5 numbers them (U, M), and where there are any (U, M) → (U, E)."""
        kept = attention_mask[..., None].float()
        return (self.encoder.embed(input_ids, attention_mask) * kept).sum(1) / kept.sum(1)


class SuccessClassifier(nn.Module):
    """Tell from a frame and its episode's first frame whether success holds.

    Success can depend on where the episode began: an object pushed by 10 cm.

    Args:
        cameras: N.
        instructions: whether it reads what the episode's instruction asks for.
    """

    def __init__(self, cameras: int, instructions: bool = False) -> None:
        super().__init__()
        self.encoders = nn.ModuleList(PairEncoder() for _ in range(cameras))
        encoded = cameras * (4 * WIDTH + GRID_CHANNELS * GRID**2)
        self.mix = nn.Sequential(
            nn.Linear(encoded, HIDDEN),
            nn.LayerNorm(HIDDEN),
            nn.SiLU(),
            nn.Dropout(DROPOUT),
            nn.Linear(HIDDEN, HIDDEN),
            nn.SiLU(),
        )
        self.head = SuccessHead(cameras)
        self.instructions = InstructionReader() if instructions else None

    def unscaled(self, first: Tensor, frames: Tensor) -> Tensor:
        """Return positions, then what all cameras show. (B, N, 3, H, W) in [0, 1], twice → (B, F)"""
        pair = 4 * (torch.cat([first, frames], 2) - 0.5)
        encoded = [encoder(pair[:, camera].contiguous()) for camera, encoder in enumerate(self.encoders)]
        positions, maps = (torch.cat(parts, 1) for parts in zip(*encoded, strict=True))
        return torch.cat([positions, self.mix(torch.cat([positions, maps], 1))], 1)

    def features(self, first: Tensor, frames: Tensor) -> Tensor:
        """Return features of mean 0 and variance 1. (B, N, 3, H, W) in [0, 1], twice → (B, F)"""
        return self.head.scale(self.unscaled(first, frames))

    def loss(
        self, first: Tensor, frames: Tensor, success: Tensor, instructions: Sequence[str] = ()
    ) -> tuple[Tensor, dict[str, float]]:
        """Return binary cross-entropy on shifted and brightened frames, and metrics.

        Args:
            first: first frames of the frames' episodes, (B, N, 3, H, W) in [0, 1].
            frames: of the same shape.
            success: whether it holds, (B,) bool.
            instructions: one for each frame, read only if this classifier reads them.

        Raises:
            ValueError: there is not one instruction for each frame.
        """
        unscaled = self.unscaled(*augment(first, frames))
        self.head.scale(unscaled.detach())  # which follows their mean and variance
        weights = None
        if self.instructions is not None:
            check_one_each(instructions, len(frames))
            weights = self.instructions(instructions)
        logit = self.head.read(unscaled[:, -HIDDEN:], weights)
        weight = logit.new_tensor(POSITIVE_WEIGHT)
        loss = F.binary_cross_entropy_with_logits(logit, success.float(), pos_weight=weight)
        right = ((logit > 0) == success).float().mean()
        return loss, {"success_loss": loss.item(), "success_accuracy": right.item()}


class PredictedSuccess(nn.Module):
    """Predict the classifier's features of frames that are not seen, and read success from them.

    Args:
        width: width of the hidden states.
        cameras: N.
    """

    def __init__(self, width: int, cameras: int) -> None:
        super().__init__()
        self.features = nn.Linear(width, num_features(cameras))
        self.head = SuccessHead(cameras).requires_grad_(False)  # the classifier's own

    def forward(self, hidden: Tensor, weights: Tensor | None = None) -> Tensor:
        """Hidden states (…, D), and what the instruction adds (…, E), if it is read → logits (…, 1)."""
        return self.head(self.features(hidden), weights).unsqueeze(-1)


def num_features(cameras: int) -> int:
    """Return F, the number of features that a classifier of N cameras has."""
    return cameras * 4 * WIDTH + HIDDEN


def augment(first: Tensor, frames: Tensor) -> tuple[Tensor, Tensor]:
    """Shift, brighten and contrast both frames of each pair alike, each camera by a shift of its own.

    (B, N, 3, H, W) twice → the same
    """
    batch, cameras = frames.shape[:2]
    gain, offset = (2 * torch.rand(2, batch, 1, 1, 1, 1, device=frames.device) - 1) * MAX_GAIN
    pair = (torch.cat([first, frames], 2) - 0.5) * (1 + gain) + 0.5 + offset / 2
    shifted = random_shift(pair.flatten(0, 1), MAX_SHIFT).unflatten(0, (batch, cameras))
    return shifted[:, :, :3], shifted[:, :, 3:]

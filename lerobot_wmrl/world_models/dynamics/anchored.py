"""Each frame from the clip's first one and what was done since: no picture is ever fed back."""

from typing import Any

import torch
from torch import Tensor

from lerobot_wmrl.world_models.anchored import AnchoredNetwork
from lerobot_wmrl.world_models.clip import Clip
from lerobot_wmrl.world_models.frame_network import Prediction
from lerobot_wmrl.world_models.losses import (
    corrupt_digits,
    draw_rows,
    frames_since_start,
    next_frame_loss,
)


class AnchoredDynamics:
    """The network sees first frames; of a training clip it draws `drawn_frames`."""

    def __init__(self, config: Any) -> None:
        self.config = config

    def make_network(self, **sizes: Any) -> AnchoredNetwork:
        config = self.config
        return AnchoredNetwork(
            layers=config.layers, heads=config.heads, window=config.clip_length,
            context_channels=config.context_channels, **sizes,
        )  # fmt: skip

    def loss(self, model: Any, clip: Clip) -> tuple[Tensor, dict[str, float]]:
        """Eqs. 2-4: of some frames of a clip the tokens, of all of them done and the state."""
        network, config = model.network, self.config
        digits, state = network.codebook.digits(clip.tokens), model.normalize_state(clip.state)
        rows = draw_rows(clip.valid, config.drawn_frames)
        first = corrupt_digits(digits[:, :1], network.codebook, config.token_noise)
        prediction = network(
            first, state[:, :1], *model.condition(clip), length=digits.shape[1], frames=rows,
            context=clip.context,
        )  # fmt: skip
        frames = frames_since_start(network.codebook, digits, clip, config.motion_weight, rows)
        return next_frame_loss(prediction, network.codebook, frames, state, clip, config)

    @torch.no_grad()
    def predict(self, model: Any, clip: Clip) -> Prediction:
        """About every row's next frame, given the first frame and all actions until then."""
        digits = model.network.codebook.digits(clip.tokens[:, :1])
        state = model.normalize_state(clip.state[:, :1])
        prediction: Prediction = model.network(
            digits, state, *model.condition(clip), length=clip.tokens.shape[1], context=clip.context
        )
        return prediction

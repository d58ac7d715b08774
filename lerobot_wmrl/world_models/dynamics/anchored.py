"""Each frame from the clip's first one and what was done since: no picture is ever fed back."""

from typing import Any

import torch
from torch import Tensor

from lerobot_wmrl.common.precision import compute_in, imagination_dtype
from lerobot_wmrl.data.clips import Clip
from lerobot_wmrl.data.frames import Context
from lerobot_wmrl.world_models.anchored import AnchoredNetwork
from lerobot_wmrl.world_models.frame_network import Prediction
from lerobot_wmrl.world_models.losses import (
    corrupt_digits,
    draw_rows,
    frames_since_start,
    next_frame_loss,
)
from lerobot_wmrl.world_models.open_loop import OpenLoopPrediction, open_loop_stepwise


class AnchoredDynamics:
    """The network sees first frames; of a training clip it draws `drawn_frames`."""

    def __init__(self, config: Any) -> None:
        self.config = config

    def make_network(self, **sizes: Any) -> AnchoredNetwork:
        config = self.config
        return AnchoredNetwork(
            layers=config.layers, heads=config.heads, window=config.clip_length,
            context_channels=config.context_channels, dropout=config.dropout, **sizes,
        )  # fmt: skip

    def loss(self, model: Any, clip: Clip) -> tuple[Tensor, dict[str, float]]:
        """Eqs. 2-4: of some frames of a clip the tokens, of all of them done and the state."""
        network, config = model.network, self.config
        digits, state = network.codebook.codes(clip.tokens), model.normalize_state(clip.state)
        rows = draw_rows(clip.valid, config.drawn_frames)
        first = corrupt_digits(digits[:, :1], network.codebook, config.token_noise)
        prediction = network(
            first, state[:, :1], *model.condition(clip), length=digits.shape[1], frames=rows,
            context=clip.context,
        )  # fmt: skip
        frames = frames_since_start(network.codebook, digits, clip, config.motion_weight, rows)
        return next_frame_loss(prediction, network.codebook, frames, state, clip, config)

    @torch.no_grad()
    def predict(self, model: Any, clip: Clip, drawn: bool) -> Prediction:
        """Given the first frame and all actions until then."""
        digits = model.network.codebook.codes(clip.tokens[:, :1])
        state = model.normalize_state(clip.state[:, :1])
        none = torch.empty(len(digits), 0, dtype=torch.long, device=digits.device)
        prediction: Prediction = model.network(
            digits, state, *model.condition(clip), length=clip.tokens.shape[1],
            frames=None if drawn else none, context=clip.context,
        )  # fmt: skip
        return prediction

    def open_loop(
        self, model: Any, tokens: Tensor, state: Tensor, actions: Tensor, context: Context,
        depth: Tensor | None, generator: torch.Generator,
    ) -> OpenLoopPrediction:  # fmt: skip
        """In one pass, unless imagination would begin anew on the way."""
        network, length = model.network, actions.shape[1]
        if length > self.config.clip_length:
            return open_loop_stepwise(model, tokens, state, actions, context, depth, generator)
        digits, first = network.codebook.codes(tokens), model.normalize_state(state)
        last = torch.full((len(tokens), 1), length - 1, device=tokens.device)
        with compute_in(imagination_dtype(tokens.device, len(tokens)), tokens.device):
            prediction = network(
                digits[:, None], first[:, None], *model.encode_actions(actions), length=length, frames=last,
                context=context,
            )  # fmt: skip
        drawn = network.codebook.sample(prediction.logits.float(), self.config.temperature, generator)
        states = prediction.proprioception * model.state_std + model.state_mean
        return OpenLoopPrediction(prediction.done_logit, states, network.codebook.tokens(drawn[:, 0]))

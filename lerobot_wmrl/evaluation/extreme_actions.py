"""What the model makes of actions that no demonstration holds: does it stay sober?"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_wmrl.common.statistics import Estimate, Proportion
from lerobot_wmrl.evaluation.accuracy import HORIZON
from lerobot_wmrl.evaluation.gate import first_run
from lerobot_wmrl.evaluation.image_metrics import psnr
from lerobot_wmrl.evaluation.replay import BATCH, Source, open_loop
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel


def extreme_actions(own: Tensor, low: np.ndarray, high: np.ndarray) -> dict[str, Tensor]:
    """From an episode's own actions (E, T, A) and the dataset's extremes (A,), by name, each (E, T, A).

    saturated: all the time one corner of the box between the extremes, another for each episode;
    reversed: the own actions with the opposite sign; frozen: zeros.
    """
    corner = np.random.default_rng(0).random((len(own), own.shape[-1])) < 0.5
    saturated = torch.from_numpy(np.where(corner, low, high).astype(np.float32)).to(own)
    return {
        "saturated": saturated[:, None].expand_as(own),
        "reversed": -own,
        "frozen": torch.zeros_like(own),
    }


@torch.no_grad()
def robustness(
    model: ActionWorldModelRewardModel, source: Source, episodes: np.ndarray, threshold: float, frames: int
) -> dict[str, Any]:
    """For each kind of extreme actions, over at most `BATCH` starts and `HORIZON` frames: the share of
    episodes called a success, and the PSNR (dB) of the last frame against the first, both decoded.

    Frozen, nothing can succeed, and the picture ought to stay.
    """
    episodes, device = episodes[:BATCH], model.state_mean.device
    tokens, context = source.starts(episodes, model.tokenizer)
    state, own = source.first_state(episodes, device), source.actions(episodes, HORIZON, device)
    depth = source.first_depth(model, episodes)
    low, high = source.table.action.min(0), source.table.action.max(0)
    result: dict[str, Any] = {"episodes": len(episodes), "frames": HORIZON}
    for name, actions in extreme_actions(own, low, high).items():
        imagined = open_loop(model, tokens, state, actions, depth, context)
        called = first_run((imagined.done_probability >= threshold).cpu().numpy(), frames) >= 0
        first, last = (model.tokenizer.decode(t, context) for t in (tokens, imagined.tokens[:, -1]))
        result[name] = {
            "predicted_success": Proportion(int(called.sum()), len(called)).as_json(),
            "psnr_to_start": Estimate.mean(psnr(last, first).cpu().numpy()).as_json(),
        }
    return result

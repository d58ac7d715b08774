"""How far an action world model can be trusted: real episodes replayed open loop from their first frame."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor
from tqdm import trange

from lerobot_wmrl.constants import STATE_NAMES
from lerobot_wmrl.statistics import Proportion
from lerobot_wmrl.world_models.context import Context
from lerobot_wmrl.world_models.episode_table import EpisodeTable
from lerobot_wmrl.world_models.frame_cache import frames_to_tensor
from lerobot_wmrl.world_models.frame_tokenizer import MOTION_THRESHOLD
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel

DELTA_PSNR_STEP = 15
BATCH = 64


class OpenLoop(NamedTuple):
    """Imagined frames after each real action of E episodes, T steps.

    tokens (E, T, S); done_probability (E, T); proprioception (E, T, P).
    """

    tokens: Tensor
    done_probability: Tensor
    proprioception: Tensor


@dataclass
class Replay:
    """Real episodes and what the model made of them; row t of `imagined` belongs to real frame t + 1.

    context: the tokenizer's, of E first frames, if it is conditioned on one;
    valid (E, T): real frame t + 1 exists; acted (E, T): action t exists; done (E, T): real success.
    """

    table: EpisodeTable
    frames: np.ndarray
    episodes: np.ndarray
    imagined: OpenLoop
    shuffled: OpenLoop
    context: Context
    valid: np.ndarray
    acted: np.ndarray
    done: np.ndarray

    def real_frames(self, step: int) -> np.ndarray:
        """Real frames `step` rows after the start (the last one when it is over), (E, N, H, W, 3)."""
        return self.frames[self.rows(step)]

    def one_of_each(self) -> dict[str, int]:
        """The first episode that succeeded and the first that failed, by position."""
        success = self.done.any(1)
        first = {"success": success, "failure": ~success}
        return {name: int(mask.argmax()) for name, mask in first.items() if mask.any()}

    def rows(self, step: int) -> np.ndarray:
        """Dataset rows of that step. (E,)"""
        return self.table.start[self.episodes] + np.minimum(step, self.table.length[self.episodes] - 1)


@torch.no_grad()
def open_loop(model: ActionWorldModelRewardModel, tokens: Tensor, state: Tensor, actions: Tensor) -> OpenLoop:
    """Imagine from tokens (E, S), state (E, P) with real actions (E, T, A)."""
    imagination = model.start(tokens, state)
    steps = [model.step(imagination, actions[:, step]) for step in range(actions.shape[1])]
    return OpenLoop(
        torch.stack([step.tokens for step in steps], 1),
        torch.stack([step.done_logit.sigmoid() for step in steps], 1),
        torch.stack([step.proprioception for step in steps], 1),
    )


def replay(
    model: ActionWorldModelRewardModel, table: EpisodeTable, frames: np.ndarray, episodes: np.ndarray
) -> Replay:
    """Replay the episodes with their own actions, and with those of another episode for delta-PSNR."""
    length = table.length[episodes]
    steps = np.arange(length.max())
    rows = table.start[episodes][:, None] + np.minimum(steps, length[:, None] - 1)
    acted = steps < length[:, None]
    first = frames_to_tensor(frames[table.start[episodes]]).to(model.state_mean.device)
    state = torch.from_numpy(table.state[table.start[episodes]]).to(first.device)
    actions = torch.from_numpy(table.action[rows]).to(first.device)
    context = model.tokenizer.context(first)
    runs: list[list[OpenLoop]] = [[], []]
    for begin in trange(0, len(episodes), BATCH, desc="Replaying episodes", unit="batch"):
        part = slice(begin, begin + BATCH)
        tokens = model.tokenizer.encode(first[part], context[part])
        for run, given in zip(runs, (actions, actions.roll(1, 0)), strict=True):
            run.append(open_loop(model, tokens, state[part], given[part]))
    own, other = (OpenLoop(*map(torch.cat, zip(*run, strict=True))) for run in runs)
    valid = steps + 1 < length[:, None]
    done = table.done[rows] & acted
    return Replay(table, frames, episodes, own, other, context, valid, acted, done)


def accuracy_by_step(model: ActionWorldModelRewardModel, run: Replay) -> dict[str, Any]:
    """PSNR (dB) of whole frames and of what moved, delta-PSNR at 15 frames, TCP error (mm), all by step."""
    psnr, moving, delta, tcp = [], [], [], []
    start = run.real_frames(0).astype(np.float32) / 255
    for step in range(run.valid.shape[1]):
        keep = run.valid[:, step]
        if not keep.any():
            break
        real = run.real_frames(step + 1)[keep].astype(np.float32) / 255
        error = (decode(model, run.imagined.tokens[keep, step], run.context[keep]) - real) ** 2
        moved = (np.abs(real - start[keep]).max(-1) > MOTION_THRESHOLD)[..., None]
        psnr.append(_db(error.mean((1, 2, 3, 4))).mean())
        moving.append(float(_db((error * moved).sum() / max(1, 3 * moved.sum()))))
        if step + 1 == DELTA_PSNR_STEP:
            other = (decode(model, run.shuffled.tokens[keep, step], run.context[keep]) - real) ** 2
            delta.append((_db(error.mean((1, 2, 3, 4))) - _db(other.mean((1, 2, 3, 4)))).mean())
        if knows_tcp(run):
            imagined = run.imagined.proprioception[keep, step, :3].cpu().numpy()
            error_m = np.linalg.norm(imagined - run.table.state[run.rows(step + 1)[keep], :3], axis=-1)
            tcp.append(1000 * error_m.mean())
    return {
        "psnr_by_step": [round(float(value), 3) for value in psnr],
        "moving_psnr_by_step": [round(value, 3) for value in moving],
        "delta_psnr_15": float(delta[0]) if delta else None,
        "tcp_error_mm_by_step": [round(float(value), 2) for value in tcp],
    }


def knows_tcp(run: Replay) -> bool:
    """Whether the model predicts a state that begins with the TCP's position in metres."""
    names = run.table.dataset.features.get(OBS_STATE, {}).get("names") or []
    return bool(run.imagined.proprioception.shape[-1]) and list(names[:3]) == list(STATE_NAMES[:3])


def first_run(fired: np.ndarray, frames: int) -> np.ndarray:
    """Where the first run of `frames` consecutive True begins, −1 if there is none. (E, T) → (E,)"""
    count, begin = np.zeros(fired.shape[0], int), np.full(fired.shape[0], -1)
    for step, column in enumerate(fired.T):
        count = np.where(column, count + 1, 0)
        begin = np.where((begin < 0) & (count >= frames), step - frames + 1, begin)
    return begin


def success_agreement(run: Replay, threshold: float, frames: int) -> dict[str, Any]:
    """The gate: of real failures, the share that the model, replayed open loop, calls successes.

    An episode is called a success as the environment would: `frames` consecutive frames at `threshold`.
    """
    fired = (run.imagined.done_probability.cpu().numpy() >= threshold) & run.acted
    begin = first_run(fired, frames)
    called, real = begin >= 0, run.done.any(1)
    both = called & real
    delay = (begin - run.done.argmax(1))[both]
    counts = {
        "real_failures": ~real, "false_successes": called & ~real,
        "real_successes": real, "recognised_successes": both,
    }  # fmt: skip
    return {
        **{name: int(mask.sum()) for name, mask in counts.items()},
        "false_success_rate": Proportion(int((called & ~real).sum()), int((~real).sum())).as_json(),
        "recognised_rate": Proportion(int(both.sum()), int(real.sum())).as_json(),
        "done_delay_frames": float(delay.mean()) if len(delay) else None,
        "episodes": run.episodes.tolist(),
        "called_success": called.tolist(),
        "real_success": real.tolist(),
    }


@torch.no_grad()
def decode(model: ActionWorldModelRewardModel, tokens: Tensor, context: Context) -> np.ndarray:
    """Tokens (E, S) → frames (E, N, H, W, 3) float in [0, 1]."""
    return model.tokenizer.decode(tokens, context).permute(0, 1, 3, 4, 2).cpu().numpy()


def _db(mse: np.ndarray) -> np.ndarray:
    return -10 * np.log10(np.maximum(mse, 1e-10))

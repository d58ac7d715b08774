"""Reconstruction by a tokenizer: PSNR of recorded frames, camera by camera, and its use of the codes."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import trange

from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.statistics import evenly_spaced
from lerobot_wmrl.data.episodes import EpisodeTable, choose_episodes
from lerobot_wmrl.data.frame_cache import cached_frames, frames_to_tensor
from lerobot_wmrl.data.lazy_rows import LazyRows
from lerobot_wmrl.evaluation.image_metrics import motion_mask, psnr_from_mse
from lerobot_wmrl.world_models.codebook import CodeBook, make_codebook, perplexity
from lerobot_wmrl.world_models.frame_tokenizer import FrameTokenizer
from lerobot_wmrl.world_models.modeling_frame_tokenizer import FrameTokenizerRewardModel
from lerobot_wmrl.world_models.modeling_world_model import WorldModelRewardModel

RECONSTRUCTION_FILE = "reconstruction.json"
MAX_FRAMES = 2000
BATCH = 64

TokenizingModel = FrameTokenizerRewardModel | WorldModelRewardModel
"""A frame tokenizer, or a world model, which carries one."""


@dataclass
class Reconstruction:
    """Tokens and errors of R reconstructed frames.

    Args:
        tokens: (R, S).
        error: mean squared error of each camera (R, N).
        moving_error: squared error summed over the pixels that moved and their colours (R, N).
        moving_colors: the number of these (R, N).
    """

    tokens: Tensor
    error: Tensor
    moving_error: Tensor
    moving_colors: Tensor


def reconstruction_metrics(
    model: TokenizingModel, table: EpisodeTable, frames: LazyRows, episodes: np.ndarray
) -> dict[str, Any]:
    """Measure PSNR (dB) per camera, of whole frames and of the pixels that moved, and the use of the codes.

    At most `MAX_FRAMES` frames are measured, evenly spread over the episodes.

    Args:
        model: a frame tokenizer, or a world model, which carries one.
        table: the recorded episodes.
        frames: all frames of the table, uint8 (rows, N, H, W, 3).
        episodes: indices of the episodes to reconstruct.

    Returns:
        frames: their number; by camera psnr, the mean over frames, and moving_psnr, over all pixels that
        moved since the episode's start (None where nothing moved); codes and, one a factor, code_factors:
        size, share used and perplexity.
    """
    rows, starts = _rows(table, episodes)
    measured = reconstruct(model, frames, rows, starts)
    colors = measured.moving_colors.sum(0)
    whole = psnr_from_mse(measured.error).mean(0)
    moving = psnr_from_mse(measured.moving_error.sum(0) / colors)
    tokenizer_config = model.config.tokenizer
    cameras = list(enumerate(tokenizer_config.cameras))
    return {
        "frames": len(rows),
        "psnr": {camera: round(whole[i].item(), 3) for i, camera in cameras},
        "moving_psnr": {camera: round(moving[i].item(), 3) if colors[i] else None for i, camera in cameras},
        **code_use(make_codebook(tokenizer_config.quantizer, tokenizer_config.levels), measured.tokens),
    }


def reconstruct(
    model: TokenizingModel, frames: LazyRows, rows: np.ndarray, starts: np.ndarray
) -> Reconstruction:
    """Encode and decode the frames `rows` (R,) of episodes that began at the rows `starts` (R,)."""
    parts = []
    for start, recorded, tokens, decoded in reconstructions(model.tokenizer, frames, rows, starts):
        error = (decoded - recorded).square()
        moved = motion_mask(recorded, start)[:, :, None].expand_as(error)
        sums = (error * moved).sum((2, 3, 4)), moved.sum((2, 3, 4))
        parts.append((tokens, error.mean((2, 3, 4)), *sums))
    return Reconstruction(*(torch.cat(column).cpu() for column in zip(*parts, strict=True)))


@torch.no_grad()
def reconstructions(
    tokenizer: FrameTokenizer, frames: LazyRows, rows: np.ndarray, starts: np.ndarray
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Yield, in batches, the first frames of these rows' episodes, the recorded frames, their tokens and what
    is decoded from them; frames are (B, N, 3, H, W) in [0, 1].

    rows (R,); starts (R,): the first rows of their episodes.
    """
    frames.fill(rows)
    for begin in trange(0, len(rows), BATCH, desc="Reconstructing frames", unit="batch"):
        part = slice(begin, begin + BATCH)
        pair = starts[part], rows[part]
        start, recorded = (frames_to_tensor(frames[each]).to(tokenizer.device) for each in pair)
        context = tokenizer.context(start)
        tokens = tokenizer.encode(recorded, context)
        yield start, recorded, tokens, tokenizer.decode(tokens, context)


def code_use(codebook: CodeBook, tokens: Tensor) -> dict[str, Any]:
    """Return the share of the codes that occur in `tokens` (…), and the perplexity of their distribution.

    A large code book is not filled by a few thousand frames; its factors are more telling.
    """
    factors = codebook.codes(tokens.flatten()).unbind(-1)
    level_counts = codebook.level_counts
    return {
        "codes": _use(tokens.flatten(), int(np.prod(level_counts))),
        "code_factors": [_use(codes, size) for codes, size in zip(factors, level_counts, strict=True)],
    }


def write_reconstruction(
    model: TokenizingModel, table: EpisodeTable, output_dir: Path, chosen: Sequence[int] | None = None
) -> dict[str, Any]:
    """Write `reconstruction.json`, unless it exists, for held-out episodes, or all if none is held out.

    chosen: the episodes that were learnt from, all by default.

    Returns:
        What the file holds: split, and what `reconstruction_metrics` returns.
    """
    path = output_dir / RECONSTRUCTION_FILE
    if path.is_file():
        known: dict[str, Any] = json.loads(path.read_text())
        return known
    wanted = table.among(chosen)
    split = "validation" if (table.validation & wanted).any() else "all"
    episodes = choose_episodes(table, split, MAX_FRAMES, wanted=wanted)
    tokenizer_config = model.config.tokenizer
    frames = cached_frames(table.dataset, tokenizer_config.camera_keys, tokenizer_config.image_size)
    measured = {"split": split, **reconstruction_metrics(model.eval(), table, frames, episodes)}
    write_json(path, measured)
    return measured


def _rows(table: EpisodeTable, episodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of the episodes, evenly thinned, and for each the row where its episode begins."""
    lengths = table.length[episodes]
    starts = np.repeat(table.start[episodes], lengths)
    rows = table.row_numbers(episodes)
    kept = evenly_spaced(len(rows), MAX_FRAMES)
    return rows[kept], starts[kept]


def _use(indices: Tensor, size: int) -> dict[str, float]:
    return {"size": size, "used": len(indices.unique()) / size, "perplexity": round(perplexity(indices), 2)}

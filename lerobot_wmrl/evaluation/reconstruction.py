"""What a tokenizer loses: its reconstruction of real frames, camera by camera, and its use of the codes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import trange

from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.data.episode_table import EpisodeTable, choose_episodes
from lerobot_wmrl.data.frame_cache import cached_frames, frames_to_tensor
from lerobot_wmrl.evaluation.image_metrics import motion_mask, psnr_from_mse
from lerobot_wmrl.world_models.codebook import CodeBook, make_codebook

RECONSTRUCTION_FILE = "reconstruction.json"
MAX_FRAMES = 2000
BATCH = 64


@dataclass
class Reconstruction:
    """Of R frames: tokens (R, S), mean squared error (R, N), and of what moved the squared error summed over
    pixels and colours (R, N), beside how many these are (R, N)."""

    tokens: Tensor
    error: Tensor
    moving_error: Tensor
    moving_colors: Tensor


def reconstruction_metrics(
    model: Any, table: EpisodeTable, frames: np.ndarray, episodes: np.ndarray, max_frames: int = MAX_FRAMES
) -> dict[str, Any]:
    """PSNR (dB) per camera, of whole frames and of what moved since the episode's start; use of the codes.

    Args:
        model: a frame tokenizer or a world model, which carries one.
        frames: all frames of the table, uint8 (rows, N, H, W, 3).
        episodes: indices of the episodes to reconstruct.
        max_frames: at most so many frames, evenly spread over the episodes.

    Returns:
        frames; by camera psnr, the mean over frames, and moving_psnr, of all moved pixels (None where nothing
        moved); codes and, one a factor, code_factors: size, share used and perplexity.
    """
    rows, starts = _rows(table, episodes, max_frames)
    measured = reconstruct(model, frames, rows, starts)
    colors = measured.moving_colors.sum(0)
    whole, moving = (
        psnr_from_mse(measured.error).mean(0),
        psnr_from_mse(measured.moving_error.sum(0) / colors),
    )
    sizes = model.config.tokenizer
    cameras = list(enumerate(sizes.cameras))
    return {
        "frames": len(rows),
        "psnr": {camera: round(whole[i].item(), 3) for i, camera in cameras},
        "moving_psnr": {camera: round(moving[i].item(), 3) if colors[i] else None for i, camera in cameras},
        **code_use(make_codebook(sizes.quantizer, sizes.levels), measured.tokens),
    }


@torch.no_grad()
def reconstruct(model: Any, frames: np.ndarray, rows: np.ndarray, starts: np.ndarray) -> Reconstruction:
    """Encode and decode the frames `rows` (R,) of episodes that began at the rows `starts` (R,)."""
    device, parts = next(model.tokenizer.parameters()).device, []
    for begin in trange(0, len(rows), BATCH, desc="Reconstructing frames", unit="batch"):
        part = slice(begin, begin + BATCH)
        real, start = (frames_to_tensor(frames[index[part]]).to(device) for index in (rows, starts))
        context = model.tokenizer.context(start)
        tokens = model.tokenizer.encode(real, context)
        error = (model.tokenizer.decode(tokens, context) - real).square()
        moved = motion_mask(real, start)[:, :, None].expand_as(error)
        sums = (error * moved).sum((2, 3, 4)), moved.sum((2, 3, 4))
        parts.append((tokens, error.mean((2, 3, 4)), *sums))
    return Reconstruction(*(torch.cat(column).cpu() for column in zip(*parts, strict=True)))


def code_use(codebook: CodeBook, tokens: Tensor) -> dict[str, Any]:
    """Share of the codes that occur in `tokens` (…), and the perplexity of their distribution.

    A large code book is not filled by a few thousand frames: its factors say more.
    """
    factors = codebook.digits(tokens.flatten()).unbind(-1)
    sizes = codebook.level_counts
    return {
        "codes": _use(tokens.flatten(), int(np.prod(sizes))),
        "code_factors": [_use(digits, size) for digits, size in zip(factors, sizes, strict=True)],
    }


def write_reconstruction(model: Any, table: EpisodeTable, output_dir: Path) -> None:
    """Write `reconstruction.json` unless it is there: of held-out episodes, or of all if none is held out."""
    if (output_dir / RECONSTRUCTION_FILE).is_file():
        return
    split = "validation" if table.validation.any() else "all"
    episodes = choose_episodes(table, split, MAX_FRAMES)
    frames = cached_frames(table.dataset, model.config.tokenizer.camera_keys)
    measured = {"split": split, **reconstruction_metrics(model.eval(), table, frames, episodes)}
    write_json(output_dir / RECONSTRUCTION_FILE, measured)


def _rows(table: EpisodeTable, episodes: np.ndarray, at_most: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the episodes, evenly thinned, and for each the row where its episode begins."""
    lengths = table.length[episodes]
    starts = np.repeat(table.start[episodes], lengths)
    rows = np.concatenate([table.start[episode] + np.arange(table.length[episode]) for episode in episodes])
    kept = np.linspace(0, len(rows) - 1, min(len(rows), at_most)).astype(int)
    return rows[kept], starts[kept]


def _use(indices: Tensor, size: int) -> dict[str, float]:
    counts = indices.unique(return_counts=True)[1].double()
    entropy = torch.special.entr(counts / counts.sum()).sum()
    return {"size": size, "used": len(counts) / size, "perplexity": round(entropy.exp().item(), 2)}

"""How the digits of the next frame come about: drawn in one pass, or in several that look at each other."""

from typing import Any, Final

from lerobot_wmrl.world_models.decoding.maskgit import MaskGitDecoding
from lerobot_wmrl.world_models.decoding.shifted import Condition, FramesSeen, ShiftedDecoding

__all__ = ["DECODINGS", "Condition", "FramesSeen", "MaskGitDecoding", "ShiftedDecoding", "make_decoding"]

DECODINGS: Final[dict[str, type[ShiftedDecoding]]] = {"shifted": ShiftedDecoding, "maskgit": MaskGitDecoding}


def make_decoding(config: Any, channels: int) -> ShiftedDecoding:
    """What `--model.decoding` names, for tokens of so many values. ValueError for anything else."""
    if config.decoding not in DECODINGS:
        raise ValueError(f"--model.decoding={config.decoding}: choose one of {', '.join(DECODINGS)}")
    return DECODINGS[config.decoding](config, channels)

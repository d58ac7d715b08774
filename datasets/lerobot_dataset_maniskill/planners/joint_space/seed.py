"""mplib offers no seed before 0.2. The planning library that it brings along does."""

import ctypes
from pathlib import Path
from typing import Final

import mplib

SET_SEED: Final = "_ZN4ompl3RNG7setSeedEm"
"""`ompl::RNG::setSeed(unsigned long)`, as compilers on Linux write it."""


def seed_ompl(seed: int) -> None:
    """Make the next plan a function of its problem and of `seed` (at least 1)."""
    (library,) = (Path(mplib.__file__).parents[1] / "mplib.libs").glob("libompl-*.so*")
    set_seed = ctypes.CDLL(str(library))[SET_SEED]
    set_seed.argtypes, set_seed.restype = (ctypes.c_ulong,), None
    set_seed(seed)

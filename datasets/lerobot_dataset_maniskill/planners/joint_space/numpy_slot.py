"""mplib 0.1.1 was built for numpy 1: under numpy 2 it misses a function of numpy's C interface."""

import ctypes
from typing import Final

import numpy as np

COPY_INTO: Final = 50
"""Where numpy 2 keeps `PyArray_CopyInto` in the table of its C interface."""

COPY_INTO_OF_NUMPY_1: Final = 82
"""Where mplib looks for it. numpy 2 leaves this slot empty."""


def restore_copy_into() -> None:
    """Let mplib find `PyArray_CopyInto` under numpy 2, where its first planner would crash the process.

    Needed before mplib is imported. Fills one empty slot; does nothing under numpy 1, or if it is full.
    """
    if np.lib.NumpyVersion(np.__version__) < "2.0.0":
        return
    from numpy._core._multiarray_umath import _ARRAY_API  # type: ignore[import-not-found]

    prototype = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)
    address_of = prototype(("PyCapsule_GetPointer", ctypes.pythonapi))
    table = ctypes.cast(address_of(_ARRAY_API, None), ctypes.POINTER(ctypes.c_void_p))
    if not table[COPY_INTO_OF_NUMPY_1]:
        table[COPY_INTO_OF_NUMPY_1] = table[COPY_INTO]

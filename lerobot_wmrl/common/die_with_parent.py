"""Become a program that is killed with the process that started this one: `die_with_parent.py PID PROGRAM …`.

A file of its own, without any other module of this package: it is run before the program, in its process, for
a `preexec_fn` would run between fork and exec, where a process with threads can wait for ever for a lock that
one of them held.
"""

import ctypes
import os
import signal
import sys

SET_PARENT_DEATH_SIGNAL = 1
"""Of prctl(2)."""


def die_with(parent: int) -> None:
    """Be killed when `parent`, which started this process, is: else the next call meets two writers (Linux).

    The signal outlives exec. The parent may have died before it was asked for.
    """
    ctypes.CDLL(None).prctl(SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


if __name__ == "__main__":
    die_with(int(sys.argv[1]))
    os.execv(sys.argv[2], sys.argv[2:])

"""Progress bars in processes that may be killed."""

import threading

from tqdm import tqdm


def own_progress_lock() -> None:
    """Stop sharing tqdm's lock with the process this one was forked from; call it first in a fork.

    The lock is a semaphore that forks share and that no one releases when its holder is killed: one of about
    200 kills of a recording process left every other process waiting for it.
    """
    tqdm.set_lock(threading.RLock())

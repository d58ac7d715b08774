"""Processes that simulate beside each other."""

import multiprocessing
import os
import threading
from multiprocessing.context import ForkServerContext


def simulating_context() -> ForkServerContext:
    """Forked from a server that has imported the simulator once (8 s) and holds no renderer.

    Forking the command itself hangs once it has asked for a renderer; spawning imports everything again.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["lerobot_wmrl.maniskill.simulation"])
    return context


def leave_with_command() -> None:
    """In such a process: end as soon as the command that started it has ended, however it did.

    One that lived on would write into a folder that the next command continues.
    """
    command = multiprocessing.parent_process()
    assert command is not None, "only for processes that multiprocessing started"

    def follow() -> None:
        command.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()

"""Processes that simulate beside each other."""

import multiprocessing
from multiprocessing.context import ForkServerContext


def simulating_context() -> ForkServerContext:
    """Forked from a server that has imported the simulator once (8 s) and holds no renderer.

    Forking the command itself hangs once it has asked for a renderer; spawning imports everything again.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["lerobot_wmrl.maniskill.simulation"])
    return context

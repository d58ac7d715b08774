"""The simulator as a backend: whether it is installed, whether it can render, and processes that run it.

Importing this module imports no simulator.
"""

import importlib.util
import multiprocessing
import os
import threading
from multiprocessing.context import ForkServerContext
from typing import Final

SIMULATOR_PACKAGES: Final = ("mani_skill", "sapien", "trimesh", "fast_simplification")

RASTERISER_THREADS: Final = "1"
"""Threads of Mesa's software renderer in each process. Small pictures leave little to share out, and the
threads of several processes hold each other up: on two cores, two processes record 1.6 times faster with
one."""

NO_RENDERER: Final = (
    "SAPIEN finds no device to render with. It needs a GPU with Vulkan, or Mesa's software driver (24+): "
    "install the package mesa-vulkan-drivers (on Debian 12 from bookworm-backports) together with "
    "libvulkan1; in a checkout of lerobot_wmrl, `make setup` does it where it may"
)


class NoSimulatorError(ValueError):
    """ManiSkill or one of the packages it is used with is not installed."""


class NoRendererError(ValueError):
    """There is no Vulkan device that SAPIEN accepts."""


def require_simulator() -> None:
    """Raise NoSimulatorError, with the remedy, unless the simulator's packages are installed."""
    missing = [name for name in SIMULATOR_PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise NoSimulatorError(
            f"ManiSkill is needed here, and {', '.join(missing)} cannot be imported; install the extra: "
            "pip install '.[maniskill]' in the clone of lerobot_wmrl"
        )


def render_backend() -> str:
    """Return "gpu" if SAPIEN can render on one, else "cpu" (in software).

    Raises:
        NoSimulatorError: if SAPIEN is not installed.
        NoRendererError: if SAPIEN can render on neither; it says what to install.
    """
    require_simulator()
    os.environ.setdefault("LP_NUM_THREADS", RASTERISER_THREADS)
    import sapien

    try:
        if sapien.Device("cuda").can_render():
            return "gpu"
    except RuntimeError:
        pass  # no CUDA device
    try:
        summary = sapien.render.get_device_summary()
    except RuntimeError as error:
        raise NoRendererError(f"{NO_RENDERER} ({error})") from error
    if "Supported: 1" not in summary:
        raise NoRendererError(f"{NO_RENDERER}. It sees: {' '.join(summary.split()) or 'nothing'}")
    return "cpu"


def simulating_context() -> ForkServerContext:
    """Return the multiprocessing context for processes that run the simulator.

    They are forked from a server that has imported the simulator once (8 s) and holds no renderer. Forking
    the command itself hangs once it has asked for a renderer; spawning would import everything again.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["lerobot_wmrl.maniskill.simulation"])
    return context


def leave_with_command() -> None:
    """End this process as soon as the command that started it has ended, however it ended.

    A worker that lived on would write into a folder that the next command continues.
    """
    command = multiprocessing.parent_process()
    assert command is not None, "only for processes that multiprocessing started"

    def follow() -> None:
        command.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()

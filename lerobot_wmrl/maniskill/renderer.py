"""Whether SAPIEN can render here, asked of SAPIEN itself, with the remedy if it cannot."""

import os

RASTERISER_THREADS = "1"
"""Of Mesa's software renderer, in each process. Small pictures leave little to share out, and the threads of
several recording processes hold each other up: two of them on two cores record 1.6 times faster with one."""

REMEDY = (
    "SAPIEN finds no device to render with. It needs a GPU with Vulkan, or Mesa's software driver (24+): "
    "run `make setup`, which installs one where it may, or install the package mesa-vulkan-drivers "
    "(on Debian 12 from bookworm-backports) together with libvulkan1"
)


class NoRendererError(ValueError):
    """There is no Vulkan device that SAPIEN accepts."""


def render_backend() -> str:
    """`gpu` if SAPIEN can render on one, else `cpu` (software). NoRendererError with the remedy."""
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
        raise NoRendererError(f"{REMEDY} ({error})") from error
    if "Supported: 1" not in summary:
        raise NoRendererError(f"{REMEDY}. It sees: {' '.join(summary.split()) or 'nothing'}")
    return "cpu"

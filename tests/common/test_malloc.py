import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROBE = """
import ctypes, os, platform, sys, types

package = types.ModuleType("lerobot_wmrl")  # without LeRobot, whose import takes seconds
package.__path__ = ["lerobot_wmrl"]
sys.modules["lerobot_wmrl"] = package
from lerobot_wmrl.common.precision import MALLOC_SETTINGS, keep_freed_memory

keep_freed_memory()
if platform.libc_ver()[0] == "glibc":
    libc = ctypes.CDLL(None)
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    libc.free.argtypes = [ctypes.c_void_p]
    resident = lambda: int(open("/proc/self/statm").read().split()[1]) * 4096
    block = libc.malloc(64 << 20)
    ctypes.memset(block, 1, 64 << 20)
    held = resident()
    libc.free(block)
    print(held - resident() < 1 << 20, os.environ["MALLOC_TOP_PAD_"])
else:
    print(True, os.environ.get("MALLOC_TOP_PAD_"))
"""


def test_freed_memory_stays_with_the_process_and_the_environment_wins() -> None:
    unset = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    command = [sys.executable, "-c", PROBE]
    result = subprocess.run(
        command, cwd=ROOT, env={**unset, "MALLOC_TOP_PAD_": "0"}, capture_output=True, text=True
    )
    assert result.stdout.split() == ["True", "0"], result.stderr

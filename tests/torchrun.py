"""Scripts run by several processes at once, as users start them."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PATIENCE_S = 700
"""Less than pytest's own limit, which would end the run."""


def torchrun(script: Path, *arguments: str) -> None:
    """Two processes, which meet on this machine's loopback, whatever its name resolves to."""
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--local-addr=127.0.0.1",
        "--nproc_per_node=2",
        str(script),
        *arguments,
    ]
    folders = [str(ROOT / folder) for folder in ("", "policies", "datasets", "robots")]
    paths = os.pathsep.join([*folders, os.environ.get("PYTHONPATH", "")])
    own = {"PYTHONPATH": paths, "GLOO_SOCKET_IFNAME": "lo"}
    result = subprocess.run(
        command,
        env={**os.environ, **own},
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=PATIENCE_S,
    )
    assert result.returncode == 0, result.stderr[-3000:]

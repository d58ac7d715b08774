"""ManiSkill's shaders for sensors, without a table that SAPIEN computes in every process.

The table, integrals of the BRDF, weighs the light of an environment map. Our scenes have none, so that the
pictures are the same without it. In software it takes ten seconds.
"""

import hashlib
import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Final

import sapien
from lerobot.utils.constants import HF_LEROBOT_HOME
from mani_skill.render import PREBUILT_SHADER_CONFIGS, ShaderConfig, set_shader_pack

PACK: Final = "minimal"
"""ManiSkill's name of the shaders for sensors."""

FOLDERS: Final = (PACK, "common")
"""Of SAPIEN's shaders, those that they are read from."""

DECLARATION: Final = re.compile(r"^layout\(.*\) uniform sampler2D samplerBRDFLUT;$", re.MULTILINE)
LOOK_UP: Final = re.compile(r"texture\(samplerBRDFLUT, [^;]*\)\.xy")


def sensor_shaders() -> ShaderConfig:
    """Return the shaders, for the cameras of an environment, and set the format of their pictures.

    ManiSkill sets the format for packs that it knows by name alone.
    """
    original = PREBUILT_SHADER_CONFIGS[PACK]
    set_shader_pack(original)
    folder = rewritten(Path(sapien.__file__).parent / "vulkan_shader")
    return original if folder is None else replace(original, shader_pack=str(folder / PACK))


@cache
def rewritten(source: Path) -> Path | None:
    """Return a folder, within LeRobot's, with the shaders of `source` without the table.

    None where they are other ones, or the folder cannot be written or is not whole: SAPIEN's are taken then.
    """
    try:
        texts = {
            str(path.relative_to(source)): path.read_text()
            for folder in FOLDERS
            for path in sorted((source / folder).iterdir())
        }
        changed = {name: without_table(text) for name, text in texts.items()}
        if changed == texts or any("samplerBRDFLUT" in text for text in changed.values()):
            return None
        digest = hashlib.sha256("".join(f"{name}{text}" for name, text in changed.items()).encode())
        folder = HF_LEROBOT_HOME / "shaders" / digest.hexdigest()[:12]
        write_once(folder, changed)
        whole = all((folder / name).read_text() == text for name, text in changed.items())
    except (OSError, UnicodeDecodeError):
        return None
    return folder if whole else None


def without_table(text: str) -> str:
    """Return a shader that takes 0 for what it would read from the table."""
    return LOOK_UP.sub("vec2(0)", DECLARATION.sub("", text))


def write_once(folder: Path, texts: Mapping[str, str]) -> None:
    """Write files into a folder unless it exists; it appears when it is whole, whoever is first."""
    if folder.exists():
        return
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=folder.parent, prefix="."))
    try:
        for name, text in texts.items():
            (partial / name).parent.mkdir(exist_ok=True)
            (partial / name).write_text(text)
        partial.chmod(0o755)  # other users may share the folder
        partial.rename(folder)
    except OSError:
        if not folder.exists():  # else another process was faster
            raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)

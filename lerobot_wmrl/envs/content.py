"""Digests of what a command names: the same name may come to mean another model or dataset."""

from collections.abc import Callable
from pathlib import Path

from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.common.checkpoints import checkpoint_digest, file_digest
from lerobot_wmrl.common.errors import FieldError, first_line
from lerobot_wmrl.data.dataset import fingerprint
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv


def content_of(env: EnvConfig | None) -> dict[str, str]:
    """Return digests of what imagined episodes follow from, beside the policy, by the settings that name it;
    nothing for other environments."""
    if not isinstance(env, WorldModelEnv):
        return {}
    models = {
        "world_model_path": env.world_model_path,
        "text_world_model_path": env.text_world_model_path,
        "reward.pretrained_path": getattr(env.reward, "pretrained_path", None),
    }
    content = {name: digest_of_setting(name, path, model_digest) for name, path in models.items() if path}
    if env.dataset.given:
        content["dataset"] = fingerprint(Path(env.dataset.open().root))
    if env.dataset.frames:
        content["dataset.frames"] = digest_of_setting("dataset.frames", env.dataset.frames, file_digest)
    return content


def model_digest(path: Path) -> str:
    """Return the digest of a world model or a reward, which is whole by itself."""
    return checkpoint_digest(path, parts=False)


def digest_of_setting(name: str, path: str | Path, digest: Callable[[Path], str]) -> str:
    """Return the digest of what a setting names. FieldError if it cannot be read."""
    try:
        return digest(Path(path))
    except (OSError, ValueError) as error:  # the hub's client raises both
        raise FieldError(
            name,
            path,
            f"nothing can be read there ({first_line(error)})",
            "give the output folder of its training, a file that is there, or a hub id",
        ) from error

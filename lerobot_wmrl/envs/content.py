"""Digests of what a command names: the same name may come to mean another model or dataset."""

from pathlib import Path

from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.common.checkpoints import checkpoint_digest, file_digest
from lerobot_wmrl.data.dataset import fingerprint
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv


def content_of(env: EnvConfig | None) -> dict[str, str]:
    """Return digests of what imagined episodes follow from, beside the policy, by the settings that name it;
    nothing for other environments."""
    if not isinstance(env, WorldModelEnv):
        return {}
    models = {
        "world_model_path": env.world_model_path, "text_world_model_path": env.text_world_model_path,
        "reward.pretrained_path": getattr(env.reward, "pretrained_path", None),
    }  # fmt: skip
    content = {name: checkpoint_digest(path) for name, path in models.items() if path}
    if env.dataset.given:
        content["dataset"] = fingerprint(Path(env.dataset.open().root))
    if env.dataset.frames:
        content["dataset.frames"] = file_digest(Path(env.dataset.frames))
    return content

"""What a training made: how good it is, how to evaluate it, and its place on the hub."""

import shlex
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from lerobot.utils.constants import PRETRAINED_MODEL_DIR

from lerobot_wmrl.common.checkpoints import best_model, last_model
from lerobot_wmrl.common.errors import within
from lerobot_wmrl.common.flags import env_flags, format_lerobot_flags
from lerobot_wmrl.common.hub import create_repo, published_name, publishing
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.rl.callbacks import read_record
from lerobot_wmrl.rl.configuration_train import TrainConfig
from lerobot_wmrl.rl.selection import Selection, success
from lerobot_wmrl.world_models.hub_card import card_metadata

PATHS: Final = ("path", "root", "frames", "assets")
"""Ends of the names of settings that may be folders or files of this machine."""

LOCAL_FOLDER: Final = "FOLDER"
"""On a card, what stands for a folder of the machine on which the policy was trained."""

CARD: Final = """---
{metadata}
---

# {name}

A `{type}` policy of LeRobot, trained further by reinforcement learning with lerobot-wmrl-train:

{description}

It began as {start}. `train_config.json` has all settings. Evaluate it (FOLDER: what is not published):

```
{command}
```
"""


def chosen_checkpoint(cfg: TrainConfig) -> Path:
    """Return the best checkpoint, or the last one of a training without selection."""
    model = best_model if cfg.selection.freq else last_model
    return model(cfg.output_dir).parent


def summary(cfg: TrainConfig) -> list[str]:
    """Return lines that say what was made, how good it is, and how to evaluate it."""
    iterations = [line for line in read_metrics(cfg.output_dir) if "success_rate" in line]
    first, last, checkpoint = iterations[0], iterations[-1], chosen_checkpoint(cfg)
    policy, env, algorithm = cfg.policy.type, cfg.env.type, cfg.algorithm.type.upper()  # type: ignore[union-attr]
    acted = (
        f"the planner's success in {env}"
        if cfg.algorithm.imitates_planner
        else f"success in {env} with exploration"
    )
    lines = [
        f"{cfg.output_dir}: {policy} policy after {last['step']} iterations of {algorithm}, "
        f"{last['env_steps']:,} steps in {env}",
        f"{acted}: {first['success_rate']:.0%} in iteration {first['step']}, "
        f"{last['success_rate']:.0%} in iteration {last['step']}",
    ]
    if cfg.selection.freq:
        best = int(checkpoint.resolve().name)
        record = read_record(cfg.output_dir, Selection.name, best, cfg.iterations)
        measured = [place for place in ("real", "imagined") if place in record]
        rates = ", ".join(f"{place} success {success(record, place)}" for place in measured)
        lines.append(f"best checkpoint: iteration {best}, {rates}")
    return [*lines, f"next: {evaluation(cfg, str(checkpoint / PRETRAINED_MODEL_DIR))}"]


def evaluation(cfg: TrainConfig, path: str, shared: bool = False) -> str:
    """Return the command that evaluates the policy at `path`, a folder or a name on the hub.

    `shared`: for others, who do not have this machine's folders.
    """
    evaluated: Any = cfg.real_env or cfg.env
    settings = dict(env_flags(evaluated))
    for name in settings if shared else ():
        place = Path(str(settings[name]))
        if name.endswith(PATHS) and (place.is_absolute() or place.exists()):
            settings[name] = LOCAL_FOLDER
    flags = {"policy.path": path, **settings, "eval.n_episodes": 100, "seed": EVALUATION_SEED}
    return shlex.join(["lerobot-eval", *format_lerobot_flags(flags)])


def publish(cfg: TrainConfig, lines: list[str]) -> None:
    """Upload the chosen checkpoint with a model card if `policy.push_to_hub`. `lines` describe it."""
    config: Any = cfg.policy
    if not config.push_to_hub:
        return
    from huggingface_hub import HfApi

    api = HfApi()
    described = [lines[0].removeprefix(f"{cfg.output_dir}: "), *lines[1:-1]]
    description, start = "\n".join(f"- {line}" for line in described), published_name(config.pretrained_path)
    kept = f"the policy is whole in {cfg.output_dir}, the same command again only publishes it"
    with within("policy"), publishing(config.repo_id, kept), TemporaryDirectory() as temporary:
        name = create_repo(api, config.repo_id, config.private)
        card = CARD.format(
            metadata=card_metadata(config, model_name=name).to_yaml(),
            name=name,
            type=config.type,
            description=description,
            start=f"`{'@'.join(filter(None, start))}`" if start else "a policy that is not published",
            command=evaluation(cfg, name, shared=True),
        )
        folder = Path(temporary) / "policy"
        shutil.copytree(chosen_checkpoint(cfg) / PRETRAINED_MODEL_DIR, folder)
        (folder / "README.md").write_text(card)
        api.upload_folder(
            repo_id=name, folder_path=folder, commit_message="Policy trained by reinforcement learning"
        )
    print(f"{cfg.output_dir}: published as {name}")

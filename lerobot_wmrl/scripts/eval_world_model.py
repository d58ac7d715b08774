"""lerobot-wmrl-eval-world-model: replay real episodes in a world model and measure how far it can be trusted.

    lerobot-wmrl-eval-world-model --model.path=outputs/action_world_model --dataset.root=D \\
        --output_dir=outputs/check

Each episode is imagined from its first frame with its own actions. `metrics.json` gets the accuracy by
step and the false-success rate: of the episodes that failed in reality, how many the model believes in.
Add `--text_model.path=…` for goal frames and the reward along a successful and a failed episode.
"""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import draccus

from lerobot_wmrl.command import RunConfig, claim_output_dir, run_command
from lerobot_wmrl.dataset_source import DatasetSource
from lerobot_wmrl.presets import expand_preset
from lerobot_wmrl.rewards.configuration_general import GeneralConfig

if TYPE_CHECKING:
    from lerobot_wmrl.world_models.evaluation import Replay
    from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel


@dataclass
class Checkpoint:
    """A trained model: the output folder of its training, or one of its checkpoints."""

    path: str = ""


@dataclass
class EvalWorldModelConfig(RunConfig):
    """Replay real episodes in a world model.

    `--preset=tiny` or `--preset=demo` stands for the flags of that size; flags further right override it.

    Args:
        model: `--model.path=…`, an action world model.
        text_model: `--text_model.path=…`, for goal frames and reward curves.
        dataset: real episodes.
        split: `all`, or `train` / `validation` of the dataset the model was trained on.
        max_episodes: at most so many, evenly spread.
        done_threshold, done_frames: when an imagined episode counts as a success; as in the environment.
        reward: the general reward of the curves (--reward.alpha …); as in the environment.
        device: where the models run; the best there is by default.
        output_dir: where metrics.json and the pictures go.
    """

    model: Checkpoint = field(default_factory=Checkpoint)
    text_model: Checkpoint = field(default_factory=Checkpoint)
    dataset: DatasetSource = field(default_factory=DatasetSource)
    split: str = "all"
    max_episodes: int = 200
    done_threshold: float = 0.5
    done_frames: int = 3
    reward: GeneralConfig = field(default_factory=GeneralConfig)
    device: str | None = None
    output_dir: Path = Path("outputs/eval_world_model")


def check_config(cfg: EvalWorldModelConfig) -> None:
    """ValueError names the setting that cannot be."""
    for name in ("max_episodes", "done_frames"):
        if getattr(cfg, name) < 1:
            raise ValueError(f"--{name}={getattr(cfg, name)}: must be at least 1")
    if not 0 < cfg.done_threshold < 1:
        raise ValueError(f"--done_threshold={cfg.done_threshold}: must be a probability between 0 and 1")


def eval_world_model(cfg: EvalWorldModelConfig) -> None:
    """Replay, measure, draw."""
    from lerobot_wmrl.files import write_json
    from lerobot_wmrl.world_models.checkpoint import load_model
    from lerobot_wmrl.world_models.compatibility import check_dataset
    from lerobot_wmrl.world_models.episode_table import choose_episodes, open_dataset, read_episodes
    from lerobot_wmrl.world_models.evaluation import accuracy_by_step, replay, success_agreement
    from lerobot_wmrl.world_models.frame_cache import cached_frames
    from lerobot_wmrl.world_models.reconstruction import reconstruction_metrics

    check_config(cfg)
    model = load_model(cfg.model.path, "action_world_model", cfg.device)
    table = read_episodes(open_dataset(cfg.dataset.root, cfg.dataset.repo_id))
    check_dataset(model.config, table.dataset.features)
    episodes = choose_episodes(table, cfg.split, cfg.max_episodes)
    claim_output_dir(cfg.output_dir, draccus.encode(cfg))
    frames = cached_frames(table.dataset, model.config.camera_keys)
    run = replay(model, table, frames, episodes)
    agreement = success_agreement(run, cfg.done_threshold, cfg.done_frames)
    accuracy = accuracy_by_step(model, run)
    draw(cfg, model, run, accuracy)
    tokenizer = reconstruction_metrics(model, table, frames, episodes)
    write_json(
        cfg.output_dir / "metrics.json",
        {**agreement, **accuracy, "tokenizer": tokenizer, "dataset": cfg.dataset.root},
    )
    print(
        f"{len(episodes)} real episodes replayed: {agreement['false_successes']} of "
        f"{agreement['real_failures']} failures were called successes, "
        f"{agreement['recognised_successes']} of {agreement['real_successes']} successes were recognised. "
        f"Written to {cfg.output_dir}"
    )


def draw(
    cfg: EvalWorldModelConfig, model: "ActionWorldModelRewardModel", run: "Replay", accuracy: dict[str, Any]
) -> None:
    """Side-by-side animations and strips, accuracy, and with a text model goals and reward curves."""
    from lerobot_wmrl.world_models import pictures

    pictures.save_accuracy(accuracy, cfg.output_dir / "accuracy.png")
    shown = run.one_of_each()
    for name, index in shown.items():
        frames = pictures.side_by_side(model, run, index)
        pictures.save_animation(frames, cfg.output_dir / f"comparison_{name}.gif")
        pictures.save_strip(frames, cfg.output_dir / f"comparison_{name}_strip.png")
    if cfg.text_model.path:
        curves = reward_curves(cfg, model, run, shown)
        pictures.save_goals(curves, cfg.output_dir / "goal_frames.png")
        pictures.save_reward_curves(curves, cfg.output_dir / "reward_along_episodes.png")


def reward_curves(
    cfg: EvalWorldModelConfig, model: "ActionWorldModelRewardModel", run: "Replay", shown: dict[str, int]
) -> dict[str, dict[str, Any]]:
    """Per shown episode: done probability, similarity and the return so far."""
    from lerobot_wmrl.rewards.curves import reward_along_episode
    from lerobot_wmrl.world_models.checkpoint import load_model

    text_model = load_model(cfg.text_model.path, "text_world_model", cfg.device)
    return {
        name: reward_along_episode(
            model, text_model, cfg.reward, run.table, run.frames, int(run.episodes[index]),
            threshold=cfg.done_threshold, frames=cfg.done_frames,
        )
        for name, index in shown.items()
    }  # fmt: skip


def main() -> None:
    """Entry point of the console command."""
    run_command(eval_world_model, EvalWorldModelConfig, partial(expand_preset, command="eval-world-model"))


if __name__ == "__main__":
    main()

"""lerobot-wmrl-eval-world-model: replay real episodes in a world model and measure how far it can be trusted.

    lerobot-wmrl-eval-world-model --model.path=outputs/action_world_model --dataset.root=D \\
        --output_dir=outputs/check

Each episode is imagined from its first frame with its own actions. `metrics.json` and `metrics.md` get the
accuracy by step and the gate: of the episodes that failed in reality, how many the model believes in.
Add `--text_model.path=…` for goal frames and the reward along a successful and a failed episode, and
`--policies=[outputs/rl] --real_env.type=wmrl_maniskill …` to see whether policies succeed as in reality.
docs/world_models.md explains every number.
"""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import draccus
from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.common.command_line import RunConfig, claim_output_dir, run_command
from lerobot_wmrl.common.constants import EVALUATION_SEED
from lerobot_wmrl.common.presets import expand_preset
from lerobot_wmrl.data.dataset_source import DatasetSource
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig

if TYPE_CHECKING:
    from lerobot_wmrl.evaluation.agreement import Agreement
    from lerobot_wmrl.evaluation.evaluate import Evaluation
    from lerobot_wmrl.evaluation.replay import Source
    from lerobot_wmrl.evaluation.report import Report
    from lerobot_wmrl.world_models.modeling_world_model import (
        ActionWorldModelRewardModel,
        TextWorldModelRewardModel,
    )


IMAGINED_AT_ONCE, REAL_AT_ONCE = 50, 2
"""Episodes of a policy that run at once."""


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
        split: `all`; `train` or `validation` of the dataset the model was trained on; `ind` or `ood`, scenes
            that training may see and those held out. Joined by a comma, `validation,ind`: what is in both.
        max_episodes: at most so many, evenly spread.
        done_threshold, done_frames: when an imagined episode counts as a success; as in the environment.
        reward: the general reward of the curves (--reward.alpha …); as in the environment.
        policies: checkpoints, or output folders of trainings, of which every checkpoint counts: their success
            in the world model, from the dataset's start frames, beside that in `real_env`, in episodes of
            the same length.
        policy_episodes: of each of them, in either place.
        real_env: `--real_env.type=wmrl_maniskill` and its settings.
        device: where the models run; the best there is by default.
        output_dir: where metrics.json, metrics.md and the pictures go.
    """

    model: Checkpoint = field(default_factory=Checkpoint)
    text_model: Checkpoint = field(default_factory=Checkpoint)
    dataset: DatasetSource = field(default_factory=DatasetSource)
    split: str = "all"
    max_episodes: int = 200
    done_threshold: float = 0.5
    done_frames: int = 3
    reward: GeneralConfig = field(default_factory=GeneralConfig)
    policies: list[str] = field(default_factory=list)
    policy_episodes: int = 50
    real_env: EnvConfig | None = None
    device: str | None = None
    output_dir: Path = Path("outputs/eval_world_model")


def check_config(cfg: EvalWorldModelConfig) -> None:
    """ValueError names the setting that cannot be."""
    for name in ("max_episodes", "done_frames", "policy_episodes"):
        if getattr(cfg, name) < 1:
            raise ValueError(f"--{name}={getattr(cfg, name)}: must be at least 1")
    if not 0 < cfg.done_threshold < 1:
        raise ValueError(f"--done_threshold={cfg.done_threshold}: must be a probability between 0 and 1")
    if cfg.policies and cfg.real_env is None:
        raise ValueError(
            "--real_env.type is missing: success in the world model is compared with success in an "
            "environment; give --real_env.type=wmrl_maniskill and its settings, or leave out --policies"
        )


def eval_world_model(cfg: EvalWorldModelConfig) -> None:
    """Replay, measure, write."""
    from lerobot_wmrl.common.files import write_json, write_text
    from lerobot_wmrl.data.compatibility import check_dataset
    from lerobot_wmrl.data.episode_table import choose_episodes, open_dataset, read_episodes
    from lerobot_wmrl.data.frame_cache import cached_frames
    from lerobot_wmrl.evaluation.evaluate import evaluate
    from lerobot_wmrl.evaluation.reconstruction import reconstruction_metrics
    from lerobot_wmrl.evaluation.replay import Source
    from lerobot_wmrl.evaluation.report import report_action_model
    from lerobot_wmrl.maniskill.scenes import scenes_of
    from lerobot_wmrl.world_models.checkpoint import load_model

    check_config(cfg)
    model = load_model(cfg.model.path, "action_world_model", cfg.device)
    table = read_episodes(open_dataset(cfg.dataset.root, cfg.dataset.repo_id))
    check_dataset(model.config, table.dataset.features)
    text_model = load_text_model(cfg, model)
    unseen = {scene.index for scene in scenes_of("ood")}
    episodes = choose_episodes(table, cfg.split, cfg.max_episodes, unseen)
    claim_output_dir(cfg.output_dir, draccus.encode(cfg))
    source = Source(table, cached_frames(table.dataset, model.config.tokenizer.camera_keys))
    evaluation = evaluate(model, source, episodes)
    numbers, page = report_action_model(
        model, source, evaluation, cfg.done_threshold, cfg.done_frames, cfg.output_dir
    )
    if text_model is not None:
        goals, goal_page = report_text_model(cfg, model, text_model, source, evaluation)
        numbers, page = numbers | goals, f"{page}\n\n{goal_page}"
    if cfg.policies:
        agreement = policy_agreement(cfg)
        agreement.draw(cfg.output_dir / "policies.png")
        numbers["policies"], page = agreement.as_json(), f"{page}\n\n{agreement.table()}"
    numbers["tokenizer"] = reconstruction_metrics(model, table, source.frames, episodes)
    write_json(cfg.output_dir / "metrics.json", {**numbers, "dataset": cfg.dataset.root, "split": cfg.split})
    write_text(cfg.output_dir / "metrics.md", f"{page}\n")
    print(f"{page}\n\n{len(episodes)} real episodes replayed. Written to {cfg.output_dir}")


def load_text_model(
    cfg: EvalWorldModelConfig, model: "ActionWorldModelRewardModel"
) -> "TextWorldModelRewardModel | None":
    """The one that is named. ValueError if it speaks of frames in other tokens."""
    from lerobot_wmrl.data.compatibility import check_same_tokenizer
    from lerobot_wmrl.world_models.checkpoint import load_model

    if not cfg.text_model.path:
        return None
    text_model: TextWorldModelRewardModel = load_model(cfg.text_model.path, "text_world_model", cfg.device)
    check_same_tokenizer(model, text_model, f"--text_model.path={cfg.text_model.path}")
    return text_model


def policy_agreement(cfg: EvalWorldModelConfig) -> "Agreement":
    """Every policy's success in the world model and in `real_env`."""
    from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
    from lerobot_wmrl.evaluation.agreement import Agreement
    from lerobot_wmrl.evaluation.policy_success import policy_checkpoints, policy_outcomes

    real: Any = cfg.real_env
    longest = getattr(real, "horizon", None) or getattr(real, "episode_length", None)
    imagination = WorldModelEnv(
        world_model_path=cfg.model.path, reward=GeneralConfig(alpha=1.0), device=cfg.device,
        episode_length=longest or WorldModelEnv.episode_length,
        dataset=StartFrames(cfg.dataset.root, cfg.dataset.repo_id, split=cfg.split),
        done_threshold=cfg.done_threshold, done_frames=cfg.done_frames,
    )  # fmt: skip
    places = ((imagination, IMAGINED_AT_ONCE), (cfg.real_env, REAL_AT_ONCE))

    def outcomes(path: Path) -> Any:
        count = cfg.policy_episodes
        return tuple(policy_outcomes(env, path, count, EVALUATION_SEED, at_once) for env, at_once in places)

    return Agreement.of({str(path): outcomes(path) for path in policy_checkpoints(cfg.policies)})


def report_text_model(
    cfg: EvalWorldModelConfig,
    model: "ActionWorldModelRewardModel",
    text_model: "TextWorldModelRewardModel",
    source: "Source",
    evaluation: "Evaluation",
) -> "Report":
    """Goal frames, and the reward along the shown episodes."""
    from lerobot_wmrl.evaluation.pictures import save_reward_curves
    from lerobot_wmrl.evaluation.report import report_goals
    from lerobot_wmrl.evaluation.reward_curves import reward_along_episode

    curves = {
        name: reward_along_episode(
            model, text_model, cfg.reward, source.table, source.frames, run.episode,
            threshold=cfg.done_threshold, frames=cfg.done_frames,
        )
        for name, run in evaluation.shown.items()
    }  # fmt: skip
    save_reward_curves(curves, cfg.output_dir / "reward_along_episodes.png")
    return report_goals(text_model, source, evaluation, cfg.output_dir)


def main() -> None:
    """Entry point of the console command."""
    run_command(eval_world_model, EvalWorldModelConfig, partial(expand_preset, command="eval-world-model"))


if __name__ == "__main__":
    main()

"""lerobot-wmrl-eval-world-model: replay recorded episodes in a world model and measure how far to trust it.

    lerobot-wmrl-eval-world-model --model.path=outputs/action_world_model --dataset.root=D \\
        --output_dir=outputs/check

Each episode is imagined open loop: from its first frame, with its own actions. The command measures how close
the imagined frames are to the recorded ones step by step, and whether the model tells failed episodes from
successful ones (the gate: at most 5 % false positives, at least 90 % recall).

Add `--text_model.path=…` for goal frames and the reward along a successful and a failed episode.
Add `--policies=[outputs/rl] --real_env.type=wmrl_maniskill …` to compare the success of policies in the world
model with their success in that environment.
"""

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig

from lerobot_wmrl.common.checkpoints import Checkpoint
from lerobot_wmrl.common.command_line import RunConfig, run_command
from lerobot_wmrl.common.constants import DONE_FRAMES, DONE_THRESHOLD, START_SCENE
from lerobot_wmrl.common.errors import FieldError, renamed, require_at_least, require_probability
from lerobot_wmrl.common.files import write_json, write_text
from lerobot_wmrl.common.flags import flag_as_typed
from lerobot_wmrl.common.hub import check_login
from lerobot_wmrl.common.output_folders import Claim
from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.common.presets import expand_preset
from lerobot_wmrl.common.seeds import EVALUATION_SEED
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.data.episodes import EpisodeTable, choose_episodes, read_episodes
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv
from lerobot_wmrl.envs.lerobot_env import check_real_env, frame_limit
from lerobot_wmrl.envs.start_frames import chosen_episodes
from lerobot_wmrl.evaluation.agreement import Agreement, policy_checkpoints
from lerobot_wmrl.evaluation.evidence import LabelledRollouts, learnt_from
from lerobot_wmrl.evaluation.gate import MAX_FALSE_POSITIVE_RATE
from lerobot_wmrl.evaluation.pictures import save_reward_curves
from lerobot_wmrl.evaluation.policy_rollouts import (
    about_policy,
    evaluate_policy,
    opened,
    read_policies,
    run_policy,
)
from lerobot_wmrl.evaluation.reconstruction import reconstruction_metrics
from lerobot_wmrl.evaluation.replay import Recording
from lerobot_wmrl.evaluation.report import (
    ReplayEvaluation,
    Report,
    evaluate,
    report_action_model,
    report_agreement,
    report_goals,
)
from lerobot_wmrl.evaluation.reward_curves import reward_along_episode
from lerobot_wmrl.maniskill.recordings import scene_splits
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig
from lerobot_wmrl.world_models.checkpoint import check_dataset, check_same_tokenizer, load_model
from lerobot_wmrl.world_models.hub_card import EVALUATION, publish_evaluation
from lerobot_wmrl.world_models.modeling_world_model import (
    ActionWorldModelRewardModel,
    TextWorldModelRewardModel,
)
from lerobot_wmrl.world_models.training_data import require_readable_instructions

IMAGINED_AT_ONCE, REAL_AT_ONCE = 50, 2
"""Episodes of a policy that run at once."""


@dataclass
class EvalWorldModelConfig(RunConfig):
    """Replay recorded episodes in a world model and measure how far to trust it.

    Needed are `--model.path` and `--dataset.root`. Use episodes that the model was not trained on:
    `--split=validation` of its own dataset, or rollouts of a policy, labelled with their success.
    `--preset=tiny` or `--preset=demo` stands for the flags of that size; flags further right override it.

    Args:
        model: an action world model.
        text_model: a text world model, for goal frames and reward curves; may be left out.
        dataset: the recorded episodes to replay.
        split: which episodes. `all`; `train` or `validation` (held out), if this is the dataset that the
            model was trained on; `ind` or `ood`, the recorder's training scenes and its held-out scenes. A
            comma means both: `validation,ind`.
        max_episodes: largest number of episodes, chosen evenly over the dataset.
        episode_length: frames of every episode by which its outcome is judged, by default all; a later
            success does not count. Give the environment the same (`--env.episode_length`).
        done_threshold: predicted success probability at which a frame counts as done. Give the environment
            the same (`--env.done_threshold`).
        done_frames: consecutive done frames that make an imagined success. Give the environment the same
            (`--env.done_frames`).
        reward: the general reward, whose curves are drawn; as in the environment (`--env.reward.alpha`).
        policies: checkpoints of policies, or output folders of trainings, of which every checkpoint is taken.
            Success in the world model, from the dataset's first frames, is compared with success in
            `real_env`. Episodes have the same length in both.
        policy_episodes: episodes of each policy in each of the two.
        real_env: simulator for `policies`, `--real_env.type=wmrl_maniskill` and its settings.
        device: device of the models; by default the best one of this machine.
        push_to_hub: put what was found on the model's card on the hub, with animations of recorded and
            imagined episodes. `model.path` must be its name there.
        output_dir: folder of metrics.json, metrics.md and the pictures.
    """

    model: Checkpoint = field(default_factory=Checkpoint)
    text_model: Checkpoint = field(default_factory=Checkpoint)
    dataset: ChosenEpisodes = field(default_factory=ChosenEpisodes)
    split: str = "all"
    max_episodes: int = 200
    episode_length: int | None = None
    done_threshold: float = DONE_THRESHOLD
    done_frames: int = DONE_FRAMES
    reward: GeneralConfig = field(default_factory=GeneralConfig)
    policies: list[str] = field(default_factory=list)
    policy_episodes: int = 50
    real_env: EnvConfig | None = None
    device: str | None = None
    push_to_hub: bool = False
    output_dir: Path = Path("outputs/eval_world_model")

    @property
    def criterion(self) -> SuccessCriterion:
        """What makes an imagined success."""
        return SuccessCriterion(self.done_threshold, self.done_frames)

    def validate(self) -> None:
        """Raise FieldError for a setting that cannot be."""
        require_at_least(self, 1, "max_episodes", "done_frames", "policy_episodes")
        if self.episode_length is not None:
            require_at_least(self, 1, "episode_length")
        require_probability(self, "done_threshold")
        if self.push_to_hub and Path(self.model.path).exists():
            raise FieldError(
                "push_to_hub",
                True,
                f"{self.model.path} is a folder here",
                "publish it by lerobot-wmrl-train-world-model, and give its name there as `model.path`",
            )
        if self.policies and self.real_env is None:
            raise FieldError(
                "real_env.type",
                None,
                "is missing: success in the world model is compared with success in an environment",
                "set it to wmrl_maniskill, with its settings, or leave out `policies`",
            )


def eval_world_model(cfg: EvalWorldModelConfig) -> None:
    """Check that all fits, then measure."""
    cfg.validate()
    if cfg.push_to_hub:
        check_login()
    model = load_model(cfg.model.path, "action_world_model", cfg.device, "model.path")
    table = read_episodes(cfg.dataset.open())
    check_dataset(model.config, table.dataset.meta)
    text_model = load_text_model(cfg, model)
    imagination = policies_imagination(cfg, table) if cfg.policies else None
    policies = {} if imagination is None else checked_policies(cfg, imagination)
    scenes = scene_splits(table.column(START_SCENE), cfg.split)
    chosen = table.among(cfg.dataset.episodes)
    episodes = choose_episodes(table, cfg.split, cfg.max_episodes, scenes, chosen)
    for each in (model, text_model):
        if each is not None:
            require_readable_instructions(each, table.subset(episodes))
    with Claim(cfg.output_dir, draccus.encode(cfg)).held():
        warn_of_learnt(cfg.model.path, LabelledRollouts(cfg.dataset.name, table, episodes))
        recording = Recording.read(table, model, chosen)
        measure(cfg, model, text_model, recording, episodes, imagination, policies)


def warn_of_learnt(world_model: str, rollouts: LabelledRollouts) -> None:
    """Warn if the world model has learnt from the episodes that it is checked on."""
    if learnt := learnt_from(world_model, rollouts):
        logging.warning(
            "%s: the world model has learnt from %d of these %d episodes, and predicts them better than "
            "others. Take those that were held out (--split=validation), or rollouts that it has not seen",
            rollouts.name,
            learnt,
            len(rollouts.chosen),
        )


def measure(
    cfg: EvalWorldModelConfig,
    model: ActionWorldModelRewardModel,
    text_model: TextWorldModelRewardModel | None,
    recording: Recording,
    episodes: np.ndarray,
    imagination: WorldModelEnv | None,
    policies: Mapping[str, PreTrainedConfig],
) -> None:
    """Replay episodes, evaluate policies in imagination, write metrics.json, metrics.md and pictures."""
    evaluation = evaluate(model, recording, episodes, cfg.episode_length)
    reports = [report_action_model(model, recording, evaluation, cfg.criterion, cfg.output_dir)]
    if text_model is not None:
        longest = cfg.episode_length or model.config.clip_length  # as the environment has it
        reports.append(report_text_model(cfg, text_model, recording, evaluation, longest))
    if imagination is not None:
        agreement = policy_agreement(cfg, imagination, policies)
        reports.append(report_agreement(agreement, cfg.output_dir))
    metrics = {name: value for report in reports for name, value in report.metrics.items()}
    metrics["tokenizer"] = reconstruction_metrics(model, recording.table, recording.frames, episodes)
    metrics |= {"dataset": cfg.dataset.name, "split": cfg.split}
    page = "\n\n".join(report.page for report in reports)
    write_json(cfg.output_dir / "metrics.json", metrics)
    write_text(cfg.output_dir / "metrics.md", f"{page}\n")
    print(f"{page}\n\n{conclusion(cfg, len(episodes), reports[0])}")
    if cfg.push_to_hub:
        publish(cfg, metrics, page, len(episodes))


def publish(cfg: EvalWorldModelConfig, metrics: Mapping[str, Any], page: str, episodes: int) -> None:
    """Put what was found on the model's card, without paths of this machine."""
    dataset = cfg.dataset.repo_id or Path(cfg.dataset.name).name
    pictures = sorted(cfg.output_dir.glob("comparison_*.gif"))
    summary = (
        f"{episodes} recorded episodes of `{dataset}` ({cfg.split}), imagined from their first frames with "
        f"their own actions. An episode succeeds in imagination when {cfg.done_frames} frames in a row have "
        f"a success probability of at least {cfg.done_threshold}."
    )
    shown = [f"![{path.stem.replace('_', ' ')}]({EVALUATION}/{path.name})" for path in pictures]
    if shown:
        shown.append("*Recorded above, imagined below.*")
    files = {path.name: path.read_bytes() for path in pictures}
    files["metrics.json"] = json.dumps({**metrics, "dataset": dataset}, indent=2).encode()
    publish_evaluation(cfg.model.path, "\n\n".join(["## What it imagines", summary, *shown, page]), files)


def conclusion(cfg: EvalWorldModelConfig, episodes: int, report: Report) -> str:
    """Say in a few lines what was found, where it is, and what comes next."""
    metrics = report.metrics
    psnr, ceiling = (metrics["headline"][name]["value"] for name in ("psnr", "psnr_ceiling"))
    summary = (
        f"Replayed {episodes} recorded episodes of {cfg.dataset.name} open loop: PSNR {psnr:.1f} dB "
        f"(the tokenizer alone {ceiling:.1f} dB); false positives: {metrics['false_positives']} of "
        f"{metrics['failures']} failures; recall: {metrics['true_positives']} of {metrics['successes']} "
        "successes."
    )
    if not metrics["failures"] and not metrics["successes"]:
        verdict = "Nothing says which episodes succeeded, so the gate says nothing: use labelled rollouts."
    elif metrics["passed"]:
        verdict = (
            "The gate is passed. Next: train a policy in it, lerobot-wmrl-train --env.type=world_model "
            f"{flag_as_typed('env.world_model_path', cfg.model.path)} …"
        )
    elif (metrics["false_positive_rate"]["share"] or 0) > MAX_FALSE_POSITIVE_RATE:
        verdict = (
            "The gate is not passed: a policy trained in this model may exploit its false positives. Next: "
            "record more failures near success and train the model longer, or ask for more before an episode "
            "counts as a success (--done_threshold, --done_frames; the table above has other values)."
        )
    else:
        verdict = (
            "The gate is not passed, for want of recall or episodes: successes that the model does not see "
            "are never rewarded. Next: train it longer, replay more episodes, or lower --done_threshold or "
            "--done_frames (the table above has other values)."
        )
    return f"{summary}\n{verdict}\nmetrics.json, metrics.md and pictures are in {cfg.output_dir}"


def load_text_model(
    cfg: EvalWorldModelConfig, model: ActionWorldModelRewardModel
) -> TextWorldModelRewardModel | None:
    """Load the text world model if one is named. ValueError if its tokens are another tokenizer's."""
    if not cfg.text_model.path:
        return None
    text_model = load_model(cfg.text_model.path, "text_world_model", cfg.device, "text_model.path")
    check_same_tokenizer(model, text_model, "text_model.path", cfg.text_model.path)
    return text_model


def policies_imagination(cfg: EvalWorldModelConfig, table: EpisodeTable) -> WorldModelEnv:
    """Return the world model as `policies` are evaluated in it, from starts of the environment's task.

    Raises:
        FieldError: nothing can be evaluated in it, or the dataset has too few starts.
    """
    tasks = cfg.real_env.task_names if isinstance(cfg.real_env, WmrlManiSkillEnv) else None
    if tasks is not None and len(tasks) > 1:
        raise FieldError(
            "real_env.task",
            ",".join(tasks),
            "the success of `policies` is compared in one task at a time",
            "choose one",
        )
    starts = StartFrames(**vars(cfg.dataset), split=cfg.split, tasks=tasks, max_starts=cfg.policy_episodes)
    assert cfg.real_env is not None, "the settings were checked"
    longest = frame_limit(cfg.real_env)
    with renamed("world_model_path", "model.path"):
        imagination = WorldModelEnv(
            world_model_path=cfg.model.path,
            device=cfg.device,
            episode_length=longest,
            dataset=starts,
            done_threshold=cfg.done_threshold,
            done_frames=cfg.done_frames,
        )
    with renamed("dataset.split", "split"):
        available = len(chosen_episodes(table, starts))
    if available < cfg.policy_episodes:
        raise FieldError(
            "policy_episodes",
            cfg.policy_episodes,
            f"the dataset has {available} starts, and an episode that is repeated says nothing new",
            f"set it to at most {available}, or choose another `split`",
        )
    return imagination


def checked_policies(cfg: EvalWorldModelConfig, imagination: WorldModelEnv) -> dict[str, PreTrainedConfig]:
    """Return the configurations of the policies by their checkpoints, checked before the long replay.

    Raises:
        FieldError: a policy cannot act in the world model, or not in `real_env`, of which one is made.
    """
    assert cfg.real_env is not None
    paths = [str(path) for path in policy_checkpoints(cfg.policies)]
    policies = dict(zip(paths, read_policies(paths, imagination).values(), strict=True))
    for path, config in policies.items():
        with about_policy(path):
            check_real_env(config, cfg.real_env)
    return policies


def policy_agreement(
    cfg: EvalWorldModelConfig, imagination: WorldModelEnv, policies: Mapping[str, PreTrainedConfig]
) -> Agreement:
    """Run every policy in the world model, which is made once, and in `real_env`."""
    assert cfg.real_env is not None
    episodes, outcomes = cfg.policy_episodes, {}
    with opened(imagination, min(IMAGINED_AT_ONCE, episodes), False, 1) as (envs,):
        for path, config in policies.items():
            with about_policy(path):
                policy = LoadedPolicy.load(config)
            imagined = run_policy(envs, imagination, policy, episodes, EVALUATION_SEED)
            real = evaluate_policy(cfg.real_env, policy, episodes, EVALUATION_SEED, REAL_AT_ONCE)
            outcomes[path] = imagined.successes, real.successes
    return Agreement.of_outcomes(outcomes)


def report_text_model(
    cfg: EvalWorldModelConfig,
    text_model: TextWorldModelRewardModel,
    recording: Recording,
    evaluation: ReplayEvaluation,
    longest: int,
) -> Report:
    """Report goal frames, and draw the reward along the shown episodes."""
    curves = {
        name: reward_along_episode(
            text_model,
            cfg.reward,
            recording,
            replay,
            criterion=cfg.criterion,
            longest=longest,
        )
        for name, replay in evaluation.shown.items()
    }
    save_reward_curves(curves, cfg.output_dir / "reward_along_episodes.png")
    return report_goals(text_model, recording, evaluation, cfg.output_dir)


def main() -> None:
    """Run the console command."""
    run_command(eval_world_model, EvalWorldModelConfig, partial(expand_preset, command="eval-world-model"))


if __name__ == "__main__":
    main()

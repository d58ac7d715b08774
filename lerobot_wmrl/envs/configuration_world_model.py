"""Configuration of the world model as an environment, `--env.type=world_model`."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
from lerobot.configs.rewards import RewardModelConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

from lerobot_wmrl.common.constants import DONE_FRAMES, DONE_THRESHOLD, TASK_NAMES
from lerobot_wmrl.common.errors import FieldError, require_at_least, require_probability
from lerobot_wmrl.common.images import camera_key
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.rewards.configuration_rewards import GeneralConfig


@dataclass
class StartFrames(ChosenEpisodes):
    """Where imagined episodes begin: in a dataset's episodes (`root` or `repo_id`), in their first frames, in
    saved frames (`frames`) or in ManiSkill's resets (`resets`).

    Args:
        split: `train` (what the world model was trained on), `validation` (held out) or `all`; `ind` (scenes
            that training may see) or `ood` (scenes held out). Several joined by a comma: their intersection.
        tasks: only episodes of these tasks, by name.
        scenes: only episodes of these scenes, by index.
        max_starts: number of starts at most, spread evenly over the episodes or saved frames; each needs a
            goal frame. Of `resets` all are taken.
        branches: later frames of each episode of the dataset from which imagined episodes begin too, spread
            over those before its success (branched rollouts, Janner et al. 2019).
        frames: a file written by numpy.savez, in place of a dataset: `observation.images.<camera>`
            (K, H, W, 3) uint8, `task` (K,), the instructions, and `observation.state` (K, P), if the world
            model has one.
        resets: number of start frames to take from ManiSkill, in place of a dataset, of `tasks` (push by
            default), `scenes` and the split `ind` (by default) or `ood`.
    """

    split: str = "all"
    tasks: list[str] | None = None
    scenes: list[int] | None = None
    max_starts: int = 256
    branches: int = 0
    frames: Path | None = None
    resets: int = 0

    def validate(self) -> None:
        """Raise FieldError unless there is exactly one kind of starts, and it can be chosen as asked."""
        chosen = [name for name in ("given", "frames", "resets") if getattr(self, name)]
        if len(chosen) != 1:
            named = " and ".join(chosen).replace("given", "a dataset") or "nothing"
            raise FieldError(
                "dataset.root",
                self.name,
                f"starts are given by {named}",
                "give one of `dataset.root`, `dataset.repo_id`, `dataset.frames` and `dataset.resets`",
            )
        if self.branches < 0 or (self.branches and not self.given):
            raise FieldError(
                "dataset.branches",
                self.branches,
                "imagined episodes branch off from episodes of a dataset, at least 0 times",
                "give a dataset; saved frames and resets are first frames",
            )
        if self.branches >= self.max_starts:
            raise FieldError(
                "dataset.branches",
                self.branches,
                f"an episode with so many branches has more than the {self.max_starts} starts of "
                "`dataset.max_starts`",
                "raise that, or lower this",
            )
        if self.episodes is not None and not self.given:
            raise FieldError(
                "dataset.episodes",
                self.episodes,
                "chooses episodes of a dataset, and there is none",
                "leave it out",
            )
        if self.frames and (self.tasks or self.scenes or self.split != "all"):
            raise FieldError(
                "dataset.frames",
                self.frames,
                "saved frames do not say their task, scene or split",
                "leave out `dataset.tasks`, `dataset.scenes` and `dataset.split`",
            )
        if self.resets and self.split not in ("all", "ind", "ood"):
            raise FieldError(
                "dataset.split",
                self.split,
                "no world model was trained on ManiSkill's resets",
                "choose ind or ood",
            )
        if self.resets < 0:
            raise FieldError("dataset.resets", self.resets, "must be at least 1")


@EnvConfig.register_subclass("world_model")
@dataclass
class WorldModelEnv(EnvConfig):
    """The action world model answers the policy's actions; the text world model imagines goal frames.

    Args:
        world_model_path: the action world model, a checkpoint or the output folder of its training.
        text_world_model_path: the text world model; not needed by rewards without a goal frame.
        dataset: where imagined episodes start. Give one of `root`, `repo_id`, `frames` and `resets`.
        reward: `general` and its settings; `embedding` or `proxy` with the output folder of its training as
            `reward.pretrained_path`; or one of LeRobot's own, such as `reward_classifier`.
        episode_length: frames after which an episode is truncated; by default as many as the clips that the
            world model has learnt from have (`clip_length`).
        done_threshold: predicted success probability θ at which a frame counts as done (eq. 7).
        done_frames: consecutive done frames k that make a success.
        fps: frames a second, those of the world model's dataset.
        device: device of the models; by default the best one of this machine, and in lerobot-wmrl-train the
            policy's.
    """

    task: str | None = "imagination"
    fps: int = 0
    world_model_path: str = ""
    text_world_model_path: str = ""
    dataset: StartFrames = field(default_factory=StartFrames)
    reward: RewardModelConfig = field(default_factory=GeneralConfig)
    episode_length: int | None = None
    done_threshold: float = DONE_THRESHOLD
    done_frames: int = DONE_FRAMES
    device: str | None = None
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=lambda: {ACTION: ACTION, "agent_pos": OBS_STATE})

    def __post_init__(self) -> None:
        """Check the settings; describe observation and action as the world model's checkpoint has them."""
        self._check()
        if not self.world_model_path:
            return
        if isinstance(self.reward, GeneralConfig) and self.reward.alpha is None:
            alpha = self.reward.success_weight if self.text_world_model_path else 1.0
            self.reward = replace(self.reward, alpha=alpha)
        if getattr(self.reward, "needs_goal", False) and not self.text_world_model_path:
            raise FieldError(
                "text_world_model_path",
                "",
                "the dense part of the general reward needs goal frames",
                "give a text world model, or set `reward.alpha` to 1",
            )
        from lerobot_wmrl.world_models.checkpoint import read_config

        model = read_config(self.world_model_path, "action_world_model")
        if self.fps not in (0, model.embodiment.fps):
            raise FieldError(
                "fps",
                self.fps,
                f"the world model has learnt {model.embodiment.fps} frames a second",
                "leave it out",
            )
        self._check_rewarding(model)
        self.fps, self.episode_length = model.embodiment.fps, self.episode_length or model.clip_length
        self._check_length()
        self.features[ACTION] = PolicyFeature(type=FeatureType.ACTION, shape=(model.action_size,))
        if model.state_size:
            self.features["agent_pos"] = PolicyFeature(type=FeatureType.STATE, shape=(model.state_size,))
        shapes = model.trained_tokenizer.frame_shapes.values()
        for camera, (colors, height, width) in zip(model.trained_tokenizer.cameras, shapes, strict=True):
            pixels = "pixels" if camera == OBS_IMAGE else f"pixels/{camera}"  # as LeRobot's environments do
            self.features[pixels] = PolicyFeature(FeatureType.VISUAL, (height, width, colors))
            self.features_map[pixels] = camera_key(camera)

    def _check(self) -> None:
        require_at_least(self, 1, "done_frames")
        require_probability(self, "done_threshold")
        self._check_length()
        if self.dataset.max_starts < 1:
            raise FieldError("dataset.max_starts", self.dataset.max_starts, "must be at least 1")
        unknown = sorted({*(self.dataset.tasks or ())} - {*TASK_NAMES})
        if unknown:
            raise FieldError("dataset.tasks", unknown, f"choose from {', '.join(TASK_NAMES)}")

    def _check_rewarding(self, model: Any) -> None:
        """Raise FieldError if the world model would never reward."""
        success_alone = isinstance(self.reward, GeneralConfig) and not self.reward.needs_goal
        if model.learnt_successes == 0 and success_alone:
            raise FieldError(
                "world_model_path",
                self.world_model_path,
                "has learnt from no episode that is known to succeed, so it would never reward",
                "label the episodes with lerobot-wmrl-label and train it again, or choose another reward "
                "(`reward.type`)",
            )

    def _check_length(self) -> None:
        if self.episode_length is None:
            return
        require_at_least(self, 1, "episode_length")
        if self.episode_length < self.done_frames:
            raise FieldError(
                "episode_length",
                self.episode_length,
                f"shorter than the {self.done_frames} frames for which done must hold, so that no episode "
                "could succeed",
                "raise it, or lower `done_frames`",
            )

    @property
    def horizon(self) -> int:
        """Frames after which an episode is truncated. ValueError without a world model, which says it."""
        if self.episode_length is None:
            raise ValueError("world_model_path: is missing; it says how long episodes are")
        return self.episode_length

    @property
    def criterion(self) -> SuccessCriterion:
        """What makes an imagined success."""
        return SuccessCriterion(self.done_threshold, self.done_frames)

    @property
    def judged_frames(self) -> int | None:
        """Frames of a recorded episode by which its outcome is compared with the predicted one: those of an
        imagined episode, or None, all, where imagination also begins in the middle of episodes."""
        return None if self.dataset.branches else self.horizon

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_tensor_env(self, n_envs: int, device: str | None = None) -> gym.vector.VectorEnv:
        """Return one batch of `n_envs` imaginations on the device, for reinforcement learning."""
        from lerobot_wmrl.envs.world_model_env import make_world_model_env

        return make_world_model_env(self, n_envs, device or self.device)

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Return one environment for each task, in numpy, for lerobot-eval.

        They are batched by themselves, so `use_async_envs` changes nothing.
        """
        from lerobot_wmrl.envs.evaluation_adapter import EvaluationAdapter
        from lerobot_wmrl.envs.world_model_env import make_task_envs

        envs = make_task_envs(self, n_envs, self.device)
        return {self.type: {task: EvaluationAdapter(env) for task, env in envs.items()}}


@dataclass
class DrivenEnv(WorldModelEnv):
    """Imagined episodes that somebody drives, also where the world model knows no success."""

    def _check_rewarding(self, model: Any) -> None:
        """Accept world models that know no success."""

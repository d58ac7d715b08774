"""What all visitors share: the world models, who can act, and where an episode can begin."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import OBS_STATE
from PIL import Image, ImageOps
from torchvision.transforms.v2.functional import pil_to_tensor

from lerobot_wmrl.common.errors import FieldError, within
from lerobot_wmrl.common.policies import LoadedPolicy
from lerobot_wmrl.common.policy_checks import fit_to_environment
from lerobot_wmrl.common.success_criterion import SuccessCriterion
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.data.episodes import EpisodeTable, read_episodes
from lerobot_wmrl.data.frame_cache import cached_frames
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.envs.lerobot_env import make_tensor_env
from lerobot_wmrl.envs.start_frames import StartImages, maniskill_side, observed_frame, recorded_frames
from lerobot_wmrl.envs.world_model_env import WorldModels, load_world_models
from lerobot_wmrl.play.checks import instruction, is_numbers, whole_number
from lerobot_wmrl.play.drive import Drive, RealEpisode, Recorded
from lerobot_wmrl.play.drivers import Driver, PlannerDriver, PolicyDriver, RecordedDriver, copied
from lerobot_wmrl.world_models.checkpoint import check_dataset
from lerobot_wmrl.world_models.configuration_frame_tokenizer import TokenizerConfig
from lerobot_wmrl.world_models.configuration_planner import PlannerSettings
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig

LARGEST_SEED: Final = 2**31 - 1
LARGEST_SIDE: Final = 4096
"""Pixels of a side of an uploaded picture."""

CENTRED: Final = 0.05
"""An action's component springs back to 0 if the middle of its range is no farther from 0 than this share of
the range: it is then likely to be a velocity or a displacement. Grippers, and what is named like a position
or a state, stay where they are."""


@dataclass
class World:
    """What all visitors share.

    Args:
        models: the world models.
        config: configuration of the imagined episodes.
        criterion: what makes a success; an episode is judged by it even where it does not end.
        table: table of the dataset in whose frames episodes can begin.
        policy: a policy that the page offers as a driver; may be left out.
        real_env: that takes the same actions, and whose resets episodes can begin in.
    """

    models: WorldModels
    config: WorldModelEnv
    criterion: SuccessCriterion
    table: EpisodeTable | None = None
    policy: LoadedPolicy | None = None
    real_env: EnvConfig | None = None
    uploads: dict[str, StartImages] = field(default_factory=dict)

    @property
    def model(self) -> ActionWorldModelConfig:
        """Configuration of the action world model."""
        config: ActionWorldModelConfig = self.models.model.config
        return config

    @property
    def tokenizer_config(self) -> TokenizerConfig:
        """Settings of the tokenizer: cameras, and sizes of their images."""
        return self.model.trained_tokenizer

    def description(self) -> dict[str, Any]:
        """Return what the page needs to know, as JSON."""
        table = self.table
        episodes: list[dict[str, Any]] = []
        if table is not None:
            rows = zip(table.length.tolist(), table.success.tolist(), table.instructions, strict=True)
            episodes = [
                {"length": length, "success": success if table.has_labels else None, "task": task}
                for length, success, task in rows
            ]
        return {
            "cameras": list(self.tokenizer_config.cameras),
            "fps": self.model.embodiment.fps,
            "axes": self.axes(),
            "state": self.model.embodiment.state_names if self.model.state_size else [],
            "clip_length": self.model.clip_length,
            "done_threshold": self.criterion.threshold,
            "drivers": self.driver_names(),
            "policy": self.policy.config.type if self.policy else "",
            "episodes": episodes,
            "real": self.real_env.type if self.real_env else "",
            "goal": self.models.text_model is not None,
            "knows_success": self.model.learnt_successes != 0,
            "compares": self.real_env is not None or table is not None,
            "first_frames": False,
            "saves": True,
        }

    def axes(self) -> list[dict[str, Any]]:
        """Return the components of an action: name, range, value to begin with, and whether it is held there
        when nobody touches it or springs back."""
        robot, means = self.model.embodiment, self.models.model.action_mean.tolist()
        axes = []
        for name, low, high, mean in zip(
            robot.action_names, robot.action_low, robot.action_high, means, strict=True
        ):
            position = "gripper" in name.lower() or name.endswith(".pos") or name in robot.state_names
            centred = abs(low + high) / 2 <= CENTRED * (high - low) and not position
            rest = 0.0 if centred else min(max(mean, low), high)
            axes.append({"name": name, "low": low, "high": high, "rest": rest, "springs": centred})
        return axes

    def driver_names(self) -> list[str]:
        """Return who can act besides the visitor."""
        there = {
            "policy": self.policy is not None,
            "planner": self.model.learnt_successes != 0,
            "recorded": self.table is not None,
        }
        return [name for name, available in there.items() if available]

    def driver(self, name: str) -> Driver:
        """Return a visitor's own driver of one of `driver_names`."""
        if name == "recorded":
            return RecordedDriver()
        policy = self.policy and copied(self.policy)
        if name == "policy" and policy is not None:
            return PolicyDriver(policy)
        return PlannerDriver(planner_settings(self.model.clip_length), self.criterion.frames, policy)

    def make_real_env(self) -> Any:
        """Return a visitor's own real environment, None if there is none."""
        if self.real_env is None:
            return None
        with within("real_env"):
            env = make_tensor_env(self.real_env, 1, "cpu")
        count, wanted = env.single_action_space.shape[0], len(self.model.embodiment.action_names)
        if count != wanted:
            env.close()
            raise FieldError(
                "real_env.type",
                self.real_env.type,
                f"takes actions of {count} components, the world model has learnt {wanted}",
                "give the environment that its dataset is from",
            )
        if self.model.embodiment.action_low:
            ends = self.model.embodiment.action_low, self.model.embodiment.action_high
            env.widen(*(torch.tensor(end, dtype=torch.float32) for end in ends))
        return env

    def begin(self, place: Mapping[str, Any], real_env: Any) -> Drive:
        """Begin a drive.

        Args:
            place: where: `episode` and `frame` of the dataset; `seed` of the real environment; or `picture`,
                the name of an upload. With `instruction`, in place of the recorded one.
            real_env: the visitor's.

        Raises:
            FieldError: there is no such place.
        """
        recorded, real, wanted = None, None, instruction(place.get("instruction", ""))
        if "episode" in place:
            start, recorded = self._recorded(place)
        elif "seed" in place:
            if real_env is None or self.real_env is None:
                raise FieldError(
                    "seed", place["seed"], "there is no real environment", "give `real_env.type`"
                )
            seed = whole_number("seed", place["seed"], LARGEST_SEED)
            real = RealEpisode(self.real_env.type, real_env, seed)
            start = observed_frame(real.observation, self.tokenizer_config)
            if self.model.state_size not in (0, count := start.state.shape[1]):
                raise FieldError(
                    "real_env.type",
                    self.real_env.type,
                    f"has a state of {count} components, the world model has learnt {self.model.state_size}",
                    "give the environment that its dataset is from",
                )
        else:
            start = self._uploaded(place)
        if wanted:
            start = start._replace(instructions=[wanted])
        return Drive(start, self.models, self.config, recorded, real)

    def upload(self, name: str, images: Mapping[str, Image.Image], state: Any, task: str) -> None:
        """Keep pictures, one for each camera, as a place to begin.

        Args:
            name: name of the place.
            images: images by camera.
            state: (P,) in the dataset's units; None for a world model that predicts no state.
            task: the instruction.

        Raises:
            FieldError: a camera is missing or unknown, or the state has another length.
        """
        tokenizer_config, count = self.tokenizer_config, self.model.state_size
        values = [] if state is None else state
        if not is_numbers(values) or len(values) != count:
            raise FieldError(
                "state",
                state,
                f"must be {count} finite numbers: {', '.join(self.model.embodiment.state_names)}",
            )
        try:
            pictures = [images[camera] for camera in tokenizer_config.cameras]
            shown = {
                key: pil_to_tensor(ImageOps.exif_transpose(picture).convert("RGB"))[None]
                for key, picture in zip(tokenizer_config.camera_keys, pictures, strict=True)
            }
        except OSError as error:
            raise FieldError("picture", sorted(images), f"cannot be decoded ({error})") from error
        shown[OBS_STATE] = torch.tensor([values], dtype=torch.float32).reshape(1, count)
        self.uploads[name] = observed_frame({**shown, "task": [task]}, tokenizer_config)

    def _recorded(self, place: Mapping[str, Any]) -> tuple[StartImages, Recorded]:
        """Return a frame of the dataset, and what followed it."""
        if self.table is None:
            raise FieldError("episode", place["episode"], "there is no dataset", "give `dataset.root`")
        episode = whole_number("episode", place["episode"], len(self.table.start) - 1)
        frame = whole_number("frame", place.get("frame"), int(self.table.length[episode]) - 1)
        begin = int(self.table.start[episode])
        first, end = begin + frame, begin + int(self.table.length[episode])
        images = cached_frames(
            self.table.dataset, self.tokenizer_config.camera_keys, self.tokenizer_config.image_size
        )[first:end]
        actions = self.table.action[first:end].astype(np.float32)
        return recorded_frames(self.table, np.array([first]), self.tokenizer_config), Recorded(
            actions, images
        )

    def _uploaded(self, place: Mapping[str, Any]) -> StartImages:
        name = place.get("picture")
        if not isinstance(name, str) or name not in self.uploads:
            raise FieldError("picture", name, "is no picture that was uploaded", "upload it (again)")
        return self.uploads[name]


def load_world(
    config: WorldModelEnv,
    dataset: ChosenEpisodes,
    policy: PreTrainedConfig | None,
    real_env: EnvConfig | None,
    end_at_success: bool = True,
) -> World:
    """Load what `config` names, and check that dataset and policy fit the world model.

    Args:
        config: configuration of the imagined episodes.
        dataset: episodes in whose frames they can begin, if it is given.
        policy: a policy that the page offers as a driver; may be left out.
        real_env: that takes the same actions.
        end_at_success: whether an episode ends when it succeeds.

    Raises:
        FieldError: one of them does not fit.
    """
    models = load_world_models(config, config.device)
    driven = config if end_at_success else replace(config, done_frames=config.horizon)
    world = World(models, driven, config.criterion)
    if isinstance(real_env, WmrlManiSkillEnv):
        if len(real_env.task_names) > 1:
            raise FieldError("real_env.task", real_env.task, "a drive needs a single task", "choose one")
        remedy = "choose the environment that the dataset was recorded in"
        side = maniskill_side(world.tokenizer_config, "real_env.type", real_env.type, remedy)
        real_env = replace(real_env, cameras=list(world.tokenizer_config.cameras), image_size=side)
    world.real_env = real_env
    if dataset.given:
        recorded = read_episodes(dataset.open())
        check_dataset(world.model, recorded.dataset.meta)
        world.table = recorded.subset(recorded.among(dataset.episodes))
    if policy is not None and hasattr(policy, "proposal_path"):
        raise FieldError(
            "policy.path",
            policy.pretrained_path,
            f"{policy.type} plans in a world model, as the page does",
            "leave it out, or give the policy that it improves on (`proposal_path`)",
        )
    if policy is not None:
        fit_to_environment(policy, world.model.observation_shapes, world.model.action_size)
        world.policy = LoadedPolicy.load(policy)
        models.model.check_units(policy, world.policy.postprocessor)
    return world


def planner_settings(clip_length: int) -> PlannerSettings:
    """Return a planner's settings for a world model that has learnt from clips of this length."""
    default = PlannerSettings()
    horizon = min(default.horizon, clip_length)
    return PlannerSettings(
        horizon=horizon, execute=min(default.execute, horizon), knots=min(default.knots, horizon)
    )

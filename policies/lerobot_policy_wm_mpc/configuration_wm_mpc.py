"""Configuration of planning inside a world model, `--policy.type=wm_mpc`."""

from dataclasses import dataclass, field
from typing import Final

from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import NormalizationMode

from lerobot_wmrl.common.constants import DONE_FRAMES
from lerobot_wmrl.common.errors import FieldError, require_at_least, require_choice
from lerobot_wmrl.common.policy_configuration import SingleStepConfig
from lerobot_wmrl.world_models.configuration_planner import PlannerSettings

OBJECTIVES: Final = ("success", "goal")


@PreTrainedConfig.register_subclass("wm_mpc")
@dataclass
class WmMpcConfig(PlannerSettings, SingleStepConfig):
    """A policy that plans: it imagines action sequences and executes the beginning of the best one.

    The cross-entropy method (Rubinstein 1999) searches the sequences. It samples them around a mean and moves
    the mean to the best of them, several times. Nothing is trained.

    With `proposal_path` it improves on a policy: it imagines what that policy would do and searches changes
    of these actions. The policy's own actions are returned if no change is predicted to do better.

    Args:
        world_model_path: the action world model, a checkpoint or the output folder of its training.
        proposal_path: the policy whose actions are changed; by default the search begins at what is left of
            the last plan. `spread` is then the standard deviation of the changes.
        text_world_model_path: the text world model, for goal frames; only the objective `goal` needs it.
        objective: what is maximised: `success`, the smallest done logit of `done_frames` consecutive frames;
            `goal`, the similarity of the last frame to the goal frame.
        done_frames: consecutive done frames that make a success, as in the environment.
        seed: seed of the samples.
    """

    world_model_path: str = ""
    proposal_path: str = ""
    text_world_model_path: str = ""
    objective: str = "success"
    done_frames: int = DONE_FRAMES
    seed: int = 0
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.IDENTITY,
        }
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice(self, "objective", OBJECTIVES)
        self.check_planner()
        require_at_least(self, 1, "done_frames")
        if self.done_frames > self.horizon:
            raise FieldError("done_frames", self.done_frames, f"must be at most `horizon`, {self.horizon}")

    def validate_features(self) -> None:
        """Raise FieldError unless there is a world model to plan in."""
        if not self.world_model_path:
            raise FieldError("world_model_path", "", "is missing", "give the action world model to plan in")
        if self.objective == "goal" and not self.text_world_model_path:
            raise FieldError(
                "text_world_model_path",
                "",
                "the objective goal needs a text world model for goal frames",
                "give one, or set `objective` to success",
            )

    def get_optimizer_preset(self) -> None:
        """Return None: nothing is trained."""


WmMpcConfig.__doc__ = (
    f"{WmMpcConfig.__doc__}\n    {PlannerSettings.__doc__}"  # --help shows its own docstring alone
)

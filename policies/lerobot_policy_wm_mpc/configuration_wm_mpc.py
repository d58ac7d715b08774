"""Configuration of planning inside a world model, `--policy.type=wm_mpc`."""

from dataclasses import dataclass, field
from typing import Final

from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import NormalizationMode

from lerobot_wmrl.common.policy_configuration import SingleStepConfig

OBJECTIVES: Final = ("success", "goal")


@PreTrainedConfig.register_subclass("wm_mpc")
@dataclass
class WmMpcConfig(SingleStepConfig):
    """Nothing is learnt: action sequences are imagined, and the best one's beginning is carried out.

    The sequences are those of the cross-entropy method (Rubinstein 1999): drawn around a mean, which moves to
    the best of them, again and again.

    Args:
        world_model_path: the action world model, a checkpoint or the output folder of its training.
        text_world_model_path: the text world model, for goal frames; only `objective=goal` needs it.
        objective: what the best sequence is: `success`, done is likeliest for `done_frames` frames in a row;
            `goal`, its last frame is most like the goal frame.
        horizon: frames that are imagined ahead. execute: actions that are carried out before planning anew.
        samples, elites, iterations: sequences drawn at a time, those that the mean moves to, and how often.
        knots: actions that are drawn of a sequence, evenly spaced; those between them are interpolated.
        spread: of the first draw, in standard deviations of the dataset's actions.
        seed: of the draws.
        done_frames: for how many frames in a row done has to hold where success is the objective; as in the
            environment.
    """

    world_model_path: str = ""
    text_world_model_path: str = ""
    objective: str = "success"
    horizon: int = 40
    execute: int = 8
    samples: int = 64
    elites: int = 8
    iterations: int = 4
    knots: int = 6
    spread: float = 1.0
    done_frames: int = 3
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
        if self.objective not in OBJECTIVES:
            raise ValueError(f"--policy.objective={self.objective}: choose {' or '.join(OBJECTIVES)}")
        for name in ("horizon", "execute", "samples", "elites", "iterations", "done_frames", "spread"):
            if getattr(self, name) <= 0:
                raise ValueError(f"--policy.{name}={getattr(self, name)}: must be above 0")
        if not 2 <= self.knots <= self.horizon:
            raise ValueError(f"--policy.knots={self.knots}: must be from 2 to horizon={self.horizon}")
        for name, most in (("elites", "samples"), ("execute", "horizon"), ("done_frames", "horizon")):
            if getattr(self, name) > getattr(self, most):
                raise ValueError(
                    f"--policy.{name}={getattr(self, name)}: must be at most {most}={getattr(self, most)}"
                )

    def validate_features(self) -> None:
        """ValueError unless there is a world model to plan in."""
        if not self.world_model_path:
            raise ValueError("--policy.world_model_path is missing: give the action world model to plan in")
        if self.objective == "goal" and not self.text_world_model_path:
            raise ValueError(
                "--policy.text_world_model_path is missing: objective=goal needs a text world model, which "
                "imagines the goal frame; give one, or --policy.objective=success"
            )

    def get_optimizer_preset(self) -> None:
        """Nothing is trained."""

"""Configuration of the imagined robot, `--robot.type=imagined`."""

from dataclasses import dataclass, field

from lerobot.robots import RobotConfig

from lerobot_wmrl.common.constants import DONE_FRAMES, DONE_THRESHOLD
from lerobot_wmrl.common.errors import FieldError, require_positive
from lerobot_wmrl.envs.configuration_world_model import StartFrames


@dataclass
class EveryStart(StartFrames):
    """The first frames of every episode of a dataset, where it has not more than these."""

    max_starts: int = 100_000


@RobotConfig.register_subclass("imagined")
@dataclass(kw_only=True)
class ImaginedRobotConfig(RobotConfig):
    """A robot whose cameras and state a world model imagines, for lerobot-teleoperate, lerobot-record,
    lerobot-replay and lerobot-rollout.

    The next episode begins at the key that ends one in lerobot-record (right arrow or `n`; at the left arrow
    or `r`, which record an episode again, the same begins again), and `episode_time_s` after an episode's
    first frame was shown. LeRobot's commands do not tell a robot of it otherwise. Nothing has to be reset by
    hand: give lerobot-record `--dataset.reset_time_s=0`. After a success the robot stands still.

    Args:
        world_model_path: the action world model, a checkpoint or the output folder of its training.
        dataset: dataset in whose frames episodes begin, one after the other: in those of every episode,
            unless `dataset.max_starts` is less than there are.
        first_start: number of the frame in which the first episode begins.
        episode_time_s: seconds after which the next episode begins, `dataset.episode_time_s` of the command.
            None if keys alone end one.
        done_threshold: predicted success probability at which a frame counts as done.
        done_frames: consecutive done frames that make a success.
        suffix: what is added to the names of states and actions. lerobot-rollout needs `.pos` where the
            dataset's names do not end so, since it passes no others on.
        device: device of the world model; by default the best one of this machine.
    """

    world_model_path: str = ""
    dataset: EveryStart = field(default_factory=EveryStart)
    first_start: int = 0
    episode_time_s: float | None = None
    done_threshold: float = DONE_THRESHOLD
    done_frames: int = DONE_FRAMES
    suffix: str = ""
    device: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.world_model_path:
            raise FieldError(
                "robot.world_model_path", "", "is missing", "give the action world model that imagines"
            )
        if self.episode_time_s is not None:
            require_positive(self, "episode_time_s")

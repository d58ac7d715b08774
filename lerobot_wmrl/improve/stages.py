"""The stages of an improvement, in order."""

from collections.abc import Callable
from functools import partial
from typing import Final

from lerobot_wmrl.common.errors import STOPPED
from lerobot_wmrl.common.stages import Stage, never
from lerobot_wmrl.improve import commands
from lerobot_wmrl.improve.progress import Progress
from lerobot_wmrl.improve.stage_names import StageName

COMMANDS: Final[dict[StageName, tuple[str, Callable[[Progress], list[str]]]]] = {
    StageName.COLUMNS: ("Leave out columns that rollouts lack", commands.columns_command),
    StageName.ROLLOUTS: ("Record rollouts of the policy", commands.rollouts_command),
    StageName.MERGED: ("Merge the dataset with them", commands.merged_command),
    StageName.CLONED: ("Train the policy further on the successes", commands.cloned_command),
    StageName.TOKENIZER: ("Train the frame tokenizer", commands.tokenizer_command),
    StageName.WORLD_MODEL: ("Train the world model", commands.world_model_command),
    StageName.CHECK: ("Check the world model on recorded episodes", commands.check_command),
    StageName.START: ("Choose in imagination which policy to improve", commands.start_command),
    StageName.RL: ("Train the policy in imagination", commands.rl_command),
    StageName.DISTILLED: ("Fit the policy to a planner in imagination", commands.distilled_command),
    StageName.CHOICE: ("Choose the policy to use", commands.choice_command),
    StageName.COMPARISON: ("Compare the policies", commands.comparison_command),
}
"""What every stage does, in the order of the stages, and what makes its command."""

FRESH: Final = StageName.COLUMNS, StageName.MERGED, StageName.CLONED
"""Stages of LeRobot's commands, which refuse a folder that an interrupted call left."""


def list_stages(progress: Progress) -> list[Stage]:
    """List every stage that this improvement needs, in order."""
    plan, config = progress.plan, progress.plan.config

    def stopped_beside_others(status: int) -> bool:
        """Return whether training stopped by a rule of its own, and there is a policy to compare with the one
        before. After any other failure it can go on."""
        return status == STOPPED and (plan.clones or plan.rl_checkpoint.exists())

    def leaves_policies(status: int) -> bool:
        """Return the same of RL: the policy that is fitted to a planner after it is one to compare too."""
        return stopped_beside_others(status) or (status == STOPPED and config.distils)

    left_out = {
        StageName.COLUMNS: not plan.extra_columns,
        StageName.ROLLOUTS: not config.rollouts,
        StageName.MERGED: not config.rollouts,
        StageName.CLONED: not plan.clones,
        StageName.START: not plan.clones,
        StageName.DISTILLED: not config.distils,
        StageName.CHOICE: not config.selects,
    }
    optional = {StageName.RL: leaves_policies, StageName.DISTILLED: stopped_beside_others}
    return [
        Stage(
            name,
            title,
            partial(command, progress),
            optional.get(name, never),
            plan.folder(name) if name in FRESH else None,
        )
        for name, (title, command) in COMMANDS.items()
        if not left_out.get(name, False)
    ]

"""The stages of the demo: which command each one runs, as a user would type it."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from lerobot_wmrl.common.checkpoints import last_model
from lerobot_wmrl.common.command_line import RunConfig
from lerobot_wmrl.common.errors import FieldError, require_at_least, require_choice
from lerobot_wmrl.common.flags import Flags, env_flags, program_call
from lerobot_wmrl.common.lerobot_commands import train_command
from lerobot_wmrl.common.policies import read_policy_config
from lerobot_wmrl.common.presets import preset_settings, presets_of
from lerobot_wmrl.common.seeds import EVALUATION_SEED, require_seed
from lerobot_wmrl.common.stages import Stage
from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.dataset import ChosenEpisodes
from lerobot_wmrl.data.episodes import VALIDATION_EVERY
from lerobot_wmrl.envs.configuration_wmrl_maniskill import WmrlManiSkillEnv
from lerobot_wmrl.improve import commands
from lerobot_wmrl.improve.configuration_improve import ROLLOUT_SEED_OFFSET, ImproveConfig
from lerobot_wmrl.improve.plan import Plan
from lerobot_wmrl.improve.progress import Progress
from lerobot_wmrl.improve.report.curves import curve, lerobot_train_curve
from lerobot_wmrl.improve.report.page import Page, stage_records
from lerobot_wmrl.improve.report.words import verdict
from lerobot_wmrl.improve.results import read_place
from lerobot_wmrl.improve.stage_names import StageName

SEEDS_A_DEMO: Final = 100_000
"""Demo seed s records and trains with seeds from s·SEEDS_A_DEMO on, below EVALUATION_SEED."""

EXPLORATION: Final = 0.4
"""Largest noise on the cloned policy's actions in its rollouts, as a share of the action box."""

SEEN: Final[dict[str, Any]] = {"image_size": 64, "cameras": ["third_view", "side_view"], "task": "push"}
"""What policies see of ManiSkill, and what they do there."""

KNOWN: Final = {**SEEN, "scenes": [0, 1, 2]}
"""Settings of the scenes in which everything is recorded."""

UNSEEN: Final = {**SEEN, "split": "ood"}
"""Settings of scenes that nothing is learnt from."""


@dataclass
class DemoConfig(RunConfig):
    """Make demonstrations and a policy in ManiSkill, and improve the policy by lerobot-wmrl-improve.

    A few demonstrations, and labelled rollouts of the policy cloned from them, are all that is learnt from.
    Beside the policies trained in imagination stands one that was trained further on the same successes,
    without a world model. All are compared in ManiSkill on the same held-out starts, in known and in unseen
    scenes, and in imagination, from frames of the dataset.

    Running the same command again continues after the last finished piece of work. `--preset=demo` (the
    default) takes about an hour on two cores, `--preset=tiny` a few minutes and shows only that
    everything runs; flags further right override the preset. The page to read is `report.html`.

    Args:
        output_dir: folder of everything the demo makes.
        seed: seed of recording, training and PPO. The evaluation seeds stay the same.
        size: size of every stage, `tiny` or `demo`.
        demonstrations: planned episodes with a human's pauses and detours that the first policy is cloned
            from.
        rollouts: noisy rollouts of that policy, labelled as successes and failures.
        eval_episodes: episodes behind each success rate, in ManiSkill from held-out starts.
    """

    output_dir: Path = Path("outputs/demo")
    seed: int = 0
    size: str = "demo"
    demonstrations: int = 8
    rollouts: int = 300
    eval_episodes: int = 100

    def validate(self) -> None:
        """Raise FieldError for a setting that cannot be."""
        require_choice(self, "size", [*presets_of("demo")])
        require_seed(self, EVALUATION_SEED // SEEDS_A_DEMO - 1)
        require_at_least(self, 1, "demonstrations", "eval_episodes")
        fewest, most = VALIDATION_EVERY - self.demonstrations, SEEDS_A_DEMO - ROLLOUT_SEED_OFFSET
        if not max(1, fewest) <= self.rollouts <= most:
            raise FieldError(
                "rollouts",
                self.rollouts,
                f"must be from {max(1, fewest)}, so that an episode is held out, "
                f"to {most}, the seeds there are",
            )


@dataclass(frozen=True)
class Demo:
    """The stages for one configuration. Paths are relative to where the demo runs."""

    config: DemoConfig

    def stages(self) -> list[Stage]:
        """List every stage in order."""
        return [
            Stage("demonstrations", "Record demonstrations in ManiSkill", self._demonstrations),
            Stage("cloned", "Clone a policy from them", self._cloned, fresh=self.out / "cloned"),
            Stage("improve", "Improve it", self._improve),
            Stage("text_world_model", "Train the text world model", self._text_world_model),
            Stage("replay", "Replay held-out episodes in both world models", self._replay),
            Stage("unseen", "Compare the policies in unseen scenes", self._unseen),
            Stage("imagined", "Compare the policies in imagination", self._imagined),
        ]

    def page(self) -> Page:
        """Return the report of the finished demo."""
        improvement = self.improvement()
        titles = [*improvement.policies]
        folders = {
            "in known scenes": self.improved / StageName.COMPARISON,
            "in unseen scenes": self.out / "unseen",
            "in imagination, from frames of the dataset": self.out / "imagined",
        }
        return Page(
            improvement,
            "Is the world model worth it?",
            self.config.seed,
            stage_records(self.out, self.stages()),
            [read_place(where, folder, titles) for where, folder in folders.items()],
            {"held out": self.out / "replay"},
            {
                "BC of the demonstrations": lerobot_train_curve(self.out / "logs" / "cloned.log"),
                "Text world model": curve(read_metrics(self.out / "text_world_model"), "loss"),
            },
        )

    @property
    def out(self) -> Path:
        return self.config.output_dir

    @property
    def improved(self) -> Path:
        """Folder of the improvement."""
        return self.out / "improve"

    @property
    def first_seed(self) -> int:
        return self.config.seed * SEEDS_A_DEMO

    def improvement(self) -> Progress:
        """Return what the stage `improve` does, once there is a policy to improve."""
        return Progress(
            Plan.of(
                ImproveConfig(
                    policy=read_policy_config(self._policy, []),
                    dataset=ChosenEpisodes(root=self._recorded),
                    real_env=WmrlManiSkillEnv(**KNOWN),
                    **self._given,
                )
            )
        )

    @property
    def _given(self) -> dict[str, Any]:
        """Settings of the improvement beside policy, dataset and environment. No episode in ManiSkill chooses
        anything: what is compared has learnt from the same episodes."""
        return {
            "rollouts": self.config.rollouts,
            "exploration": EXPLORATION,
            "size": self.config.size,
            "selection_episodes": 0,
            "eval_episodes": self.config.eval_episodes,
            "seed": self.first_seed,
            "output_dir": self.improved,
        }

    @property
    def _recorded(self) -> str:
        return str(self.out / "demonstrations")

    @property
    def _policy(self) -> str:
        return str(last_model(self.out / "cloned"))

    def _demonstrations(self) -> list[str]:
        return self._command(
            "lerobot-wmrl-record",
            {
                "kinds": "{human_like: 1}",
                "num_episodes": self.config.demonstrations,
                "video": False,
                **env_flags(WmrlManiSkillEnv(**KNOWN)),
                "seed": self.first_seed,
                "output_dir": self._recorded,
            },
        )

    def _cloned(self) -> list[str]:
        """Clone the policy `cnn` by LeRobot's own command."""
        settings = {
            **preset_settings(self.config.size, "sft"),
            "policy.type": "cnn",
            "policy.push_to_hub": False,
            "dataset.repo_id": "local/demonstrations",
            "dataset.root": self._recorded,
            "seed": self.first_seed,
        }
        return train_command(self.out / "cloned", settings)

    def _improve(self) -> list[str]:
        return program_call(
            "lerobot-wmrl-improve",
            {
                "policy.path": self._policy,
                "dataset.root": self._recorded,
                **env_flags(WmrlManiSkillEnv(**KNOWN), "real_env"),
                **self._given,
                "output_dir": str(self.improved),
            },
        )

    def _text_world_model(self) -> list[str]:
        return self._command(
            "lerobot-wmrl-train-world-model",
            {
                "model.type": "text_world_model",
                "model.tokenizer_path": str(self.improved / StageName.TOKENIZER),
                "dataset.root": str(self.improved / StageName.MERGED),
                "seed": self.first_seed,
                "output_dir": str(self.out / "text_world_model"),
            },
        )

    def _replay(self) -> list[str]:
        return self._command(
            "lerobot-wmrl-eval-world-model",
            {
                "model.path": str(self.improved / StageName.WORLD_MODEL),
                "split": "validation",
                "text_model.path": str(self.out / "text_world_model"),
                "dataset.root": str(self.improved / StageName.MERGED),
                "output_dir": str(self.out / "replay"),
            },
        )

    def _unseen(self) -> list[str]:
        env = env_flags(WmrlManiSkillEnv(**UNSEEN))
        return commands.compare_command(
            self.improvement(), self.out / "unseen", env, self.config.eval_episodes
        )

    def _imagined(self) -> list[str]:
        improvement = self.improvement()
        env = commands.imagination(improvement)
        return commands.compare_command(improvement, self.out / "imagined", env, self.config.eval_episodes)

    def _command(self, program: str, flags: Flags) -> list[str]:
        """Return a command of this package, at the demo's size."""
        return program_call(program, {"preset": self.config.size, **flags})


def conclusion(page: Page, path: Path) -> str:
    """Say in a few lines what the demo made, how good it is, and what comes next."""
    return "\n".join(
        [
            verdict(page.progress, page.places),
            "",
            f"The report: {path}",
            "Next: open it; it ends with every command, to change and run by hand. Drive the world model:",
            shlex.join(commands.drive_command(page.progress)),
        ]
    )

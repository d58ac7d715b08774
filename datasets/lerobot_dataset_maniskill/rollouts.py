"""A policy's rollouts in any environment but ManiSkill: in LeRobot's, and in world models."""

import json
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from tqdm import tqdm

from lerobot_dataset_maniskill.configuration import RecordConfig
from lerobot_wmrl.common.constants import POLICY
from lerobot_wmrl.common.errors import renamed
from lerobot_wmrl.common.files import write_json
from lerobot_wmrl.common.flags import flag_as_typed
from lerobot_wmrl.data.dataset import open_dataset
from lerobot_wmrl.data.episodes import read_episodes
from lerobot_wmrl.data.features import describe_alike
from lerobot_wmrl.data.ledger import spending
from lerobot_wmrl.envs.configuration_world_model import WorldModelEnv
from lerobot_wmrl.envs.rollout_recorder import RolloutRecorder

SETTINGS_FILE: Final = Path("meta/rollouts.json")
"""The settings that decide the episodes."""


class Rollouts:
    """The rollouts that a configuration asks for (`recorder.Source`). `content` are its settings."""

    def __init__(self, config: RecordConfig, content: dict[str, Any]) -> None:
        self.config, self.content = config, content
        last = config.seed + config.num_episodes
        firsts = range(config.seed, last, config.part_episodes)
        self.seeds = {
            f"part-{index:05d}": range(first, min(last, first + config.part_episodes))
            for index, first in enumerate(firsts)
        }

    @property
    def parts(self) -> dict[str, int]:
        return {name: len(seeds) for name, seeds in self.seeds.items()}

    @property
    def spent(self) -> Counter[str]:
        return Counter({spending(POLICY): self.config.num_episodes})

    def check(self) -> None:
        """Do nothing: the recorder says what does not fit together when it is made."""

    def record(self, work: Path, missing: Sequence[str]) -> None:
        """Record the missing parts one after the other."""
        config, total = self.config, self.config.num_episodes
        with renamed("dataset", "like"):
            like = config.like.open().meta if config.like.given else None
        assert config.policy is not None
        recorder = RolloutRecorder(
            config.env,
            config.policy,
            None,
            config.exploration,
            like,
            num_envs=min(config.part_episodes, total) if isinstance(config.env, WorldModelEnv) else 1,
            video=config.video,
            like_columns=config.like_columns,
            max_frames=config.max_frames,
        )
        won: list[bool] = []
        done = total - sum(self.parts[name] for name in missing)
        with closing(recorder), tqdm(total=total, initial=done, desc="record", unit="episode") as bar:

            def report(success: bool) -> None:
                won.append(success)
                bar.set_postfix(success=f"{sum(won) / len(won):.0%}", refresh=False)
                bar.update()

            for name, seeds in self.seeds.items():
                if name in missing:
                    recorder.record(work / name, seeds, report)
                else:
                    recorder.skip(seeds)

    def describe(self, merged: Path) -> str:
        """Describe the columns as `like` does, keep the settings, and say what was recorded."""
        if self.config.like.given and self.config.like_columns:
            with renamed("dataset", "like"):
                describe_alike(merged, self.config.like.open().features)
        write_json(merged / SETTINGS_FILE, self.content)
        root, table = self.config.root, read_episodes(open_dataset(merged))
        episodes, frames, fps = len(table.length), int(table.length.sum()), table.dataset.fps
        return (
            f"{root}: {episodes} episodes, {frames} frames ({frames / fps / 60:.1f} minutes)\n"
            f"successful: {int(table.success.sum())}/{episodes}\n"
            "next: lerobot-wmrl-train-world-model --model.type=frame_tokenizer "
            f"{flag_as_typed('dataset.root', root)} --output_dir=outputs/frame_tokenizer"
        )

    def settings(self, root: Path) -> dict[str, Any] | None:
        stored = root / SETTINGS_FILE
        return json.loads(stored.read_text()) if stored.is_file() else None

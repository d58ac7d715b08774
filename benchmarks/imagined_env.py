"""The world model as an environment, as flags of a benchmark name it."""

import argparse
from typing import Any

from lerobot_wmrl.envs.configuration_world_model import StartFrames, WorldModelEnv


def add_world_models(parser: argparse.ArgumentParser) -> None:
    """The flags that `world_model_env` reads."""
    parser.add_argument("--world_model", required=True, help="action world model")
    parser.add_argument("--text_world_model", required=True, help="text world model on the same tokens")
    parser.add_argument("--dataset.root", dest="root", required=True, help="start frames")


def world_model_env(given: argparse.Namespace, **settings: Any) -> WorldModelEnv:
    """Make the environment of the flags, with further settings."""
    return WorldModelEnv(
        world_model_path=given.world_model,
        text_world_model_path=given.text_world_model,
        dataset=StartFrames(root=given.root),
        **settings,
    )

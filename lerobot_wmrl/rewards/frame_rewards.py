"""What a trained reward model of LeRobot's gives for every row of a dataset."""

from typing import Final

import numpy as np
import torch
from lerobot.configs.rewards import RewardModelConfig
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.rewards.factory import make_reward_model
from tqdm import tqdm

from lerobot_wmrl.common.checkpoints import local_model_folder
from lerobot_wmrl.common.errors import FieldError, first_line, renamed
from lerobot_wmrl.data.dataset import VIDEO_BACKEND
from lerobot_wmrl.rewards.loading import load_preprocessor

BATCH: Final = 32
"""Frames that a reward model looks at together."""

FRAME_REWARD_TYPES: Final = ("reward_classifier", "proxy", "embedding")
"""Types of reward models that judge a frame without the episode around it."""


def frame_rewards(path: str, device: str | None, dataset: LeRobotDataset) -> np.ndarray:
    """Return what a reward model gives for every row. (N,)

    The model is shown what its configuration asks for, frames before and after included, as in lerobot-train.

    Args:
        path: its checkpoint, a folder or a hub id.
        device: where it runs; None for where the checkpoint says.
        dataset: the dataset.

    Raises:
        FieldError: there is no such model, or it does not fit the dataset.
    """
    config = read_reward_config(path, dataset)
    config.device = device or config.device
    shown = LeRobotDataset(
        dataset.repo_id,
        root=dataset.root,
        delta_timestamps=resolve_delta_timestamps(config, dataset.meta),
        video_backend=VIDEO_BACKEND,
    )
    with renamed("reward.pretrained_path", "path"):
        prepare = load_preprocessor(config)
    model = make_reward_model(config).eval()
    batches = torch.utils.data.DataLoader(shown, BATCH)
    with torch.no_grad():
        rewards = [
            model.compute_reward(prepare(batch)).float().cpu()
            for batch in tqdm(batches, "label", unit="batch")
        ]
    return torch.cat(rewards).numpy().reshape(-1)


def read_reward_config(path: str, dataset: LeRobotDataset) -> RewardModelConfig:
    """Read the configuration of a reward model that judges a dataset's frames.

    Raises:
        FieldError: there is no such model, or it does not fit the dataset.
    """
    try:
        folder = local_model_folder(path)
        config = RewardModelConfig.from_pretrained(folder)
    except Exception as error:  # a missing file, a type that nobody registered, or what the hub answers
        raise FieldError(
            "path",
            path,
            f"no reward model of LeRobot there ({first_line(error)})",
            "give the checkpoint of one, as lerobot-train --reward_model.type=… makes it",
        ) from error
    if config.type not in FRAME_REWARD_TYPES:
        raise FieldError(
            "path",
            path,
            f"a reward model of type {config.type} does not judge frames one by one",
            f"give one of type {', '.join(FRAME_REWARD_TYPES)}, or write its rewards into a column and set "
            "`success.type` to column",
        )
    config.pretrained_path = str(folder)
    missing = [name for name in config.input_features or () if name not in dataset.features]
    if missing:
        raise FieldError(
            "path",
            path,
            f"looks at {', '.join(missing)}, which {dataset.root} has not",
            "give a reward model that was trained on datasets like this",
        )
    return config

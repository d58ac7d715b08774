"""Loading trained models of this package, with errors that say what is wrong and what to do."""

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, overload

import torch
from draccus.utils import ParsingError
from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.factory import get_reward_model_class
from lerobot.utils.constants import ACTION, OBS_STATE
from safetensors import SafetensorError

from lerobot_wmrl.common.checkpoints import (
    UNPUBLISHED,
    given_revision,
    may_be_on_hub,
    model_folder,
    reading_weights,
)
from lerobot_wmrl.common.errors import FieldError, first_line
from lerobot_wmrl.data.checks import check_cameras, check_depth, check_widths
from lerobot_wmrl.data.embodiment import check_same_robot
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig, WorldModelConfig

if TYPE_CHECKING:
    from lerobot_wmrl.world_models.modeling_frame_tokenizer import FrameTokenizerRewardModel
    from lerobot_wmrl.world_models.modeling_world_model import (
        ActionWorldModelRewardModel,
        TextWorldModelRewardModel,
    )

FIELDS: Final = {
    "frame_tokenizer": "tokenizer_path",
    "action_world_model": "world_model_path",
    "text_world_model": "text_world_model_path",
}
"""Field that holds the path of a model of each type, where the caller does not say."""


@overload
def read_config(
    path: str | Path,
    expected_type: Literal["action_world_model"],
    device: str | None = "cpu",
    field: str | None = None,
) -> ActionWorldModelConfig: ...
@overload
def read_config(
    path: str | Path, expected_type: str, device: str | None = "cpu", field: str | None = None
) -> RewardModelConfig: ...
def read_config(
    path: str | Path, expected_type: str, device: str | None = "cpu", field: str | None = None
) -> RewardModelConfig:
    """Read the configuration of a checkpoint.

    Args:
        path: a training's output folder, one of its checkpoints, or a hub id.
        expected_type: the type that it must have.
        device: where the model goes; None for the best device there is.
        field: where the path was given, for errors.

    Raises:
        FieldError: there is none, or it is of another type or of an earlier version of this package.
    """
    field = field or FIELDS.get(expected_type, "reward.pretrained_path")
    folder = model_folder(path)
    if not (folder / "config.json").is_file():
        if folder.is_dir() or not may_be_on_hub(path) or "/" not in str(path):  # none is without an owner
            raise FieldError(
                field, path, f"no {expected_type} there", "give its training's output folder, or a hub id"
            )
    else:
        require_type(_stored_type(folder / "config.json"), expected_type, field, path)
    if device is None:
        accelerator = torch.accelerator.current_accelerator(check_available=True)
        device = accelerator.type if accelerator else "cpu"
    try:
        config = RewardModelConfig.from_pretrained(str(folder), cli_overrides=[f"--device={device}"])
    except FileNotFoundError as error:
        raise FieldError(
            field,
            path,
            f"no {expected_type} there, nor on the hub ({first_line(error)})",
            "give its training's output folder, or a hub id",
        ) from error
    except (ParsingError, TypeError, KeyError) as error:
        raise FieldError(
            field,
            path,
            f"its configuration is of an earlier version of this package ({first_line(error)})",
            "train the model again",
        ) from error
    require_type(config.type, expected_type, field, path)  # one of the hub
    return config


def require_type(actual: Any, expected: str, field: str, path: str | Path) -> None:
    """Raise FieldError unless the checkpoint at `path` is of the expected type."""
    if actual != expected:
        raise FieldError(
            field,
            path,
            f"is a checkpoint of type {actual!r}, but {expected!r} is needed here",
            "give the output folder of a training with that type",
        )


def config_to_continue(path: str, overrides: Sequence[str]) -> RewardModelConfig:
    """Read the settings of a trained model, `overrides` on top, to train it further. FieldError if none.

    It is not published where that model was, unless they say so.
    """
    folder = model_folder(path)
    revision = given_revision(overrides)
    try:
        RewardModelConfig.from_pretrained(str(folder), revision=revision)
    except Exception as error:  # draccus, the hub and json each raise their own
        raise FieldError(
            "model.path",
            path,
            f"no model can be loaded from it ({first_line(error)})",
            "give the output folder of a training with this version of the package, or a hub id",
        ) from error
    try:
        config = RewardModelConfig.from_pretrained(
            str(folder), revision=revision, cli_overrides=[*UNPUBLISHED, *overrides]
        )
    except SystemExit as error:  # of argparse, which has named them
        raise FieldError(
            "model.path",
            path,
            "its model has not all of the settings that are given beside it",
            "leave out those that the message above names",
        ) from error
    except (ParsingError, TypeError, KeyError) as error:
        raise FieldError(
            "model.path",
            path,
            f"cannot be trained further with {' '.join(overrides)} ({first_line(error)})",
            "give other settings of this kind of model alone, or train a new one with `model.type`",
        ) from error
    config.pretrained_path, config.pretrained_revision = str(folder), revision
    return config


def load_model_to_continue(config: RewardModelConfig, meta: Any) -> Any:
    """Load the model of `config.pretrained_path` with the settings of `config`, to train it on a dataset.

    Raises:
        ValueError: its weights cannot be read, or are of another structure than the settings.
    """
    try:
        model = get_reward_model_class(config.type).from_pretrained(
            config.pretrained_path,
            revision=config.pretrained_revision,
            config=config,
            strict=True,
            dataset_stats=meta.stats,
            dataset_meta=meta,
        )
    except torch.OutOfMemoryError:
        raise
    except SafetensorError as error:
        raise unreadable_weights(config.pretrained_path, error) from error
    except RuntimeError as error:
        raise FieldError(
            "model.path",
            config.pretrained_path,
            f"the weights do not fit the settings ({' '.join(str(error).split())})",
            "leave the sizes of layers as they are, or train a new model with `model.type`",
        ) from error
    return model.to(config.device)


def _stored_type(path: Path) -> Any:
    try:
        return json.loads(path.read_text()).get("type")
    except (json.JSONDecodeError, AttributeError) as error:
        raise ValueError(
            f"{path}: is truncated or no configuration ({error}); use an earlier checkpoint"
        ) from error


@overload
def load_model(
    path: str | Path,
    expected_type: Literal["frame_tokenizer"],
    device: str | None = "cpu",
    field: str | None = None,
) -> "FrameTokenizerRewardModel": ...
@overload
def load_model(
    path: str | Path,
    expected_type: Literal["action_world_model"],
    device: str | None = "cpu",
    field: str | None = None,
) -> "ActionWorldModelRewardModel": ...
@overload
def load_model(
    path: str | Path,
    expected_type: Literal["text_world_model"],
    device: str | None = "cpu",
    field: str | None = None,
) -> "TextWorldModelRewardModel": ...
@overload
def load_model(
    path: str | Path, expected_type: str, device: str | None = "cpu", field: str | None = None
) -> Any: ...
def load_model(
    path: str | Path, expected_type: str, device: str | None = "cpu", field: str | None = None
) -> Any:
    """Load a checkpoint in evaluation mode; arguments as of `read_config`.

    Its `config.pretrained_path` says where it lies.

    Raises:
        ValueError: not found, of another type or version, truncated, or with other tensors than its config.
    """
    config = read_config(path, expected_type, device, field)
    folder = model_folder(path)
    with reading_weights(partial(unreadable_weights, path)):
        model = get_reward_model_class(config.type).from_pretrained(str(folder), config=config, strict=True)
    model.config.pretrained_path = str(folder)
    return model


def unreadable_weights(path: object, error: Exception) -> ValueError:
    """Return the error for a checkpoint whose weights cannot be loaded."""
    return ValueError(
        f"{path}: model.safetensors cannot be read ({error}). It is truncated or of another version: "
        "use an earlier checkpoint or train again"
    )


def check_dataset(config: FrameTokenizerConfig | WorldModelConfig, meta: Any) -> None:
    """Raise ValueError unless a trained model can learn from, start in or replay a dataset's episodes.

    meta: the dataset's metadata, a LeRobotDatasetMetadata.
    """
    features = meta.features
    tokenizer_config = config.trained_tokenizer if isinstance(config, WorldModelConfig) else config.tokenizer
    check_cameras(meta, tokenizer_config.camera_keys)
    if isinstance(config, WorldModelConfig):
        if config.depth:
            check_depth(features, tokenizer_config.camera_keys)
        check_widths(meta, {OBS_STATE: config.state_size})
    if isinstance(config, ActionWorldModelConfig):
        check_widths(meta, {ACTION: config.action_size})
        check_same_robot(config.embodiment, meta)


def check_tokenizer_source(config: WorldModelConfig, untrained: bool) -> None:
    """Raise FieldError unless the model gets its tokenizer from exactly one place.

    untrained: whether the model begins to learn, rather than being loaded.
    """
    if config.tokenizer_path and config.pretrained_path:
        raise FieldError(
            "tokenizer_path",
            config.tokenizer_path,
            f"the world model at {config.pretrained_path} carries the tokenizer whose codes it has learnt",
            "leave one of the two out",
        )
    if config.tokenizer_path and config.tokenizer is not None:
        raise FieldError(
            "tokenizer",
            config.tokenizer,
            "is that of the checkpoint at `tokenizer_path`",
            "leave its settings out",
        )
    if not config.tokenizer_path and (untrained or config.tokenizer is None):
        raise FieldError(
            "tokenizer_path",
            config.tokenizer_path,
            "is missing",
            "give the output folder of a training with type=frame_tokenizer",
        )


def check_same_tokenizer(model: Any, other: Any, field: str, value: object) -> None:
    """Raise FieldError about `field`, which names the other world model, unless both have one tokenizer."""
    first, second = model.tokenizer.state_dict(), other.tokenizer.state_dict()
    if first.keys() != second.keys() or not all(torch.equal(first[name], second[name]) for name in first):
        raise FieldError(
            field,
            value,
            "was trained with another tokenizer than the action world model",
            "train both with the same `tokenizer_path`",
        )

"""What a tokenizer or a world model learns from: its episodes, and the clips that are drawn of them."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from lerobot.configs.rewards import RewardModelConfig
from lerobot.rewards.pretrained import PreTrainedRewardModel

from lerobot_wmrl.common.constants import HUMAN_LIKE, KINDS, START_KIND
from lerobot_wmrl.common.errors import FieldError, renamed
from lerobot_wmrl.data.checks import check_episode_lengths, require_shown, solved_from_the_start
from lerobot_wmrl.data.clips import ClipSampler, FrameSampler, InTurn
from lerobot_wmrl.data.dataset import TrainingData
from lerobot_wmrl.data.embodiment import read_embodiment
from lerobot_wmrl.data.episodes import EpisodeTable, count_tasks
from lerobot_wmrl.data.frame_cache import (
    FAR,
    cached_context,
    cached_depth,
    cached_features,
    cached_frames,
    cached_tokens,
)
from lerobot_wmrl.data.lazy_rows import LazyRows
from lerobot_wmrl.world_models.checkpoint import check_dataset
from lerobot_wmrl.world_models.configuration_frame_tokenizer import FrameTokenizerConfig
from lerobot_wmrl.world_models.configuration_world_model import ActionWorldModelConfig, TextWorldModelConfig
from lerobot_wmrl.world_models.text import instruction_problem

FAR_SHARE: Final = 0.05
"""Share of the depth that may be beyond `FAR` without a warning."""


def decide_on_instructions(config: RewardModelConfig, table: EpisodeTable, data: TrainingData) -> None:
    """Say in a new tokenizer's configuration whether success depends on the instruction, unless it says so.

    It does where the episodes that are learnt from are of several tasks, and all instructions can be read.

    Raises:
        FieldError: it is asked for, and an instruction cannot be read.
    """
    if not isinstance(config, FrameTokenizerConfig) or not config.tokenizer.success or config.pretrained_path:
        return
    asked = config.tokenizer.instructions
    tables = [table.subset(table.training(data.episodes))]
    tables += [each.subset(each.training(None)) for each in data.read_more()]
    reads = count_tasks(tables) > 1 if asked is None else asked
    tables.append(table.subset(table.among(data.episodes)))  # those that are held out will be read too
    problem = reads and instruction_problem(text for each in tables for text in each.instructions)
    if problem and asked:
        raise FieldError(
            "tokenizer.instructions",
            True,
            problem,
            "or set it to false: success then depends on pictures alone",
        )
    if problem:
        logging.warning("success is told without the instructions, one of which cannot be read: %s", problem)
    config.tokenizer = replace(config.tokenizer, instructions=reads and not problem)


def decide_on_range(config: RewardModelConfig, table: EpisodeTable, episodes: Sequence[int] | None) -> None:
    """Write the range of the actions into the configuration of a new world model, as the chosen episodes tell
    it: others may be left out because theirs are wrong."""
    if episodes is not None and isinstance(config, ActionWorldModelConfig) and not config.pretrained_path:
        config.embodiment = read_embodiment(table.dataset.meta, config.embodiment, episodes)


def require_golden(table: EpisodeTable, episodes: np.ndarray) -> np.ndarray:
    """Return the episodes (E,) that a text world model learns from. FieldError if there is none."""
    if episodes.any():
        return episodes
    raise FieldError(
        "dataset.root",
        table.dataset.root,
        "has no successful demonstration",
        "the text world model needs some: record them, or add labels (lerobot-wmrl-label)",
    )


def golden_episodes(table: EpisodeTable) -> np.ndarray:
    """Mark the episodes that the text world model learns from. (E,)

    They are successful demonstrations, or all successes of a dataset that does not say who acted.
    """
    kind = table.column(START_KIND)
    return table.success & np.isin(kind, (-1, KINDS.index("optimal"), KINDS.index(HUMAN_LIKE)))


def make_sampler(
    model: PreTrainedRewardModel,
    table: EpisodeTable,
    chosen: Sequence[int] | None,
    batch_size: int,
    seed: int,
    measured: bool = True,
) -> ClipSampler | FrameSampler:
    """Make the sampler of training batches for this kind of model.

    Args:
        model: a frame tokenizer or a world model.
        table: the dataset.
        chosen: indices of episodes to learn from, all by default; held-out episodes are left out.
        batch_size: frames (tokenizer) or clips (world models) a batch.
        seed: seed of the draws.
        measured: whether the model is measured on the held-out episodes after the training: those that cannot
            be read then are named now.

    Raises:
        FieldError: there is no episode to learn from, or one cannot be read.
    """
    episodes = table.training(chosen)
    if not episodes.any():
        raise FieldError(
            "dataset.root",
            table.dataset.root,
            "has no episode to train on",
            "record some first, or choose others with `dataset.episodes`: every twentieth is held out",
        )
    config: Any = model.config
    frames = cached_frames(table.dataset, config.tokenizer.camera_keys, config.tokenizer.image_size)
    read = table.among(chosen) if measured else episodes
    if isinstance(config, TextWorldModelConfig):
        golden = golden_episodes(table)
        episodes, read = require_golden(table, episodes & golden), read & golden
    frames.fill(table.row_numbers(read.nonzero()[0]))
    if isinstance(config, FrameTokenizerConfig):
        if config.tokenizer.success:
            require_success_labels(table, episodes)
        return FrameSampler(
            table, frames, episodes.nonzero()[0], config.tokenizer.cameras, batch_size, seed, config.device
        )
    check_episode_lengths(table.dataset.root, int(episodes.sum()), int(table.length[episodes].sum()))
    require_readable(model, table, read)
    warn_of_unlearnt_success(config, table, episodes.nonzero()[0])
    return make_clip_sampler(model, table, episodes.nonzero()[0], batch_size, seed)


def require_success_labels(table: EpisodeTable, episodes: np.ndarray) -> None:
    """Raise FieldError if a dataset has no labels of success, or no frame of these episodes, a mask (E,),
    shows the success that its labels tell of."""
    if not table.has_labels:
        raise FieldError(
            "tokenizer.success",
            True,
            f"{table.dataset.root} has neither next.success nor next.done, so its frames cannot be told "
            "apart",
            "label its episodes, or leave `tokenizer.success` out",
        )
    if table.success[episodes].any():
        require_shown(table, episodes.nonzero()[0])


def require_readable(model: Any, table: EpisodeTable, episodes: np.ndarray) -> None:
    """Raise ValueError if a world model cannot read the instruction or the depth of one of these episodes,
    a mask (E,)."""
    require_readable_instructions(model, table.subset(episodes))
    if model.config.depth:
        depth = cached_depth(table.dataset, model.config.tokenizer.camera_keys, model.tokenizer.grid)
        depth.fill(table.row_numbers(episodes.nonzero()[0]))


def require_readable_instructions(model: Any, table: EpisodeTable) -> None:
    """Raise FieldError if a world model reads the instructions of episodes, and cannot read one of them."""
    problem, remedy = "", "leave it out, or record other instructions"
    if isinstance(model.config, TextWorldModelConfig):
        try:
            model.text_encoder.check(table.instructions)
        except ValueError as error:
            problem = str(error)
    elif model.config.reads_instructions:
        problem = instruction_problem(table.instructions)
        remedy = "or train a tokenizer with `tokenizer.instructions`=false, and the world model on it"
    if problem:
        raise FieldError("dataset.root", table.dataset.root, problem, remedy)


def make_clip_sampler(
    model: Any, table: EpisodeTable, episodes: np.ndarray, batch_size: int, seed: int
) -> ClipSampler:
    """Make a sampler of clips from these episodes, with what else the model looks at or predicts."""
    config, tokenizer, dataset = model.config, model.tokenizer, table.dataset
    cameras, rows = config.tokenizer.camera_keys, table.row_numbers(episodes)
    depth = cached_depth(dataset, cameras, tokenizer.grid) if config.depth else None
    if depth is not None:
        depth.fill(rows)
        warn_of_far(depth, table, episodes)
    tokens = cached_tokens(dataset, cameras, tokenizer)
    tokens.fill(rows)
    context = cached_context(dataset, cameras, tokenizer) if config.context_channels else None
    if context is not None:
        context.fill(episodes)
    features = cached_features(dataset, cameras, tokenizer) if config.predicts_success else None
    if features is not None:
        features.fill(rows)
    return ClipSampler(
        table,
        tokens,
        episodes,
        config.clip_length,
        config.from_start,
        batch_size,
        seed,
        config.device,
        depth=depth,
        context=context,
        features=features,
    )


def warn_of_unlearnt_success(config: Any, table: EpisodeTable, episodes: np.ndarray) -> None:
    """Warn where a world model would not learn from these episodes what success is."""
    root, fps = table.dataset.root, table.dataset.fps
    if isinstance(config, ActionWorldModelConfig) and not table.has_labels:
        logging.warning(
            "dataset.root=%s: has neither next.success nor next.done: the model cannot learn from it what "
            "success is. Check it afterwards (lerobot-wmrl-eval-world-model)",
            root,
        )
    untold = config.predicts_success and not config.reads_instructions
    if untold and count_tasks([table.subset(episodes)]) > 1:
        logging.warning(
            "%s: has several tasks, and success is told without the instruction: what one task asks for "
            "counts in another too. A tokenizer with --model.tokenizer.instructions=true reads it",
            root,
        )
    longer, longest = table.length[episodes] > config.clip_length, int(table.length[episodes].max())
    if 2 * longer.sum() > len(episodes) and not config.context_channels:
        logging.warning(
            "%s: %d of %d episodes are longer than the clips that are learnt from, clip_length=%d frames "
            "(%.1f s): success is learnt up to there alone. --model.clip_length=%d holds the longest",
            root,
            longer.sum(),
            len(episodes),
            config.clip_length,
            config.clip_length / fps,
            longest,
        )


def warn_of_far(depth: LazyRows, table: EpisodeTable, episodes: np.ndarray) -> None:
    """Say so if much of the depth of these episodes is beyond `FAR`."""
    beyond = float(np.mean([(depth[rows] > FAR).mean() for rows in table.rows(episodes)]))
    if beyond > FAR_SHARE:
        logging.warning(
            "%s: %.0f %% of the depth is beyond %.1f m, and is learnt as if it were there",
            table.dataset.root,
            100 * beyond,
            FAR,
        )


def make_joint_sampler(
    model: PreTrainedRewardModel, table: EpisodeTable, data: TrainingData, batch_size: int, seed: int
) -> ClipSampler | FrameSampler | InTurn:
    """Make the sampler for the episodes of `data`, which are in `table`, and for its further datasets."""
    more = data.read_more()
    with renamed("dataset.root", "dataset.more"):
        for other in more:
            check_dataset(model.config, other.dataset.meta)
    if isinstance(model.config, ActionWorldModelConfig):
        note_outcomes(model.config, [(table, data.episodes), *((each, None) for each in more)])
    first = make_sampler(model, table, data.episodes, batch_size, seed)
    with renamed("dataset.root", "dataset.more"):
        samplers = [make_sampler(model, each, None, batch_size, seed, measured=False) for each in more]
    return InTurn(first, samplers) if samplers else first


def note_outcomes(
    config: ActionWorldModelConfig, sources: Iterable[tuple[EpisodeTable, Sequence[int] | None]]
) -> None:
    """Write into a world model's configuration how many successes and failures it learns from.

    A model that is trained further keeps what it has learnt from before, if that was more.
    """
    labelled = [(table, chosen) for table, chosen in sources if table.has_labels]
    learnt = [table.success[table.training(chosen)] for table, chosen in labelled]
    if not learnt and config.pretrained_path and config.learnt_successes is None:
        return  # what it has learnt before is not known
    for table, _ in labelled:
        if warning := solved_from_the_start(table):
            logging.warning("%s: %s", table.dataset.root, warning)
    successes, failures = config.learnt_successes or 0, config.learnt_failures or 0
    config.learnt_successes = max(successes, sum(int(each.sum()) for each in learnt))
    config.learnt_failures = max(failures, sum(int((~each).sum()) for each in learnt))
    if not config.learnt_successes:
        logging.warning(
            "no episode is known to succeed: the world model never rewards. RL in it needs labels "
            "(lerobot-wmrl-label) or a reward of another kind"
        )
    elif not config.learnt_failures:
        logging.warning(
            "no episode is known to fail: the world model has not seen how one does, and a policy will learn "
            "what it takes for success. No gate on such episodes can tell; record rollouts with failures"
        )

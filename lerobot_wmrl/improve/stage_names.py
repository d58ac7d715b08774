"""The stages of an improvement, by the names of their folders."""

from enum import StrEnum


class StageName(StrEnum):
    """Name of a stage, and of the folder that it fills."""

    COLUMNS = "columns"
    """The dataset without the columns that rollouts lack."""

    ROLLOUTS = "rollouts"
    """Rollouts of the policy."""

    MERGED = "merged"
    """The dataset and the rollouts."""

    CLONED = "cloned"
    """The policy, trained further on the successes."""

    TOKENIZER = "tokenizer"
    """The frame tokenizer."""

    WORLD_MODEL = "world_model"
    """The action world model."""

    CHECK = "check"
    """The world model, replayed on recorded episodes."""

    START = "start"
    """The comparison in imagination that decides which policy to improve."""

    RL = "rl"
    """The policy, trained in imagination."""

    DISTILLED = "distilled"
    """The policy, fitted to a planner in imagination."""

    CHOICE = "choice"
    """The comparison that decides which policy to use."""

    COMPARISON = "comparison"
    """The comparison of all policies that is reported."""

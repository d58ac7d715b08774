"""Schemas of Hugging Face's `datasets` in a time that grows with the number of columns, not with its square.

A LeRobotDataset of a dozen features has 173 columns about each episode, most of them statistics. `datasets`
(4.8) notes which columns have to be decoded, and looks at all of them again whenever one is set; opening a
dataset makes such a schema some forty times, column by column. Without that a dataset opens in a third of the
time, and thirty parts of a recording merge in half.
"""

from typing import Any

from datasets import Features
from datasets.features.features import require_decoding


def set_column(schema: Features, name: str, feature: Any) -> None:
    """Set one column, and note whether it has to be decoded: what `datasets` does, for this column alone."""
    dict.__setitem__(schema, name, feature)
    schema._column_requires_decoding[name] = require_decoding(feature)


def set_columns_one_by_one() -> None:
    """Have every schema of this process take its columns by `set_column`.

    A version of `datasets` that does it in another way than by looking at all columns keeps its own.
    """
    if hasattr(Features.__setitem__, "_decorator_name_"):
        Features.__setitem__ = set_column

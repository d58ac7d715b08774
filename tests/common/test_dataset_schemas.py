"""Schemas of `datasets` are the same as its own, and each column is looked at a fixed number of times."""

import pickle
from copy import deepcopy
from typing import Any

import pytest
from datasets import Features, Image, Value
from datasets.features import features as library

from lerobot_wmrl.common import dataset_schemas

COLUMNS = 50


def to_decode(schema: Features) -> dict[str, bool]:
    """What `datasets` would note of all columns."""
    return {name: library.require_decoding(feature) for name, feature in schema.items()}


def test_what_has_to_be_decoded_is_known_whatever_is_done_to_a_schema() -> None:
    schema = Features({"image": Image(), "old": [{"image": Image()}], "number": Value("int64")})
    assert (
        to_decode(schema) == schema._column_requires_decoding == {"image": True, "old": True, "number": False}
    )
    schema["number"], schema["image"] = Image(), Value("string")
    assert schema._column_requires_decoding == {"image": False, "old": True, "number": True}
    del schema["old"]
    schema.update(more=Image())
    for made in (schema, deepcopy(schema), schema.copy(), pickle.loads(pickle.dumps(schema))):
        assert made == schema
        assert to_decode(made) == made._column_requires_decoding
    changed = schema.copy()
    changed["image"] = Image()
    assert not schema._column_requires_decoding["image"], "a copy has notes of its own"


def test_a_schema_looks_at_each_column_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """When it is made, and when the column is set: a hundred times for fifty columns, not 2,550."""
    calls: list[Any] = []

    def counted(feature: Any, *args: Any) -> bool:
        calls.append(feature)
        return False

    for module in (library, dataset_schemas):
        monkeypatch.setattr(module, "require_decoding", counted)
    Features({str(column): Value("int64") for column in range(COLUMNS)})
    assert len(calls) == 2 * COLUMNS


def test_other_versions_of_datasets_keep_their_own_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Features, "__setitem__", dict.__setitem__)
    dataset_schemas.set_columns_one_by_one()
    assert Features.__setitem__ is dict.__setitem__

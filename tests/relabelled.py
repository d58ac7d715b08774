"""Datasets that say otherwise, or not at all, where success holds."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

UNLABELLED = {"next.success": None, "next.done": None}


def relabelled(source: Path, root: Path, columns: Mapping[str, list[bool] | None]) -> Path:
    """A copy at `root` with other truth values, (N,), in these columns; without those that are None."""
    shutil.copytree(source, root)
    path, info = next((root / "data").rglob("*.parquet")), root / "meta" / "info.json"
    table, described = pq.read_table(path), json.loads(info.read_text())
    for name, values in columns.items():
        kind = table.schema.field(name).type
        table = table.drop_columns(name)
        if values is None:
            del described["features"][name]
        else:
            table = table.append_column(name, pa.array(values, kind))
    pq.write_table(table, path)
    info.write_text(json.dumps(described))
    return root

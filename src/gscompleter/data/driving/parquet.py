"""Columns of parquet files, through pyarrow (`pip install 'gscompleter[waymo]'`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import check_file

ADVICE = "download it again"


def read_columns(
    path: Path, columns: Sequence[str], where: Mapping[str, object] | None = None
) -> dict[str, list[Any]]:
    """Read columns of a table, only rows where the columns of `where` have these values.

    Lists of numbers become arrays; null becomes None.
    """
    try:
        import pyarrow
        from pyarrow import dataset
    except ImportError as error:
        raise InputError(
            f"{quote_value(path)} is a parquet file, and pyarrow is not installed; run "
            "`pip install 'gscompleter[waymo]'`."
        ) from error
    check_file(path)
    try:
        table = dataset.dataset(path, format="parquet")
        _check_columns(path, [*columns, *(where or {})], table.schema.names)
        keep = None
        for column, value in (where or {}).items():
            same = dataset.field(column) == value
            keep = same if keep is None else keep & same
        found = table.to_table(list(columns), filter=keep, use_threads=False)
    except (pyarrow.ArrowException, OSError, UnicodeDecodeError) as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(
            f"{quote_value(path)} cannot be read ({quote_value(lines[0])}); {ADVICE}."
        ) from error
    return {column: [_to_plain(value) for value in found.column(column)] for column in columns}


def _check_columns(path: Path, needed: Sequence[str], there: Sequence[str]) -> None:
    for column in needed:
        if column not in there:
            raise InputError(f"{quote_value(path)} has no column {quote_value(column)}; {ADVICE}.")


def _to_plain(scalar: Any) -> Any:
    """Convert to a Python value, and a list of numbers to an array."""
    if not scalar.is_valid:
        return None
    values = getattr(scalar, "values", None)
    return scalar.as_py() if values is None else values.to_numpy(zero_copy_only=False)

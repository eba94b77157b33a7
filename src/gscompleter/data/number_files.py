"""Small text files of numbers: matrices of cameras, and trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.data.limits import MAX_NUMBER, require
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_bytes

MAX_NUMBERS_BYTES = 1 << 26
"""Largest such file, in bytes."""


def read_numbers(
    path: Path, shape: tuple[int | None, int], advice: str
) -> Float[np.ndarray, "n m"]:
    """Read a file of numbers, with spaces or line breaks between them, row by row.

    `shape` is the number of rows, or None for any, and of columns. Infinity and NaN are kept: they
    stand for a pose that is unknown. `advice` ends the sentences of errors.
    """
    return parse_numbers(read_bytes(path, MAX_NUMBERS_BYTES), quote_value(path), shape, advice)


def parse_numbers(
    text: bytes, title: str, shape: tuple[int | None, int], advice: str
) -> Float[np.ndarray, "n m"]:
    """Parse the numbers of a text, as `read_numbers` does; `title` names it in errors."""
    rows, columns = shape
    try:
        values = np.array(text.split(), dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{title} holds other text than numbers; {advice}.") from error
    require(values.size > 0, f"{title} is empty; {advice}.")
    has_shape = values.size % columns == 0 if rows is None else values.size == rows * columns
    wanted = f"rows of {columns}" if rows is None else f"{rows} × {columns}"
    require(
        has_shape,
        f"{title} holds {values.size:,} numbers, and {wanted} numbers are needed; {advice}.",
    )
    largest = np.abs(values[np.isfinite(values)]).max(initial=0.0)
    require(
        largest <= MAX_NUMBER,
        f"{title} holds a number of {largest:g}, and {MAX_NUMBER:g} is the largest; {advice}.",
    )
    return values.reshape(-1, columns)

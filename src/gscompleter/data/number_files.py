"""Small text files of numbers: matrices of cameras, and trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.data.limits import MAX_NUMBER, require
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_bytes

MAX_NUMBERS_BYTES = 1 << 26
"""Largest such file."""


def read_numbers(
    path: Path, shape: tuple[int | None, int], advice: str
) -> Float[np.ndarray, "n m"]:
    """Read a file of numbers between blanks, row by row; None stands for any number of rows.

    Infinity is kept: it stands for a pose that is unknown. `advice` ends the sentence of errors.
    """
    return parse_numbers(read_bytes(path, MAX_NUMBERS_BYTES), quote_value(path), shape, advice)


def parse_numbers(
    text: bytes, title: str, shape: tuple[int | None, int], advice: str
) -> Float[np.ndarray, "n m"]:
    """Parse numbers between blanks, as `read_numbers`; `title` names the text."""
    rows, columns = shape
    try:
        values = np.array(text.split(), dtype=np.float64)
        table = values.reshape(-1 if rows is None else rows, columns)
    except ValueError as error:
        wanted = f"rows of {columns}" if rows is None else f"{rows} × {columns}"
        raise InputError(f"{title} holds other text than {wanted} numbers; {advice}.") from error
    finite = table[np.isfinite(table)]
    require(
        table.size > 0 and (np.abs(finite) <= MAX_NUMBER).all(),
        f"{title} is empty, or holds a number above {MAX_NUMBER:g}; {advice}.",
    )
    return table

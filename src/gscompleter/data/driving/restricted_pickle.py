"""Pickles of plain values; nothing that a file names is imported or called.

A pickle is a program. Infos of data sets need only numbers, texts, lists, dictionaries and NumPy
scalars, which are built here from their bytes.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gscompleter.errors import InputError, quote_value, refuse_pointer
from gscompleter.io.reading import check_plain, read_bytes

MAX_BYTES = 1 << 30
"""Largest file in bytes."""
MAX_REPEATS = 4
"""Most values per byte of a file, as a bound on self-repetition."""
NUMBERS = frozenset(["b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"])


def load_plain(path: Path) -> Any:
    """Load the plain value in a pickle, with lists for tuples; refuses anything else."""
    refuse_pointer(path)
    data = read_bytes(path, MAX_BYTES)
    try:
        value = _Plain(io.BytesIO(data)).load()
    except Exception as error:  # damaged pickles raise anything
        raise InputError(
            f"{quote_value(path)} is no pickle of plain values ({type(error).__name__}: "
            f"{quote_value(str(error))}); write it again with lists and numbers only."
        ) from error
    check_plain(value, path, MAX_REPEATS * len(data))
    return value


class _Kind:
    """Stand-in for a NumPy dtype of a single number."""

    def __init__(self, code: str, *_: Any) -> None:
        if code not in NUMBERS:
            raise pickle.UnpicklingError(f"it holds NumPy values of the kind {quote_value(code)}")
        self.code, self.order = code, "="

    def build(self, data: bytes) -> bool | int | float:
        """Build the Python number of these bytes."""
        (value,) = np.frombuffer(data, np.dtype(self.order + self.code)).tolist()
        return value


CONSTRUCTORS: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy.core.multiarray", "scalar"): _Kind.build,
    ("numpy", "dtype"): _Kind,
    ("_codecs", "encode"): str.encode,
}
"""Constructors for the accepted names."""


# The unpickler in C allocates any size that a few bytes claim; the one in Python does not.
class _Plain(pickle._Unpickler):
    """Unpickler that knows three names, and makes lists of tuples.

    As keys of a dictionary, nested tuples would overflow the stack of the process.
    """

    def find_class(self, module: str, name: str) -> Callable[..., Any]:
        found = CONSTRUCTORS.get((module.replace("numpy._core", "numpy.core"), name))
        if found is None:
            raise pickle.UnpicklingError(f"it names {module}.{name}")
        return found


def _load_order(unpickler: Any) -> None:
    """Set the byte order of a kind of number, the second of the values on the stack."""
    order, kind = unpickler.stack.pop()[1], unpickler.stack[-1]
    if not isinstance(kind, _Kind) or order not in ("<", ">", "=", "|"):
        raise pickle.UnpicklingError("it changes an object")
    kind.order = order


def _make_list_loader(code: bytes) -> Callable[[Any], None]:
    load: Callable[[Any], None] = pickle._Unpickler.dispatch[code[0]]

    def load_list(unpickler: Any) -> None:
        load(unpickler)
        unpickler.stack[-1] = list(unpickler.stack[-1])

    return load_list


_TUPLES = (pickle.EMPTY_TUPLE, pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3)
_Plain.dispatch = {
    **pickle._Unpickler.dispatch,
    **{code[0]: _make_list_loader(code) for code in _TUPLES},
    pickle.BUILD[0]: _load_order,
}

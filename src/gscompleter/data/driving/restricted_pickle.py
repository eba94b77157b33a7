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
    """Load the plain value in a pickle; anything else raises an InputError."""
    refuse_pointer(path)
    try:
        data = read_bytes(path, MAX_BYTES)
        value = _Plain(io.BytesIO(data)).load()
        check_plain(value, path, MAX_REPEATS * len(data))
        return value
    except InputError:
        raise
    except Exception as error:  # damaged pickles raise anything
        raise InputError(
            f"{quote_value(path)} is no pickle of plain values ({type(error).__name__}: "
            f"{quote_value(str(error))}); write it again with lists and numbers only."
        ) from error


# The unpickler in C allocates any size that a few bytes claim; the one in Python does not.
class _Plain(pickle._Unpickler):
    """Unpickler that knows three names, and dictionaries with plain keys only.

    Hashing nested tuples overflows the stack of the process; sets would need it too.
    """

    def find_class(self, module: str, name: str) -> Callable[..., Any]:
        found = CONSTRUCTORS.get((module.replace("numpy._core", "numpy.core"), name))
        if found is None:
            raise pickle.UnpicklingError(f"it names {module}.{name}")
        return found

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("it refers to external objects")


class _Kind:
    """Stand-in for a NumPy dtype of a single number."""

    def __init__(self, code: str, align: bool = False, copy: bool = False) -> None:
        if code not in NUMBERS:
            raise pickle.UnpicklingError(f"it holds NumPy values of the kind {quote_value(code)}")
        self.code, self.order = code, "="

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = state[1] if state[1] in ("<", ">", "=") else "="

    def build(self, data: bytes) -> bool | int | float:
        """Build the Python number of these bytes."""
        (value,) = np.frombuffer(data, np.dtype(self.order + self.code)).tolist()
        return value


def _encode(text: str, encoding: str) -> bytes:
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"it uses the encoding {quote_value(encoding)}")
    return text.encode("latin1")


CONSTRUCTORS: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy.core.multiarray", "scalar"): _Kind.build,
    ("numpy", "dtype"): _Kind,
    ("_codecs", "encode"): _encode,
}
"""Constructors for the accepted names."""


def _guard(code: bytes, part: slice, *types: type) -> Callable[[Any], None]:
    """Run an instruction only if a part of the unpickler's stack has these types."""
    load: Callable[[Any], None] = pickle._Unpickler.dispatch[code[0]]

    def load_guarded(unpickler: Any) -> None:
        if not all(isinstance(value, types) for value in unpickler.stack[part]):
            raise pickle.UnpicklingError("it holds a key or an object that is not plain")
        load(unpickler)

    return load_guarded


_KEYS = (str, int, float, type(None))
_Plain.dispatch = {
    **pickle._Unpickler.dispatch,
    pickle.SETITEM[0]: _guard(pickle.SETITEM, slice(-2, -1), *_KEYS),
    pickle.SETITEMS[0]: _guard(pickle.SETITEMS, slice(None, None, 2), *_KEYS),
    pickle.DICT[0]: _guard(pickle.DICT, slice(None, None, 2), *_KEYS),
    pickle.BUILD[0]: _guard(pickle.BUILD, slice(-2, -1), _Kind),
}
for _code in (pickle.EMPTY_SET, pickle.ADDITEMS, pickle.FROZENSET):
    del _Plain.dispatch[_code[0]]

"""Numbers that lie in mapped files, so that memory holds only those that are read at the moment.

The system keeps pages that were read, as memory of the process, until these are released.
"""

from __future__ import annotations

import ctypes
import math
import mmap
import os
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from gscompleter.system.errors import OutputError, quote_value
from gscompleter.system.files.writing import convert_write_errors

OPEN_FILES = "/proc/self/fd"
"""Folder of Linux in which open files have names, also those that have none elsewhere."""
MAPPED_BLOCK = 8192
"""Rows that are read or written at a time, before their pages are released."""
_FOLDERS: dict[int, Path] = {}
"""Folder of the file of mapped values, or what it lies beside, by their address.

Entries of values that are gone stay: they are small, and the next values there replace them.
"""


def move_to_file(values: Tensor, beside: Path) -> Tensor:
    """Copy values to a temporary file in or beside a folder, and return them mapped from there.

    The file has no name, so that nothing is left of it once nobody holds the values, or after a
    kill. Linux with /proc only: elsewhere, and from a GPU, values are returned as they are. Raises
    OutputError, as on a full disk, which names `beside`.
    """
    can_map = sys.platform == "linux" and os.path.isdir(OPEN_FILES)
    if not can_map or values.device.type != "cpu" or values.numel() == 0:
        return values
    return _map_blocks([values], tuple(values.shape), values.dtype, beside)


def file_beside(values: Tensor, mapped: Tensor) -> Tensor:
    """Copy values to a temporary file beside that of others, if these are mapped.

    Otherwise values are returned as they are. Raises OutputError as `move_to_file`.
    """
    return move_to_file(values, _find_folder(mapped)) if is_mapped(mapped) else values


def file_array_beside(values: np.ndarray, mapped: Tensor) -> np.ndarray:
    """Copy values to a temporary file beside that of others, and return them mapped from there.

    Values that are mapped already stay where they are. Raises OutputError as `move_to_file`.
    """
    owner = _find_owner(values)
    if isinstance(owner, Tensor) and is_mapped(owner):
        return values
    filed: np.ndarray = move_to_file(torch.from_numpy(values), _find_folder(mapped)).numpy()
    return filed


def change_rows(values: Tensor, rows: Int64[Tensor, "m"], changed: Tensor) -> Tensor:
    """Return values with other rows; of a mapped file, in another file beside the same folder.

    `rows` ascend, and `changed` is what stands there. Raises OutputError as `move_to_file`.
    """
    if not is_mapped(values):
        return values.index_copy(0, rows, changed)

    def make_blocks() -> Iterator[Tensor]:
        starts = range(0, len(values), MAPPED_BLOCK)
        # Of the sorted rows, those from one bound to the next lie in a block.
        bounds = torch.searchsorted(rows, torch.tensor([*starts, len(values)])).tolist()
        for start, (first, last) in zip(starts, pairwise(bounds), strict=True):
            stored = values[start : start + MAPPED_BLOCK]
            block = stored.clone()
            block[rows[first:last] - start] = changed[first:last]
            release_pages(stored)
            yield block

    return _map_blocks(make_blocks(), tuple(values.shape), values.dtype, _find_folder(values))


def join_rows(parts: Sequence[Tensor]) -> Tensor:
    """Concatenate rows; with those of a mapped file, in another file beside the same folder.

    Raises OutputError as `move_to_file`.
    """
    first = next((part for part in parts if is_mapped(part)), None)
    if first is None:
        return torch.cat([*parts])

    def make_blocks() -> Iterator[Tensor]:
        for part in parts:
            for block in part.split(MAPPED_BLOCK):
                yield block.to(first.dtype)
                release_pages(block)

    shape = (sum(map(len, parts)), *first.shape[1:])
    return _map_blocks(make_blocks(), shape, first.dtype, _find_folder(first))


def _find_folder(mapped: Tensor) -> Path:
    """Find what the file of mapped values lies beside."""
    return _FOLDERS[mapped.untyped_storage().data_ptr()]


def _map_blocks(
    blocks: Iterable[Tensor], shape: tuple[int, ...], dtype: torch.dtype, beside: Path
) -> Tensor:
    """Write blocks of rows to a temporary file, and map it.

    Raises OutputError as `move_to_file`.
    """
    folder = next(each for each in (beside, *beside.absolute().parents) if each.is_dir())
    with (
        convert_write_errors(beside),
        tempfile.TemporaryFile(dir=folder) as file,
    ):
        # Written, and not stored through the map: there a full disk would end the process.
        for block in blocks:
            file.write(block.contiguous().numpy().data)
        file.flush()
        name = f"{OPEN_FILES}/{file.fileno()}"
        try:
            mapped = torch.from_file(name, shared=True, size=math.prod(shape), dtype=dtype)
        except RuntimeError as error:  # torch has no OSError for what the system refuses
            reason = str(error).partition(": ")[2] or str(error)
            raise OutputError(
                f"Files beside {quote_value(beside)} cannot be mapped into memory "
                f"({quote_value(reason)}); choose a place on another disk."
            ) from error
    _FOLDERS[mapped.data_ptr()] = beside
    return mapped.view(shape)


def select_rows(values: Tensor, rows: Int64[Tensor, "m"]) -> Tensor:
    """Select rows; of a mapped file, pages are read in their order and released behind.

    At least half as many rows as a mapped file has go to another one beside the same folder. Raises
    OutputError as `move_to_file`.
    """
    if not is_mapped(values) or len(rows) == 0:
        # It copies rows as they are, in a quarter of the time of `values[rows]`.
        return values.index_select(0, rows)
    if 2 * len(rows) >= len(values):
        shape = (len(rows), *values.shape[1:])
        return _map_blocks(_read_rows(values, rows), shape, values.dtype, _find_folder(values))
    selected = values.new_empty((len(rows), *values.shape[1:]))
    in_order, order = rows.sort()
    blocks = zip(_read_rows(values, in_order), order.split(MAPPED_BLOCK), strict=True)
    for block, places in blocks:
        selected.index_copy_(0, places, block)
    return selected


def _read_rows(values: Tensor, rows: Int64[Tensor, "m"]) -> Iterator[Tensor]:
    """Read rows of a mapped file block by block, and release their pages."""
    for part in rows.split(MAPPED_BLOCK):
        yield values.index_select(0, part)
        release_pages(values[part.amin() : part.amax() + 1])


def find_changed_rows(before: Tensor, after: Tensor) -> Bool[Tensor, "n"]:
    """Mark the rows in which two arrays differ; of mapped files, pages are released behind."""
    if not is_mapped(before) and not is_mapped(after):
        return (before != after).flatten(1).any(dim=1)
    parts = []
    blocks = zip(before.split(MAPPED_BLOCK), after.split(MAPPED_BLOCK), strict=True)
    for one, other in blocks:
        parts.append((one != other).flatten(1).any(dim=1))
        release_pages(one)
        release_pages(other)
    return torch.cat(parts)


def is_mapped(values: Tensor) -> bool:
    """Return True for values that `move_to_file` mapped, or a part of them.

    Not for those of other mapped files: what was changed in a private map would be lost with its
    page.
    """
    if values.device.type != "cpu":
        return False
    name = values.untyped_storage().filename
    return name is not None and name.startswith(f"{OPEN_FILES}/")


def release_pages(rows: np.ndarray | Tensor) -> None:
    """Release the memory of consecutive rows of a mapped file; they are read again if needed.

    Rows that are not mapped, or on a system without this advice to its kernel, stay as they are. An
    array over `mmap.mmap` must be read-only, as those of a .ply are: changes would be lost.
    """
    if isinstance(rows, Tensor):
        if not is_mapped(rows):
            return
        rows = rows.detach().numpy()
    owner = _find_owner(rows)
    if not hasattr(mmap, "MADV_DONTNEED") or rows.size == 0:
        return
    # The advice is about whole pages, of which the first and the last one have other rows, too.
    if isinstance(owner, mmap.mmap):
        first = rows.ctypes.data - np.frombuffer(owner, np.uint8).ctypes.data
        begin = first - first % mmap.PAGESIZE
        owner.madvise(mmap.MADV_DONTNEED, begin, first + rows.nbytes - begin)
    elif isinstance(owner, Tensor) and is_mapped(owner):
        # torch maps whole files, from a page on, and has no advice of its own.
        begin = rows.ctypes.data - rows.ctypes.data % mmap.PAGESIZE
        size = rows.ctypes.data + rows.nbytes - begin
        ctypes.CDLL(None).madvise(ctypes.c_void_p(begin), ctypes.c_size_t(size), mmap.MADV_DONTNEED)


def _find_owner(values: np.ndarray) -> Any:
    """Find the object that holds the memory of an array: a file that is mapped, tensor or array."""
    owner: Any = values
    while isinstance(owner, np.ndarray) and owner.base is not None:
        owner = owner.base
    return owner.obj if isinstance(owner, memoryview) else owner

"""Compiled loops (numba) on plain arrays, independent of the types of the package.

Kernels work on a range (begin, end) of elements, write to their own outputs and release the
interpreter lock. Results do not depend on how ranges are split among threads. Fast mathematics is
limited to `contract`: reordered sums (`reassoc`) would round differently in the process that
compiles a kernel and in those that load it from the cache.
"""

from contextlib import suppress
from pathlib import Path

from gscompleter.numerics.kernels.cache import CACHE


def _remove_stale_indices():
    """Remove cache indices that are older than any kernel's source.

    numba itself notices edits of a kernel's own file, but not of those that it inlines.
    """
    if CACHE.folder is None:
        return
    newest = max(source.stat().st_mtime for source in Path(__file__).parent.glob("*.py"))
    for index in CACHE.folder.glob("*.nbi"):
        with suppress(OSError):  # another process may be removing it
            if index.stat().st_mtime < newest:
                index.unlink()


_remove_stale_indices()

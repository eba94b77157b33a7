"""Compiled loops (numba) on plain arrays, independent of the types of the package.

Kernels work on a range (begin, end) of elements, write to their own outputs and release the
interpreter lock. Results do not depend on how ranges are split among threads. Fast mathematics is
limited to `contract`: reordered sums (`reassoc`) would round differently in the process that
compiles a kernel and in those that load it from the cache.
"""

import os
from pathlib import Path


def _remove_stale_indices():
    """Remove cache indices that are older than any kernel's source.

    numba itself notices edits of a kernel's own file, but not of those that it inlines.
    """
    here = Path(__file__).parent
    newest = max(source.stat().st_mtime for source in here.glob("*.py"))
    caches = Path(os.environ.get("NUMBA_CACHE_DIR", here)).glob("kernels_*")
    for folder in (here / "__pycache__", *caches):
        for index in folder.glob("*.nbi"):
            if index.stat().st_mtime < newest:
                index.unlink(missing_ok=True)


_remove_stale_indices()

"""Compiled loops (numba) on plain arrays, independent of the types of the package.

The cache notices edits of one file only, so each file holds all that its kernels inline. Fast
mathematics is limited to `contract`: reordered sums (`reassoc`) would round differently in the
process that compiles a kernel and in those that load it from the cache.
"""

import os
from contextlib import contextmanager
from pathlib import Path

from numba.np import linalg


@contextmanager
def _skip_blas_check():
    """Skip numba's search for BLAS, which imports SciPy: a third of its load time."""
    ensure_blas = getattr(linalg, "ensure_blas", None)

    def refuse():
        raise ImportError("BLAS is not needed")

    if ensure_blas is not None:
        linalg.ensure_blas = refuse
    try:
        yield
    finally:
        if ensure_blas is not None:
            linalg.ensure_blas = ensure_blas


def _remove_stale_indices():
    """Remove cache indices older than their source, or without one.

    They would be compiled again in any case, but numba fails to read one that names a type that
    the source no longer has.
    """
    here = Path(__file__).parent
    folders = [
        here / "__pycache__",
        *Path(os.environ.get("NUMBA_CACHE_DIR", here)).glob("kernels_*"),
    ]
    indices = [index for folder in folders for index in folder.glob("*.nbi")]
    for index in indices:
        source = here / f"{index.name.split('.')[0]}.py"
        if not source.is_file() or source.stat().st_mtime > index.stat().st_mtime:
            index.unlink(missing_ok=True)


_remove_stale_indices()

with _skip_blas_check():
    import numba.np.arraymath  # noqa: F401

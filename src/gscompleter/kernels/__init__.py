"""Compiled loops (numba) on plain arrays, independent of the types of the package.

The cache notices edits of one file only, so each file holds all that its kernels inline. Fast
mathematics is limited to `contract`: reordered sums (`reassoc`) would round differently in the
process that compiles a kernel and in those that load it from the cache.
"""

from contextlib import contextmanager

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


with _skip_blas_check():
    import numba.np.arraymath  # noqa: F401

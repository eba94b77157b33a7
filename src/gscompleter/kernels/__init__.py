"""Compiled loops (numba) on plain arrays. They know nothing of the types of the package.

Each file holds its kernels together with the helpers they inline: the compilation cache notices
edits of the file itself only.

Of the liberties of fast mathematics they take one, `contract`. Were sums free to be reordered
(`reassoc`), a kernel that runs in parallel would round otherwise in the process that compiles it
than in those that find it in the cache, and the same command would not give the same bytes. On the
CPUs tried, that freedom saved no time.
"""

from contextlib import contextmanager

from numba.np import linalg


@contextmanager
def _without_blas():
    """To learn whether there is BLAS, numba imports SciPy's linear algebra before its first kernel:
    a third of the time that it takes to load.

    No kernel of ours asks for BLAS, and those of others find it all the same, since they import it
    as they are compiled. Where numba goes about it otherwise, nothing changes.
    """
    asked = getattr(linalg, "ensure_blas", None)

    def refuse():
        raise ImportError("there is nothing to be found out")

    if asked is not None:
        linalg.ensure_blas = refuse
    try:
        yield
    finally:
        if asked is not None:
            linalg.ensure_blas = asked


with _without_blas():
    import numba.np.arraymath  # noqa: F401

"""A disk that is full, for this process."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def limit_file_size(most: int) -> Iterator[None]:
    """Let no file of this process grow beyond some bytes, as on a full disk; not for Windows."""
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

"""Errors by which Python, the system and libraries say that the memory ran out."""

from __future__ import annotations

import errno
from collections.abc import Iterator

MEMORY_WORDS = (
    "can't start new thread",
    "can't allocate memory",
    "cannot allocate memory",
    "out of memory",
    "unable to allocate",
    "failed to allocate",
    "failed to map segment",
    "insufficient memory",
    "_alloc_failed",  # of CUBLAS_STATUS_ALLOC_FAILED and others
)
"""Words of the messages by which libraries say that memory ran out, in small letters.

Threads need memory, too: of a limit of the address space (`ulimit -v`) each takes its stack.
"""
GPU_WORDS = ("cuda error", "cuda out of", "cublas_", "cudnn_", "hip error", "mps backend")
"""Words by which such a message tells that the memory is that of a GPU, in small letters. A library
called libcuda.so may lack that of the CPU."""


def list_causes(error: BaseException) -> Iterator[BaseException]:
    """List an error and its causes: libraries wrap the error of the system in their own."""
    # A chain of causes may lead back to its beginning.
    seen: set[int] = set()
    cause: BaseException | None = error
    while cause is not None and id(cause) not in seen:
        yield cause
        seen.add(id(cause))
        cause = cause.__cause__ or cause.__context__


def is_lack_of_memory(error: BaseException) -> bool:
    """Return True if an error, without its causes, says that memory ran out, of whatever kind."""
    number = getattr(error, "errno", None)
    if _has_gpu_type(error) or isinstance(error, MemoryError) or number == errno.ENOMEM:
        return True
    # torch and numba raise RuntimeError for a lack of memory, so their words are read, too. An
    # error of the system tells by its number what it is, and its text has names of the user's
    # files, in which any words may be.
    text = str(error).lower()
    return number is None and any(words in text for words in MEMORY_WORDS)


def is_of_gpu(error: BaseException) -> bool:
    """Return True if the memory that an error of `is_lack_of_memory` lacks is that of a GPU."""
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return False
    return _has_gpu_type(error) or any(words in str(error).lower() for words in GPU_WORDS)


def _has_gpu_type(error: BaseException) -> bool:
    # torch has its own error for the memory of a GPU; torch is not imported to name it.
    return type(error).__name__ == "OutOfMemoryError"

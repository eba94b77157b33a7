"""Settings of the whole process that make a command faster or smaller, each with its gain.

The command line applies them. As a library the package leaves its process alone, but for
`use_one_arena`, which `limit_threads` calls.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

ARENA_MAX = -8
"""Parameter of glibc's `mallopt`: the number of arenas from which threads allocate."""
MMAP_THRESHOLD = -3
"""Parameter of glibc's `mallopt`: the bytes from which on an array gets pages of its own."""
OWN_PAGES_BYTES = 4 * 2**20
"""Bytes of arrays that grow with a large scene, and that most images do not reach."""


def let_idle_threads_sleep() -> None:
    """Let waiting threads of torch sleep instead of spin; call it before torch is imported.

    Gain: none on an idle machine; a busy one, where they take cores from others, is up to ten times
    faster.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def skip_last_collection() -> None:
    """Let Python end without collecting garbage once more; gain: 1 s, most of it in torch."""
    atexit.register(gc.freeze)


@contextmanager
def import_without_collection() -> Iterator[None]:
    """Collect no garbage while modules are imported in the block, nor what they leave, later.

    Imports make no garbage, but enough objects to start searches for it. Gain: 0.25 s in the block,
    and 0.2 s at each later search through all of torch.
    """
    gc.disable()
    try:
        yield
        gc.freeze()
    finally:
        gc.enable()


def use_one_arena() -> None:
    """Let all threads allocate from one arena (glibc), as each keeps free memory of its own.

    Gain: a completion of forty photographs peaks at 1.9 instead of 2.9 GB (with large scenes frozen
    in parts); no time is lost, since threads allocate seldom.
    """
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt"):
        ctypes.CDLL(None).mallopt(ARENA_MAX, 1)


def give_large_arrays_own_pages() -> None:
    """Let large arrays go back to the system as soon as they are freed (glibc).

    glibc raises its threshold to 32 MB as such arrays are freed, and then keeps what lies between
    others. For scenes of a million Gaussians; pages that are new each time cost small ones time.

    Gain: 0.4 of 3.4 GB for four million Gaussians and eight photographs.
    """
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt"):
        ctypes.CDLL(None).mallopt(MMAP_THRESHOLD, OWN_PAGES_BYTES)


def release_free_memory() -> None:
    """Give memory that is free back to the system (glibc), where much was freed.

    Gain: 0.8 GB of 3.3 before the report on forty photographs of a splat, in 0.03 s.
    """
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "malloc_trim"):
        ctypes.CDLL(None).malloc_trim(0)

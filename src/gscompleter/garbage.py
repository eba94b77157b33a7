"""What stays to the end is not searched for garbage."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def staying() -> Iterator[None]:
    """Whatever lives when this ends stays, as imported modules and compiled kernels do.

    None of it is searched: neither while it comes, nor later, nor by the process as it ends, if
    that is left in such a block. Searching torch alone takes 0.2 s each time.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if enabled:
            gc.enable()

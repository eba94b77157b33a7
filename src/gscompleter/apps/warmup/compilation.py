"""Compilation of all kernels in advance, in two processes.

numba compiles one kernel at a time in a process. Every command imports this module, so it imports
slow packages only where it needs them.
"""

from __future__ import annotations

import gc
import subprocess
import sys
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager

from gscompleter.cpu_threads import get_thread_count

SPLAT_PART = "brought"
"""Part that only input splats need."""
RENDERING_PARTS = "cpu", SPLAT_PART
"""Parts that one process compiles while another compiles the rest."""
PARTS = *RENDERING_PARTS, "warp-inpaint", "plane-sweep"
"""All parts with kernels, in the order of compilation."""

REHEARSAL_PROGRAM = """
import sys
from gscompleter.apps.warmup.compilation import freeze_objects
with freeze_objects():
    from gscompleter.apps.warmup.rehearsal import rehearse
    for part in sys.argv[1:]:
        rehearse(part)
"""
"""Program of the second process. numba compiles a tenth faster in the block."""

COMPILING_STAGE = "compiling kernels for this machine, once"


@contextmanager
def freeze_objects() -> Iterator[None]:
    """Exclude all objects that exist after the block from garbage collection.

    Such objects are imported modules and compiled kernels. Each search of torch alone takes 0.2 s.
    Inside the block nothing is collected.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if enabled:
            gc.enable()


def compile_kernels(names: Collection[str]) -> float | None:
    """Compile the missing kernels of these parts; return the seconds, or None if there are none."""
    from gscompleter.kernels.compiled import is_compiled
    from gscompleter.progress import stage

    missing = [name for name in PARTS if name in names and not is_compiled(name)]
    if not missing:
        return None
    here, apart = split_parts(missing)
    start = time.perf_counter()
    with (
        stage(COMPILING_STAGE),
        rehearse_in_subprocess(apart),
        freeze_objects(),
    ):
        from gscompleter.apps.warmup.rehearsal import rehearse

        for name in here:
            rehearse(name)
    return time.perf_counter() - start


def split_parts(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split the parts between this process and another, if there are several threads."""
    rendering = [name for name in names if name in RENDERING_PARTS]
    if not rendering or get_thread_count() == 1:
        return [*names], []
    return rendering, [name for name in names if name not in RENDERING_PARTS]


@contextmanager
def rehearse_in_subprocess(names: Sequence[str]) -> Iterator[None]:
    """Compile parts in another process during the block, and wait for its end."""
    if not names:
        yield
        return
    command = [sys.executable, "-c", REHEARSAL_PROGRAM, *names]
    # A session of its own ignores Ctrl-C; this process stops it.
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
    try:
        yield
        if process.wait() != 0:
            raise subprocess.CalledProcessError(process.returncode, process.args)
    finally:
        process.kill()
        process.wait()

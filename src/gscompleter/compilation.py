"""Kernels compiled once for a machine, before a completion meets them one after the other.

numba compiles one kernel at a time in a process. Two processes share the parts that have some:
this one, and one that is begun before torch is imported here. Every command reads this file, so
that it imports what takes long only where it needs it.
"""

from __future__ import annotations

import atexit
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from gscompleter.garbage import staying
from gscompleter.threads import threads

BROUGHT = "brought"
"""The part that only scenes need that are brought."""
DRAWING = "cpu", BROUGHT
"""Parts that one process rehearses while another has the rest, which takes about as long."""
MODELS = "warp-inpaint", "plane-sweep"
"""The rest. Its models draw, too, and find what drawing compiled."""
PARTS = *DRAWING, *MODELS
"""All parts that have kernels, in the order in which they are rehearsed."""

APART = """
import sys
from gscompleter.garbage import staying
with staying():
    from gscompleter.rehearsal import rehearse
    for part in sys.argv[1:]:
        rehearse(part)
"""
"""What a process runs that rehearses parts; numba compiles a tenth faster in it."""

COMPILING = "compiling kernels for this machine, once"
"""What it is called while it goes on."""
SECONDS = 30
"""About what all of them take together on one core."""

Process = subprocess.Popen[bytes]
_begun: dict[str, Process] = {}
"""The process that rehearses each part that was begun ahead, until it is waited for."""


def begin(names: Iterable[str]) -> None:
    """Begin to compile, in another process, what the models of these names need and lack.

    It is to go on while torch is imported here; `compile_kernels` waits for it. It ends with this
    process, if not before.
    """
    wanted = [part for part in MODELS if part in names]
    if not wanted or threads() == 1:
        return
    from gscompleter.kernels.compiled import is_compiled

    lacking = [part for part in wanted if part not in _begun and not is_compiled(part)]
    if lacking:
        process = begun_apart(lacking)
        atexit.register(stopped, process)
        _begun.update(dict.fromkeys(lacking, process))


def compile_kernels(names: Sequence[str]) -> float | None:
    """Compile what the parts of these names need, where it is not there yet.

    Returns:
        The seconds that it took, or None where nothing was to be done.

    Raises:
        subprocess.CalledProcessError: where a process fails; it has said why.
    """
    from gscompleter.kernels.compiled import is_compiled
    from gscompleter.progress import expecting, stage

    missing = [name for name in PARTS if name in names and not is_compiled(name)]
    if not missing:
        return None
    own, apart = shares_of(missing, threads())
    expected = SECONDS * len(missing) / len(PARTS) / (2 if own and apart else 1)
    start = time.perf_counter()
    with expecting([(COMPILING, expected)]), stage(COMPILING), rehearsed_apart(apart), staying():
        from gscompleter.rehearsal import rehearse

        for name in own:
            rehearse(name)
    return time.perf_counter() - start


def shares_of(names: Sequence[str], count: int) -> tuple[list[str], list[str]]:
    """What this process rehearses, and what another does where there are as many as `count`."""
    own = [name for name in names if name in DRAWING]
    rest = [name for name in names if name in MODELS]
    if any(name in _begun for name in rest) or (own and count > 1):
        return own, rest
    return [*own, *rest], []


@contextmanager
def rehearsed_apart(names: Sequence[str]) -> Iterator[None]:
    """Rehearse parts in another process meanwhile; those that are begun there are waited for."""
    new = [name for name in names if name not in _begun]
    processes = {_begun.pop(name) for name in names if name in _begun}
    if new:
        processes.add(begun_apart(new))
    try:
        yield
        for process in processes:
            if process.wait() != 0:
                raise subprocess.CalledProcessError(process.returncode, process.args)
    finally:
        for process in processes:
            stopped(process)


def begun_apart(names: Sequence[str]) -> Process:
    """A process that rehearses parts. It stands aside of Ctrl-C, for this one stops it."""
    command = [sys.executable, "-c", APART, *names]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)


def stopped(process: Process) -> None:
    """Whatever it does, it is over when this returns."""
    process.kill()
    process.wait()

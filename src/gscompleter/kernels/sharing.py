"""Kernels on several threads: each call works on a range of its elements, and writes only there.

They are threads of our own and not those of numba: its OpenMP layer spins where cores are scarce
and meddles with torch's, its other layer does not bear two callers at once, and a kernel that it
makes parallel takes two to five times as long to compile.
"""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from itertools import pairwise

import numba

PIECES_PER_THREAD = 4
"""Pieces take unequally long; more of them than threads even that out."""


class _Thread(threading.local):
    """What is known of the thread that asks."""

    alone = False
    """Whether the kernels that it calls are not shared."""


_thread = _Thread()


def _stay_alone():
    _thread.alone = True


def sharing(threads):
    """How many threads share a kernel that is called here, and is to have so many."""
    return 1 if _thread.alone else threads or numba.config.NUMBA_NUM_THREADS


def share(kernel, count, *arguments, threads=None):
    """Run `kernel(begin, end, *arguments)` over range(count), a piece at a time.

    The result depends neither on the pieces nor on the threads, which are NUMBA_NUM_THREADS if left
    out: as many as there are usable cores where that is not set.
    """
    threads = sharing(threads)
    run(kernel, [(*piece, *arguments) for piece in pieces_of(count, threads)], threads)


def pieces_of(count, threads):
    """range(count) cut into pieces that `threads` take in turns."""
    return ranges(count, threads * PIECES_PER_THREAD if threads > 1 else 1)


def run(kernel, calls, threads=None):
    """What a kernel, which releases the interpreter lock, returns of each of `calls`.

    Who asks works, too, and does not wait for threads that others keep busy.
    """
    threads = sharing(threads)
    if threads == 1 or len(calls) == 1:
        return [kernel(*arguments) for arguments in calls]
    results, waiting = [None] * len(calls), iter(enumerate(calls))

    def work():
        for number, arguments in waiting:
            results[number] = kernel(*arguments)

    pool = thread_pool(threads - 1, os.getpid())
    helpers = [pool.submit(work) for _ in range(min(threads, len(calls)) - 1)]
    try:
        work()
    finally:
        for helper in helpers:
            if not helper.cancel():
                helper.result()
    return results


def side_by_side(function, *arguments):
    """What `function` makes of each of the arguments, like `map`, several at a time.

    It may call kernels itself: the threads that it runs on are not those that share them.
    """
    threads = numba.config.NUMBA_NUM_THREADS
    if threads == 1:
        return list(map(function, *arguments))
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, *arguments))


def many_at_once(function, *arguments):
    """The same one after the other, for many that are small: the kernels that `function` calls stay
    on its thread, where they need not wait for each other."""
    threads = numba.config.NUMBA_NUM_THREADS
    if threads == 1:
        yield from map(function, *arguments)
        return
    with ThreadPoolExecutor(threads, initializer=_stay_alone) as pool:
        yield from pool.map(function, *arguments)


@contextmanager
def meanwhile(function, *arguments):
    """Let `function` work on a thread of its own beside what goes on inside, which gets a function
    that waits for its result; on one thread it works only then.

    It may call kernels itself. What goes on inside does not end before it does.
    """
    if numba.config.NUMBA_NUM_THREADS == 1:
        yield lambda: function(*arguments)
        return
    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(function, *arguments).result


def ranges(count, pieces):
    """range(count) cut into at most `pieces` contiguous pieces of about equal length."""
    pieces = max(1, min(pieces, count))
    bounds = [count * piece // pieces for piece in range(pieces + 1)]
    return list(pairwise(bounds))


@lru_cache(maxsize=8)
def thread_pool(threads, process):
    """Threads that wait for work. A forked process inherits none and asks for its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix="gscompleter")

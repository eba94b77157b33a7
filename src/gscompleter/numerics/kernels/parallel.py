"""Kernels on several threads: each call works on a range of elements and writes only there.

All functions here may be called from any thread, and kernels of Numba release the interpreter's
lock. Numba's own threads are not used: they spin on few cores, interfere with torch's or support
one caller only, and its parallel kernels take two to five times as long to compile.
"""

import os
import threading
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from itertools import pairwise

import numba

PIECES_PER_THREAD = 4
"""Number of pieces per thread, which balances pieces of different cost."""

_thread = threading.local()
"""Has the attribute `is_alone` on threads of `map_small_tasks`, whose kernels use no others."""


def count_threads(threads):
    """Return how many threads a kernel called here uses: `threads`, or all if None; 1 if alone."""
    return 1 if hasattr(_thread, "is_alone") else threads or numba.config.NUMBA_NUM_THREADS


def share(kernel, count, *arguments, threads=None):
    """Run `kernel(begin, end, *arguments)` over range(count) on several threads.

    The kernel writes its results into `arguments`. `threads` defaults to NUMBA_NUM_THREADS, which
    `--threads` sets; the result does not depend on it. Raises as `run_calls`.
    """
    threads = count_threads(threads)
    pieces = split_range(count, threads * PIECES_PER_THREAD if threads > 1 else 1)
    run_calls(kernel, [(*piece, *arguments) for piece in pieces], threads)


def run_calls(kernel, calls, threads=None):
    """Run a kernel for each of `calls`, on this thread and idle ones, and return the results.

    If a call raises, none begins after it. Its error is raised when no call runs any more, so that
    nothing is written behind the back of whoever handles it.
    """
    threads = count_threads(threads)
    if threads == 1 or len(calls) <= 1:
        return [kernel(*arguments) for arguments in calls]
    results = [None] * len(calls)
    # All threads take their next call from this one iterator. `next` of enumerate is a single step
    # under the interpreter's lock, so that no call is taken twice.
    waiting = enumerate(calls)

    def work():
        try:
            for number, arguments in waiting:
                results[number] = kernel(*arguments)
        except BaseException:
            deque(waiting, maxlen=0)  # takes what is left, so that nobody else does
            raise

    pool = get_thread_pool(threads - 1, os.getpid())
    helpers = [pool.submit(work) for _ in range(min(threads, len(calls)) - 1)]
    try:
        work()
    finally:
        # This thread has done what was left, so a helper that did not start is not waited for: the
        # pool may be busy with callers that wait for helpers themselves.
        errors = [helper.exception() for helper in helpers if not helper.cancel()]
    for error in errors:
        if error is not None:
            raise error
    return results


def map_in_parallel(function, *arguments):
    """Map `function`, which may call kernels, over the arguments on several threads of its own.

    The pool of the kernels would be full of tasks that wait for kernels.
    """
    with ThreadPoolExecutor(numba.config.NUMBA_NUM_THREADS) as pool:
        return list(pool.map(function, *arguments))


def map_small_tasks(function, *arguments):
    """Map `function` over small tasks, each with its kernels on a single thread; yield in order.

    `arguments` are sequences of equal length. Fewer tasks than threads run one after the other,
    with their kernels on all threads.
    """
    threads = numba.config.NUMBA_NUM_THREADS
    if threads == 1 or len(arguments[0]) < threads:
        yield from map(function, *arguments)
        return
    alone = {"initializer": setattr, "initargs": (_thread, "is_alone", True)}
    with ThreadPoolExecutor(threads, **alone) as pool:
        yield from pool.map(function, *arguments)


@contextmanager
def run_in_background(function, *arguments):
    """Run `function`, which may call kernels, on a thread beside the `with` block.

    The block gets a function that waits for the result, to be called once. With one thread,
    `function` runs only then.
    """
    if numba.config.NUMBA_NUM_THREADS == 1:
        yield lambda: function(*arguments)
        return
    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(function, *arguments).result


def split_range(count, pieces):
    """Split range(count) into at most `pieces` ranges (begin, end) of about equal length.

    Of an empty range there is one piece, which is empty.
    """
    pieces = max(1, min(pieces, count))
    bounds = [count * piece // pieces for piece in range(pieces + 1)]
    return list(pairwise(bounds))


@lru_cache(maxsize=8)
def get_thread_pool(threads, process):
    """Return the thread pool of the process with that ID: threads do not survive a fork."""
    return ThreadPoolExecutor(threads, thread_name_prefix="gscompleter")

"""Threads of all libraries; the result does not depend on their number."""

import hashlib
import os
import subprocess
import sys
import threading
import time

import numba
import pytest
import torch

from gscompleter.numerics.kernels.parallel import (
    get_thread_pool,
    map_small_tasks,
    run_calls,
    run_in_background,
    share,
)
from gscompleter.system import threads as cpu_threads
from scenes import camera_at, photographed

COUNTS = """
import sys
from gscompleter.system.threads import limit_threads
limit_threads(int(sys.argv[1]) if sys.argv[1:] else None)
import cv2, numba, torch
print(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS, cv2.getNumThreads())
"""


def counted(*arguments: str, **told: str) -> list[int]:
    """Count the threads of torch, numba and OpenCV in a process with only these variables."""
    environment = {
        k: v for k, v in os.environ.items() if k not in cpu_threads.THREAD_VARIABLES
    } | told
    command = [sys.executable, "-c", COUNTS, *arguments]
    life = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return [int(word) for word in life.stdout.split()]


@pytest.mark.slow
def test_every_library_takes_as_many_as_it_is_told():
    assert counted("1") == [1, 1, 1]
    assert counted("3")[1:] == [3, 3]  # torch takes no more than there are cores


ARENAS = """
import ctypes, threading
from gscompleter.system.threads import limit_threads
limit_threads(2)
library = ctypes.CDLL(None)
library.malloc.restype = library.fdopen.restype = ctypes.c_void_p
held = [threading.Thread(target=library.malloc, args=(10_000,)) for _ in range(4)]
[thread.start() for thread in held]
[thread.join() for thread in held]
stdout = ctypes.c_void_p(library.fdopen(1, b"w"))
library.malloc_info(0, stdout)
library.fflush(stdout)
"""


@pytest.mark.linux
def test_all_threads_allocate_from_one_arena():
    command = [sys.executable, "-c", ARENAS]
    life = subprocess.run(command, capture_output=True, text=True, check=True)
    assert life.stdout.count("<heap nr=") == 1


LARGE_ARRAYS = """
import sys
import numpy as np
from gscompleter.system.process import give_large_arrays_own_pages

def measure():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096

if sys.argv[1] == "own":
    give_large_arrays_own_pages()
np.ones(3 * 2**20)  # 24 MB, after which glibc lets smaller arrays share its heap
arrays = [np.ones(2**20) for _ in range(16)]
before = measure()
del arrays[:-1]  # the last one ends the heap
print(before - measure())
"""


@pytest.mark.linux
def test_large_arrays_go_back_to_the_system_when_they_are_freed():
    returned = []
    for pages in ("own", "shared"):
        command = [sys.executable, "-c", LARGE_ARRAYS, pages]
        life = subprocess.run(command, capture_output=True, text=True, check=True)
        returned.append(int(life.stdout))
    own, shared = returned
    assert own > 15 * 8 * 2**20 * 0.9 > shared


@pytest.mark.slow
def test_what_the_environment_says_gives_way_to_what_is_told_and_to_nothing_else():
    cores = cpu_threads.count_available_cores()
    assert counted() == [cores, cores, cores]
    assert counted(OPENCV_FOR_THREADS_NUM="3") == [cores, cores, 3]
    assert counted("1", OPENCV_FOR_THREADS_NUM="3") == [1, 1, 1]


@pytest.mark.parametrize(
    ("said", "cores"), [("150000 100000", 1.5), ("max 100000", float("inf")), ("", float("inf"))]
)
def test_a_container_is_granted_a_share_of_the_cores(tmp_path, said, cores):
    quota = tmp_path / "cpu.max"
    quota.write_text(said)
    assert cpu_threads.read_quota(quota) == cores
    assert cpu_threads.read_quota(tmp_path / "missing") == float("inf")


def test_torch_has_its_threads_back_after_it_had_one():
    before = torch.get_num_threads()
    with pytest.raises(KeyError), cpu_threads.use_one_torch_thread():
        assert torch.get_num_threads() == 1
        raise KeyError
    assert torch.get_num_threads() == before


def test_a_share_of_a_core_is_one_thread(tmp_path, monkeypatch):
    quota = tmp_path / "cpu.max"
    quota.write_text("20000 100000")
    monkeypatch.setattr(cpu_threads, "QUOTA_FILE", quota)
    assert cpu_threads.count_available_cores() == 1


# `test_render.py` and `test_recolor.py` compare one thread with several.
@pytest.mark.slow
def test_the_bytes_of_a_completion_do_not_depend_on_the_threads(tmp_path):
    cameras = [camera_at(x, yaw=yaw, size=64) for x, yaw in ((-0.3, 0), (0.1, 0), (0.7, 12))]
    scene = photographed(tmp_path / "room", cameras)
    found = set()
    for count in ("1", "2"):
        out = tmp_path / count
        words = ["complete", scene, "--context", "0", "1", "--target", "2", "--out", out, "--quiet"]
        main = "from gscompleter.cli import main; main()"
        command = [sys.executable, "-c", main, *map(str, words), "--threads", count]
        subprocess.run(command, check=True)
        found.add(hashlib.sha256((out / "completed.ply").read_bytes()).hexdigest())
        assert (out / "generated.ply").stat().st_size > 2000
    assert len(found) == 1


@pytest.mark.parametrize("count", [1, 2])
def test_meanwhile_something_else_is_made(monkeypatch, count):
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", count)
    with run_in_background(sorted, [2, 1]) as found:
        assert found() == [1, 2]


@pytest.mark.parametrize("count", [1, 2])
def test_what_fails_meanwhile_fails_for_who_asks(monkeypatch, count):
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", count)
    with pytest.raises(ZeroDivisionError), run_in_background(divmod, 1, 0) as found:
        found()


@pytest.mark.parametrize("count", [1, 2])
def test_many_are_made_at_once_each_on_a_thread_of_its_own(monkeypatch, count):
    """Kernels run in the calling thread there, not on threads that share the work."""
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", count)

    def threads_of(_number: int) -> tuple[int, set[int]]:
        found: list[int] = []
        share(lambda _begin, _end: found.append(threading.get_ident()), 8)
        return threading.get_ident(), set(found)

    for own, used in map_small_tasks(threads_of, range(20)):
        assert used == {own}


def test_many_at_once_come_in_their_order_and_fail_for_who_asks():
    assert list(map_small_tasks(lambda a, b: a - b, [5, 6, 7], [1, 2, 3])) == [4, 4, 4]
    with pytest.raises(ZeroDivisionError):
        list(map_small_tasks(divmod, [1, 2], [1, 0]))


def test_who_asks_works_where_others_keep_the_threads_busy(monkeypatch):
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 2)
    done = threading.Event()
    busy = get_thread_pool(1, os.getpid()).submit(done.wait, 60)
    try:
        assert run_calls(divmod, [(number, 3) for number in range(7)]) == [
            divmod(n, 3) for n in range(7)
        ]
        with pytest.raises(ZeroDivisionError):
            run_calls(divmod, [(1, 1), (1, 0), (2, 1)])
        assert not busy.done()
    finally:
        done.set()


def test_an_error_of_one_thread_comes_when_the_others_have_ended():
    """What goes on would write into arrays that the caller has given up."""
    own = threading.get_ident()
    # Which of the two helpers fails is chance, and an error of the second one waits for the first.
    for _ in range(6):
        together = threading.Barrier(3, timeout=60)
        failing = threading.Lock()
        ended = []

        def call(number: int, together=together, failing=failing, ended=ended) -> None:
            together.wait()
            if threading.get_ident() != own:
                if failing.acquire(blocking=False):
                    raise ZeroDivisionError
                time.sleep(0.1)
            ended.append(number)

        with pytest.raises(ZeroDivisionError):
            run_calls(call, [(number,) for number in range(3)], threads=3)
        assert len(ended) == 2


def test_after_an_error_no_call_begins():
    begun = []

    def call(number: int) -> None:
        begun.append(number)
        if number == 0:
            raise ZeroDivisionError
        # Long enough for the first call to fail.
        time.sleep(0.2)

    with pytest.raises(ZeroDivisionError):
        run_calls(call, [(number,) for number in range(20)], threads=2)
    assert len(begun) <= 2


def test_pieces_are_taken_by_all_threads_and_come_in_their_order(monkeypatch):
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 3)
    together = threading.Barrier(3, timeout=60)

    def piece(number):
        together.wait()  # Nobody gets on before three are here.
        return number, threading.get_ident()

    found = run_calls(piece, [(number,) for number in range(6)])
    assert [number for number, _ in found] == list(range(6))
    assert len({thread for _, thread in found}) == 3

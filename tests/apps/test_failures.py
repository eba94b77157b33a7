"""Failures of the machine are sentences."""

import errno
import os

import pytest
import torch

from gscompleter.apps.command_line.exit_codes import ERROR, WRONG_INPUT
from gscompleter.apps.command_line.failures import explain_failure


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError(), "The memory ran out"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "The memory ran out"),
        (RuntimeError("libcudart.so: failed to map segment from shared object"), "memory ran out"),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"), "of the GPU"),
        (RuntimeError("CUDA error: out of memory"), "of the GPU"),
        (
            RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED"),
            "of the GPU",
        ),
        (RuntimeError("cuDNN error: CUDNN_STATUS_ALLOC_FAILED"), "of the GPU"),
        (RuntimeError("MPS backend out of memory (MPS allocated: 9 GB)"), "of the GPU"),
    ],
)
def test_a_lack_of_memory_says_which_and_what_to_lower(error, words):
    failure = explain_failure(error)
    assert failure is not None
    assert words in failure.sentence
    assert "--resolution" in failure.sentence
    assert failure.code == ERROR


def test_a_full_gpu_is_found_among_the_causes():
    try:
        try:
            raise torch.OutOfMemoryError("CUDA out of memory")
        except torch.OutOfMemoryError as error:
            raise RuntimeError("the generator failed") from error
    except RuntimeError as error:
        failure = explain_failure(error)
    assert failure is not None
    assert "--network-device cpu" in failure.sentence


def make_system_error(number: int, name: str | None = None) -> OSError:
    """Make the error of the system with this number, about a file with this name or without one."""
    words = (number, os.strerror(number))
    return OSError(*words) if name is None else OSError(*words, name)


@pytest.mark.parametrize(
    ("error", "words", "code"),
    [
        # Words of memory in the name of a file say nothing.
        (make_system_error(errno.EACCES, "out of memory.ply"), "cannot be used", WRONG_INPUT),
        (make_system_error(errno.ENAMETOOLONG, "x" * 300), "is no path", WRONG_INPUT),
        (make_system_error(errno.ENOMEM, "x.ply"), "The memory ran out", ERROR),
        (make_system_error(errno.ENOSPC, "x.ply"), "x.ply cannot be written", ERROR),
        (make_system_error(errno.ENOSPC), "A file or the standard output cannot be written", ERROR),
        (make_system_error(errno.EIO, "x.ply"), "check the disk", ERROR),
        (make_system_error(errno.EMFILE, "x.ply"), "limit of open files", ERROR),
    ],
)
def test_an_error_of_the_system_is_told_by_its_number(error, words, code):
    failure = explain_failure(error)
    assert failure is not None
    assert words in failure.sentence
    assert failure.code == code


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("an index is wrong"),
        make_system_error(errno.ENOENT, "out of memory.ply"),
        make_system_error(errno.ETIMEDOUT),
    ],
)
def test_a_defect_has_no_sentence(error):
    assert explain_failure(error) is None


def test_a_chain_of_causes_that_leads_back_ends():
    first, second = RuntimeError("first"), RuntimeError("second")
    first.__cause__, second.__cause__ = second, first
    assert explain_failure(first) is None

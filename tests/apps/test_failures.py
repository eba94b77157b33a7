"""Failures of the machine are sentences."""

import pytest
import torch

from gscompleter.apps.command_line.exit_codes import ERROR
from gscompleter.apps.command_line.failures import explain_failure


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError(), "The memory ran out"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "The memory ran out"),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"), "of the GPU"),
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


def test_a_defect_has_no_sentence():
    assert explain_failure(RuntimeError("an index is wrong")) is None

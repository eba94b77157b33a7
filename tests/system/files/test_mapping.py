"""Numbers in a mapped file take memory only while they are read."""

import os
from pathlib import Path

import pytest
import torch

from full_disk import limit_file_size
from gscompleter.system.errors import FullDiskError, OutputError
from gscompleter.system.files.mapping import (
    change_rows,
    file_array_beside,
    find_changed_rows,
    is_mapped,
    join_rows,
    move_to_file,
    release_pages,
    select_rows,
)

pytestmark = pytest.mark.linux

ROWS = 40_000
"""Rows of 48 floats: 7.7 MB, many pages."""


def make_values() -> torch.Tensor:
    return torch.arange(ROWS * 48, dtype=torch.float32).reshape(ROWS, 16, 3)


def read_resident(values: torch.Tensor) -> int:
    """Read how many bytes of mapped values are in memory, from the list of all maps."""
    begin = f"{values.data_ptr():x}-"
    lines = iter(Path("/proc/self/smaps").read_text().splitlines())
    assert any(line.startswith(begin) for line in lines)
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("Rss:"))


def test_values_in_a_file_are_the_same_and_leave_no_file(tmp_path):
    values = make_values()
    mapped = move_to_file(values, tmp_path / "out")
    assert is_mapped(mapped)
    assert not is_mapped(values)
    assert mapped.shape == values.shape
    assert torch.equal(mapped, values)
    assert os.listdir(tmp_path) == []


def test_pages_leave_the_memory_and_are_read_again(tmp_path):
    values = make_values()
    mapped = move_to_file(values, tmp_path)
    assert read_resident(mapped) < 0.1 * values.nbytes
    assert torch.equal(mapped, values)
    assert read_resident(mapped) > 0.9 * values.nbytes
    # Also of an array that is a part of them, as kernels get it.
    release_pages(mapped.flatten(1).numpy()[: ROWS // 2])
    assert 0.4 * values.nbytes < read_resident(mapped) < 0.6 * values.nbytes
    release_pages(mapped)
    assert read_resident(mapped) < 0.1 * values.nbytes
    assert torch.equal(mapped, values)


def test_rows_are_changed_and_compared_without_the_file_in_memory(tmp_path):
    values = make_values()
    mapped = move_to_file(values, tmp_path)
    rows = torch.tensor([0, 7, 8191, 8192, ROWS - 1])
    changed = values[rows] + 1
    other, plain = change_rows(mapped, rows, changed), change_rows(values, rows, changed)
    assert is_mapped(other)
    assert not is_mapped(plain)
    for each in (mapped, other):
        assert read_resident(each) < 0.1 * values.nbytes
    for before, after in ((mapped, other), (other, values), (values, plain)):
        assert torch.equal(find_changed_rows(before, after).nonzero()[:, 0], rows)
    assert read_resident(other) < 0.1 * values.nbytes
    assert torch.equal(other, plain)
    assert torch.equal(mapped, make_values())
    assert is_mapped(change_rows(other, rows[:0], changed[:0]))
    assert os.listdir(tmp_path) == []


def test_rows_are_joined_to_those_of_a_file_in_a_file(tmp_path):
    values = make_values()
    mapped = move_to_file(values, tmp_path)
    joined = join_rows([values[:3], mapped, values[:0], values[5:9]])
    assert is_mapped(joined)
    for each in (mapped, joined):
        assert read_resident(each) < 0.1 * values.nbytes
    assert torch.equal(joined, torch.cat([values[:3], values, values[5:9]]))
    assert not is_mapped(join_rows([values, values[:3]]))


def test_arrays_move_beside_values_of_a_file_once(tmp_path):
    mapped = move_to_file(make_values(), tmp_path)
    array = make_values().numpy()
    moved = file_array_beside(array, mapped)
    assert (moved == array).all()
    release_pages(moved)
    assert read_resident(torch.from_numpy(moved)) < 0.1 * array.nbytes
    assert (moved == array).all()
    assert file_array_beside(moved, mapped) is moved


def test_numbers_in_memory_stay():
    """Released, they would become zeros."""
    values = make_values()
    release_pages(values)
    release_pages(values.numpy()[100:])
    assert torch.equal(values, make_values())


def test_changes_of_a_file_that_somebody_else_mapped_stay(tmp_path):
    """As those of `torch.load(mmap=True)`: with their page they would go back to the file's."""
    path = tmp_path / "values"
    path.write_bytes(bytes(4 * 10_000))
    values = torch.from_file(str(path), shared=False, size=10_000, dtype=torch.float32)
    values += 1
    assert not is_mapped(values)
    release_pages(values)
    release_pages(values.numpy())
    assert (values == 1).all()


@pytest.mark.parametrize("count", [0, 5, ROWS, 3 * ROWS])
def test_rows_are_selected_in_any_order_with_few_pages(tmp_path, count):
    values = make_values()
    mapped = move_to_file(values, tmp_path)
    rows = torch.randint(ROWS, (count,), generator=torch.Generator().manual_seed(0))
    selected = select_rows(mapped, rows)
    assert torch.equal(selected, values[rows])
    # A large selection would take as much memory as the file saves.
    assert is_mapped(selected) == (2 * count >= ROWS)
    # The system reads some pages around each one.
    assert read_resident(mapped) < 0.2 * values.nbytes


def test_a_disk_whose_files_cannot_be_mapped_is_one_sentence(tmp_path, monkeypatch):
    """Some network and shared folders; there is none to test with, so that torch stands in."""

    def refuse(*_, **__):
        raise RuntimeError(
            "unable to mmap 24 bytes from file </proc/self/fd/3>: No such device (19)"
        )

    monkeypatch.setattr(torch, "from_file", refuse)
    with pytest.raises(OutputError, match="cannot be mapped .*No such device.*; choose") as error:
        move_to_file(make_values(), tmp_path / "out")
    assert str(tmp_path / "out") in str(error.value)


def test_a_full_disk_is_one_sentence(tmp_path):
    out = tmp_path / "out"
    with limit_file_size(100_000), pytest.raises(FullDiskError, match="^Cannot write") as error:
        move_to_file(torch.ones(100_000), out)
    assert str(out) in str(error.value)
    assert os.listdir(tmp_path) == []

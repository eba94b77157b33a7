"""The unpacked size of LZFSE streams, from the headers of their blocks."""

import struct

import numpy as np
import pytest

from gscompleter.data.phones.lzfse import measure_unpacked


def raw(data: bytes) -> bytes:
    return b"bvx-" + struct.pack("<I", len(data)) + data


def short(unpacked: int, packed: bytes) -> bytes:
    return b"bvxn" + struct.pack("<II", unpacked, len(packed)) + packed


def usual(unpacked: int, header: int, literals: bytes, matches: bytes) -> bytes:
    fields = len(literals) << 20, len(matches) << 40, header
    return (
        b"bvx2" + struct.pack("<IQQQ", unpacked, *fields) + bytes(header - 32) + literals + matches
    )


def test_the_sizes_of_all_blocks_add_up():
    stream = raw(b"abc") + short(5000, b"xy") + usual(70_000, 96, bytes(40), bytes(9)) + b"bvx$"
    assert measure_unpacked(stream) == 3 + 5000 + 70_000


def test_a_small_file_that_unpacks_to_gigabytes_is_told_by_its_headers():
    assert measure_unpacked(1000 * short(2**31, b"") + b"bvx$") == 1000 * 2**31


@pytest.mark.parametrize("data", [b"", b"bvx", b"PK\3\4" + bytes(40), raw(b"abc")[:9], raw(b"abc")])
def test_other_data_is_refused(data):
    with pytest.raises((ValueError, struct.error)):
        measure_unpacked(data)


@pytest.mark.parametrize("count", [0, 3, 100, 20_000, 500_000])
def test_sizes_agree_with_the_library(count):
    library = pytest.importorskip("liblzfse", reason="needs gscompleter[phones]")
    smooth = np.linspace(0, 3, count, dtype="<f4").tobytes()
    noise = np.random.default_rng(0).integers(0, 256, count, dtype=np.uint8).tobytes()
    for data in (bytes(count), smooth, noise):
        assert measure_unpacked(library.compress(data)) == len(data)

"""Depth maps in files: values as they were stored, in scene units."""

from __future__ import annotations

import numpy as np
import pytest

from gscompleter.system.files.depth_file import read_depth

LEVELS = np.array([[0, 1, 100, 999], [1000, 7, 500, 250]])


@pytest.mark.parametrize("largest", [1000, 4095, 65535])
@pytest.mark.parametrize("kind", ["P5", "P2"])
def test_levels_of_a_pgm_are_read_as_stored_whatever_its_largest(tmp_path, kind, largest):
    """Depth cameras write millimetres, with the largest of them or of the sensor in the header."""
    header = f"{kind} 4 2 {largest}\n".encode()
    text = " ".join(map(str, LEVELS.ravel())).encode()
    data = LEVELS.astype(">u2").tobytes() if kind == "P5" else text
    (tmp_path / "depth.pgm").write_bytes(header + data)
    depth = read_depth(tmp_path / "depth.pgm", 0.001)
    assert np.allclose(depth, LEVELS / 1000, atol=1e-7)


def test_an_array_is_known_by_its_ending_in_any_case(tmp_path):
    with (tmp_path / "DEPTH.NPY").open("wb") as file:
        np.save(file, LEVELS.astype(np.float32))
    assert np.array_equal(read_depth(tmp_path / "DEPTH.NPY", 1.0), LEVELS)

"""Harmonics of degree 4, of which three bands are read on request."""

from __future__ import annotations

import gzip
import struct

import numpy as np
import pytest
import torch

from gscompleter import InputError, load_splat, save_splat
from gscompleter.splats.ply import copy_ply
from scenes import random_gaussians
from splat_files import write_degree_4_ply

SCENE = random_gaussians(50, sh_degree=3)


def write_degree_4_spz(path, scene):
    """Append nine coefficients of the fourth band to those of each Gaussian."""
    plain = path.with_name("plain.spz")
    save_splat(plain, scene)
    raw = gzip.decompress(plain.read_bytes())
    magic, version, n, _, bits, flags, _ = struct.unpack_from("<4sIIBBBB", raw)
    rest = np.frombuffer(raw, np.uint8)[-45 * n :].reshape(n, 15, 3)
    wide = np.concatenate([rest, np.full((n, 9, 3), 200, np.uint8)], axis=1)
    head = struct.pack("<4sIIBBBB", magic, version, n, 4, bits, flags, 0)
    path.write_bytes(gzip.compress(head + raw[16 : -45 * n] + wide.tobytes()))


@pytest.mark.parametrize(
    ("name", "write"), [("wide.ply", write_degree_4_ply), ("wide.spz", write_degree_4_spz)]
)
def test_the_fourth_band_is_named_and_left_out_on_request(tmp_path, name, write):
    path = tmp_path / name
    write(path, SCENE)
    with pytest.raises(InputError, match=r"harmonics of SH degree 4, .* convert"):
        load_splat(path)
    plain = load_splat(tmp_path / f"plain{path.suffix}")
    loaded = load_splat(path, leaves_out_band_4=True)
    assert torch.equal(loaded.sh, plain.sh)
    assert torch.equal(loaded.means, plain.means)


def test_rows_of_degree_4_are_copied_without_the_fourth_band(tmp_path):
    write_degree_4_ply(tmp_path / "wide.ply", SCENE)
    narrow = tmp_path / "narrow.ply"
    with pytest.raises(InputError, match="harmonics of SH degree 4"):
        copy_ply(tmp_path / "wide.ply", narrow, edit=lambda gaussians: gaussians)
    copy_ply(tmp_path / "wide.ply", narrow, leaves_out_band_4=True)
    assert (tmp_path / "narrow.ply").read_bytes() == (tmp_path / "plain.ply").read_bytes()

"""Rows of .ply files: slow twins of the kernels, and the memory that reading and writing take."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import Gaussians, InputError, load_ply, merge, save_ply
from gscompleter.numerics.kernels.splat_rows import permute_rows
from gscompleter.numerics.value_checks import find_finite
from gscompleter.splats import ply
from gscompleter.splats.conversion import Conversion, convert_splat
from gscompleter.splats.layout import is_same_scene, save_like
from gscompleter.splats.morton import argsort_nearby, sort_nearby
from gscompleter.splats.ply import encode, make_row_type, make_rows, save_parts
from gscompleter.system.files.mapping import release_pages
from gscompleter.system.files.ply import read_ply_file
from scenes import random_gaussians

ODD = (float("nan"), float("inf"), -float("inf"), 2e18, -2e18)


def encode_slowly(gaussians: Gaussians) -> torch.Tensor:
    """Encode as `encode` does, in plain tensors, without values of a file."""
    tiny = torch.finfo(torch.float32).tiny
    scales = gaussians.scales.double().clamp_min(tiny).log()
    logits = gaussians.opacities.double().clamp(0, 1 - 2**-24).logit().clamp_min(-30)
    return torch.cat([scales, logits[:, None]], dim=1).float()


@pytest.mark.parametrize("degree", [0, 3])
def test_rows_hold_the_columns_of_3dgs(degree):
    gaussians = random_gaussians(100, sh_degree=degree)
    gaussians = replace(gaussians, generated=torch.arange(100).to(torch.uint8))
    rows = make_rows(gaussians, provenance=True)
    assert rows.dtype == make_row_type(gaussians, provenance=True)
    assert torch.equal(torch.from_numpy(rows["y"].copy()), gaussians.means[:, 1])
    # All coefficients of red, then of green, then of blue.
    for i in range(3 * (gaussians.sh.shape[1] - 1)):
        channel, k = divmod(i, gaussians.sh.shape[1] - 1)
        assert np.array_equal(rows[f"f_rest_{i}"], gaussians.sh[:, 1 + k, channel].numpy())
    assert np.array_equal(rows["generated"], np.arange(100))
    assert (rows["nx"] == 0).all()
    part = make_rows(gaussians, True, slice(30, 41))
    assert part.tobytes() == rows[30:41].tobytes()


def test_values_are_encoded_as_by_their_formula():
    gaussians = random_gaussians(1000, sh_degree=0)
    edges = torch.tensor([0.0, 1.0, 1 - 2**-24, 1e-30, 0.5])
    gaussians = replace(gaussians, opacities=edges.repeat(200))
    gaussians.scales[:5] = torch.tensor([0.0, 1e-38, 1.0])
    encoded = encode(gaussians)
    assert torch.equal(encoded, encode_slowly(gaussians))
    # What a file says is kept where it still decodes to the value, and is anew elsewhere.
    known = encoded.clone()
    known[0] = float("nan")
    known[1] = float("inf")
    known[2] += 1
    assert torch.equal(encode(replace(gaussians, encoded=known)), encoded)


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "sh"])
def test_finite_gaussians_are_found_as_on_other_devices(name):
    gaussians = random_gaussians(40, sh_degree=1)
    values = getattr(gaussians, name)
    for row, odd in enumerate(ODD):
        values[row].fill_(odd)
    gaussians.quats[10] = 0
    # Other types, as other devices, are compared by PyTorch.
    double = replace(
        gaussians,
        **{n: getattr(gaussians, n).double() for n in ("means", "quats", "scales", "opacities")},
        sh=gaussians.sh.double(),
    )
    good = find_finite(gaussians)
    assert good.nonzero()[:, 0].tolist() == [*range(5, 10), *range(11, 40)]
    assert torch.equal(good, find_finite(double))


def test_gaussians_are_sorted_in_their_own_memory():
    gaussians = random_gaussians(500, sh_degree=1)
    gaussians = replace(gaussians, encoded=torch.randn(500, 4))
    order = argsort_nearby(gaussians)
    expected = gaussians[order]
    places = {name: getattr(gaussians, name).data_ptr() for name in ("means", "sh")}
    assert torch.equal(sort_nearby(gaussians), order)
    for name in ("means", "quats", "scales", "opacities", "sh", "generated", "encoded"):
        assert torch.equal(getattr(gaussians, name), getattr(expected, name))
    assert all(getattr(gaussians, name).data_ptr() == place for name, place in places.items())


def test_every_permutation_is_one_of_cycles():
    rng = np.random.default_rng(0)
    for count in (1, 2, 3, 50):
        order = rng.permutation(count)
        tables = [rng.random((count, width)).astype(np.float32) for width in (3, 4, 3, 1, 12, 0)]
        expected = [table[order] for table in tables]
        permute_rows(order, *tables, np.zeros(count, np.bool_))
        assert all(np.array_equal(*pair) for pair in zip(tables, expected, strict=True))


def test_parts_are_written_as_if_they_were_merged(tmp_path, monkeypatch):
    monkeypatch.setattr(ply, "BLOCK_ROWS", 7)
    low = random_gaussians(30, sh_degree=1)
    high = replace(random_gaussians(20, sh_degree=2), generated=torch.ones(20, dtype=torch.uint8))
    order = torch.randperm(30, generator=torch.Generator().manual_seed(0))[:25]
    save_parts(tmp_path / "parts.ply", [(low, order), (high, torch.arange(20))], provenance=True)
    save_ply(tmp_path / "merged.ply", merge([low[order], high]))
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "merged.ply").read_bytes()


def test_a_sorted_context_is_written_in_the_order_of_its_file(tmp_path, monkeypatch):
    monkeypatch.setattr(ply, "BLOCK_ROWS", 7)
    given = tmp_path / "given.ply"
    save_ply(given, random_gaussians(40, sh_degree=1))
    context = load_ply(given)
    places = sort_nearby(context)
    kept = torch.ones(40, dtype=torch.bool)
    kept[[3, 4, 20]] = False
    order = places.argsort()[kept]
    save_like(tmp_path / "done.ply", context, context[:0], given, kept, order)
    rows = read_ply_file(tmp_path / "done.ply", (), "scene").rows
    before = read_ply_file(given, (), "scene").rows[kept.numpy()]
    assert rows.dtype.names == (*before.dtype.names, "generated")
    assert rows[list(before.dtype.names)].tolist() == before.tolist()


def test_released_rows_are_read_again(tmp_path):
    save_ply(tmp_path / "scene.ply", random_gaussians(2000, sh_degree=3))
    rows = read_ply_file(tmp_path / "scene.ply", (), "scene").rows
    before = rows.tobytes()
    release_pages(rows[100:1900])
    assert rows.tobytes() == before
    # Rows in memory of their own are none of a file's.
    release_pages(rows.copy())


def test_a_ply_is_converted_some_gaussians_at_a_time_with_the_same_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(ply, "CHUNK_ROWS", 16)
    gaussians = random_gaussians(50, sh_degree=2)
    labels = (torch.arange(50) > 40).to(torch.uint8)
    for number, generated in enumerate((labels, torch.zeros_like(labels))):
        given = tmp_path / f"{number}.ply"
        save_ply(given, replace(gaussians, generated=generated))
        for keep_labels in (True, False):
            done = convert_splat(given, tmp_path / "copy.ply", keep_labels=keep_labels)
            assert done == Conversion(50, int(generated.sum()))
            kept = generated if keep_labels else torch.zeros_like(generated)
            save_ply(tmp_path / "expected.ply", replace(load_ply(given), generated=kept))
            assert (tmp_path / "copy.ply").read_bytes() == (tmp_path / "expected.ply").read_bytes()


def test_the_chunks_of_a_damaged_ply_are_refused_or_left_out_together(tmp_path, monkeypatch):
    monkeypatch.setattr(ply, "CHUNK_ROWS", 16)
    given = tmp_path / "given.ply"
    save_ply(given, random_gaussians(50, sh_degree=0))
    data = bytearray(given.read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    for row in (2, 20, 21):
        place = start + 4 * 17 * row
        data[place : place + 4] = np.float32("nan").tobytes()
    given.write_bytes(data)
    out = tmp_path / "out.ply"
    with pytest.raises(InputError, match="3 of 50 Gaussians"):
        convert_splat(given, out)
    assert not out.exists()
    assert convert_splat(given, out, drop_nonfinite=True) == Conversion(47, 0)
    save_ply(tmp_path / "expected.ply", load_ply(given, drop_nonfinite=True))
    assert out.read_bytes() == (tmp_path / "expected.ply").read_bytes()


def test_files_of_the_same_gaussians_are_known_whatever_their_headers_say(tmp_path):
    gaussians = random_gaussians(30, sh_degree=1)
    first = tmp_path / "first.ply"
    save_ply(first, gaussians)
    other = tmp_path / "other.ply"
    data = first.read_bytes()
    other.write_bytes(data.replace(b"element vertex", b"comment by another\nelement vertex", 1))
    assert is_same_scene(first, other)
    save_ply(other, replace(gaussians, opacities=gaussians.opacities * 0.5))
    assert not is_same_scene(first, other)
    save_ply(other, gaussians[:29])
    assert not is_same_scene(first, other)
    save_ply(other, replace(gaussians, is_antialiased=True))
    assert not is_same_scene(first, other)
    convert_splat(first, tmp_path / "other.spz")
    assert not is_same_scene(first, tmp_path / "other.spz")

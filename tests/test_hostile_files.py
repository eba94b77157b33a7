"""Files with false claims, too much or hidden content: one sentence each, and soon."""

from __future__ import annotations

import json
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from gscompleter import InputError, load_ply, save_ply
from gscompleter.models.weights.fitting import load_strictly
from gscompleter.models.weights.published import PUBLISHED
from gscompleter.models.weights.reading import check_kind, extract_network_tensors
from gscompleter.system.files.depth_file import read_depth
from gscompleter.system.files.image import read_image, read_image_size, read_pixels
from gscompleter.system.files.reading import read_json
from scenes import random_gaussians


def sentence(call, *arguments) -> str:
    """Return the message of the error."""
    with pytest.raises(InputError) as error:
        call(*arguments)
    assert len(str(error.value)) < 1000
    assert "\n" not in str(error.value)
    return str(error.value)


# ---- .ply ---------------------------------------------------------------------------------------


def ply(tmp_path: Path, ahead: str, file_format: str = "ascii") -> Path:
    """Write a scene of one Gaussian with a further line in its header."""
    path = tmp_path / "scene.ply"
    save_ply(path, random_gaussians(1))
    head, body = path.read_bytes().split(b"end_header\n")
    lines = head.decode().replace("binary_little_endian", file_format).splitlines()
    lines.insert(2, ahead)
    if file_format == "ascii":
        body = " ".join(map(str, np.frombuffer(body, "<f4"))).encode() + b"\n"
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + body)
    return path


@pytest.mark.parametrize("rows", ["1", "1" + 12 * "0", "1" + 5000 * "0"])
@pytest.mark.parametrize("properties", ["", "\nproperty float a", "\nproperty list int float a"])
def test_a_scene_behind_another_element_is_refused(tmp_path, rows, properties):
    sentence(load_ply, ply(tmp_path, f"element foo {rows}{properties}"))


@pytest.mark.parametrize("file_format", ["ascii", "binary_little_endian"])
def test_a_scene_that_claims_more_gaussians_than_bytes_is_truncated(tmp_path, file_format):
    path = ply(tmp_path, "comment nothing", file_format)
    path.write_bytes(path.read_bytes().replace(b"vertex 1\n", b"vertex 10000000000000000\n"))
    assert "of 10,000,000,000,000,000 Gaussians" in sentence(load_ply, path)


def test_a_header_is_quoted_in_part(tmp_path):
    sentence(load_ply, ply(tmp_path, f"nonsense {'a' * 3000}"))
    path = ply(tmp_path, "comment nothing")
    path.write_bytes(path.read_bytes().replace(b"ascii", b"b" * 3000))
    sentence(load_ply, path)


@pytest.mark.linux
def test_a_pipe_is_no_scene_and_nobody_waits_for_it(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    assert "is no regular file" in sentence(load_ply, tmp_path / "pipe.ply")
    assert "is no regular file" in sentence(read_json, tmp_path / "pipe.ply", "")


# ---- images and depths --------------------------------------------------------------------------


def png(width: int, height: int) -> bytes:
    """Write a PNG that claims this size and has one byte of it."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0"))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(10**9, 10**9), (2**31 - 1, 1), (40_000, 40_000)])
def test_an_image_that_claims_too_many_pixels_is_refused_before_they_are_made(tmp_path, size):
    (tmp_path / "bomb.png").write_bytes(png(*size))
    for call in (read_image, read_image_size):
        assert "pixels) exceeds limit" in sentence(call, tmp_path / "bomb.png")
    assert "pixels) exceeds limit" in sentence(read_pixels, png(*size), "frame 3")


@pytest.mark.parametrize("size", [(0, 5), (5, 0), (64, 64)])
def test_an_image_without_its_pixels_is_damaged(tmp_path, size):
    (tmp_path / "short.png").write_bytes(png(*size))
    sentence(read_image, tmp_path / "short.png")


def test_formats_that_run_programs_are_no_images(tmp_path):
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    assert "not an image" in sentence(read_image, tmp_path / "a.png")


def npy(path: Path, shape: str, dtype: str = "<f8", data: bytes = b"\0" * 64) -> Path:
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + data)
    return path


@pytest.mark.parametrize("shape", ["(100000000, 100000000)", f"({10**30}, 1)", "(0, 4)", "(-4, 2)"])
def test_a_depth_map_that_claims_more_than_its_file_holds_is_refused(tmp_path, shape):
    assert "cannot be read" in sentence(read_depth, npy(tmp_path / "d.npy", shape), 1.0)


def test_archives_and_objects_are_no_depth_maps(tmp_path):
    np.savez(tmp_path / "d.npz", np.ones((2, 2)))
    os.rename(tmp_path / "d.npz", tmp_path / "d.npy")
    sentence(read_depth, tmp_path / "d.npy", 1.0)
    np.save(tmp_path / "o.npy", np.array([[None]]), allow_pickle=True)
    sentence(read_depth, tmp_path / "o.npy", 1.0)


def test_depths_beyond_float32_are_unknown(tmp_path, recwarn):
    np.save(tmp_path / "d.npy", np.array([[1e300, 1.0, -1.0, np.nan]]))
    assert read_depth(tmp_path / "d.npy", 1.0).tolist() == [[0.0, 1.0, 0.0, 0.0]]
    assert not recwarn.list


# ---- JSON ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", ["9" * 400, "-" + "9" * 5000, "1" + "0" * 20])
def test_integers_beyond_64_bits_are_refused(tmp_path, number):
    (tmp_path / "a.json").write_text(f'{{"w": {number}}}')
    assert "an integer of" in sentence(read_json, tmp_path / "a.json", "export it again")


def test_integers_of_64_bits_are_read(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps([2**64 - 1, -(2**63)]))
    assert read_json(tmp_path / "a.json", "") == [2**64 - 1, -(2**63)]


def test_json_of_great_depth_is_refused(tmp_path):
    (tmp_path / "a.json").write_text("[" * 100_000 + "]" * 100_000)
    assert "is not JSON" in sentence(read_json, tmp_path / "a.json", "export it again")


# ---- weights ------------------------------------------------------------------------------------

MVSPLAT = PUBLISHED["mvsplat-re10k"]


@pytest.mark.parametrize(
    "tensor",
    [
        torch.empty(3, 3, device="meta"),
        torch.eye(3).to_sparse(),
        torch.eye(3).to_sparse_csr(),
        torch.eye(3, dtype=torch.complex64),
        torch.quantize_per_tensor(torch.eye(3), 0.1, 0, torch.qint8),
    ],
    ids=["meta", "sparse", "csr", "complex", "quantized"],
)
def test_tensors_that_are_no_arrays_of_numbers_are_refused(tmp_path, tensor, request):
    content = {"state_dict": {"encoder.weight": tensor}}
    told = sentence(extract_network_tensors, content, tmp_path / "a.ckpt", MVSPLAT)
    assert "tensors without plain numbers (weight)" in told
    kind = "empty shells" if tensor.is_meta else request.node.callspec.id
    assert kind.replace("csr", "sparse") in told


def test_an_archive_that_claims_several_disks_is_refused(tmp_path):
    path = tmp_path / "a.ckpt"
    torch.save({"a": torch.ones(3)}, path)
    data = bytearray(path.read_bytes())
    locator = data.rindex(b"PK\x06\x07")
    data[locator + 16 : locator + 20] = struct.pack("<I", 7)
    path.write_bytes(bytes(data))
    assert "ends too early" in sentence(check_kind, path, "a.ckpt")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_weights_that_are_not_finite_are_refused(value):
    network = torch.nn.Linear(3, 2)
    before = network.weight.clone()
    state = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    state["bias"][1] = value
    assert "NaN or infinity in 1 of 2 tensors (such as bias)" in sentence(
        load_strictly, network, state, "a.ckpt"
    )
    assert network.weight.equal(before)

"""Written .glb files: nothing is rounded, and the bytes follow glTF and its extension."""

import json
import os
import struct

import numpy as np
import pytest
import torch

from gscompleter import InputError, load_splat, save_splat
from gscompleter.splats import glb
from splat_files import covariances, plausible

NAME = "KHR_gaussian_splatting:"


def parse(data: bytes) -> tuple[dict, bytes]:
    """Parse the header and both chunks of a .glb by the words of its specification."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    text_size, text_kind = struct.unpack_from("<I4s", data, 12)
    size, kind = struct.unpack_from("<I4s", data, 20 + text_size)
    assert (text_kind, kind) == (b"JSON", b"BIN\0")
    assert text_size % 4 == size % 4 == 0
    assert 28 + text_size + size == length
    return json.loads(data[20 : 20 + text_size]), data[28 + text_size :]


def read_columns(table: dict, binary: bytes) -> dict[str, np.ndarray]:
    """Read the attributes of the one primitive, which lie apart from each other and aligned."""
    columns, taken = {}, np.zeros(len(binary), int)
    (primitive,) = table["meshes"][0]["primitives"]
    for name, index in primitive["attributes"].items():
        accessor = table["accessors"][index]
        view = table["bufferViews"][accessor["bufferView"]]
        start, width = view["byteOffset"], {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert accessor["componentType"] == 5126
        assert view["buffer"] == 0
        assert start % 4 == 0
        assert view["byteLength"] == 4 * width * accessor["count"]
        taken[start : start + view["byteLength"]] += 1
        columns[name] = np.frombuffer(binary, "<f4", accessor["count"] * width, start)
        columns[name] = columns[name].reshape(-1, width)
    assert (taken == 1).all()
    return columns


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_glb_keeps_every_number(tmp_path, degree):
    gaussians = plausible(80, degree)
    save_splat(tmp_path / "scene.glb", gaussians)
    loaded = load_splat(tmp_path / "scene.glb")
    for field in ("means", "scales", "opacities", "sh"):
        assert torch.equal(getattr(loaded, field), getattr(gaussians, field))
    assert torch.allclose(covariances(loaded), covariances(gaussians), atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_glb_follows_the_specification(tmp_path, degree):
    gaussians = plausible(33, degree)
    save_splat(tmp_path / "scene.glb", gaussians)
    table, binary = parse((tmp_path / "scene.glb").read_bytes())
    columns = read_columns(table, binary)
    assert table["asset"]["version"] == "2.0"
    assert table["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert table["buffers"] == [{"byteLength": len(binary)}]
    assert table["nodes"][table["scenes"][table["scene"]]["nodes"][0]] == {"mesh": 0}
    primitive = table["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert extension == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    harmonics = {f"SH_DEGREE_{d}_COEF_{i}" for d in range(degree + 1) for i in range(2 * d + 1)}
    names = {NAME + name for name in {"ROTATION", "SCALE", "OPACITY"} | harmonics}
    assert set(columns) == names | {"POSITION", "COLOR_0"}
    bounds = table["accessors"][primitive["attributes"]["POSITION"]]
    assert np.array_equal(np.float32(bounds["min"]), columns["POSITION"].min(0))
    assert np.array_equal(np.float32(bounds["max"]), columns["POSITION"].max(0))
    assert np.allclose(np.linalg.norm(columns[f"{NAME}ROTATION"], axis=1), 1, atol=1e-6)
    assert (columns[f"{NAME}SCALE"] >= 0).all()
    assert ((columns[f"{NAME}OPACITY"] >= 0) & (columns[f"{NAME}OPACITY"] <= 1)).all()


def test_a_glb_is_in_the_axes_of_gltf_with_linear_colours_for_points(tmp_path):
    gaussians = plausible(1, 0)
    gaussians.means[0] = torch.tensor([1.0, 2.0, 3.0])  # right, down, forward
    gaussians.sh[0, 0] = torch.tensor([0.0, 9.0, -9.0])  # sRGB 0.5, above 1, below 0
    gaussians.opacities[0] = 0.25
    save_splat(tmp_path / "scene.glb", gaussians)
    columns = read_columns(*parse((tmp_path / "scene.glb").read_bytes()))
    assert columns["POSITION"].tolist() == [[-1, -2, 3]]
    assert np.allclose(columns["COLOR_0"], [[0.21404, 1, 0, 0.25]], atol=1e-4)


def test_a_file_that_exceeds_the_format_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(glb, "MAX_FILE_BYTES", 5000)
    with pytest.raises(InputError, match="4 GiB"):
        save_splat(tmp_path / "scene.glb", plausible(50, 0))
    assert os.listdir(tmp_path) == []
    save_splat(tmp_path / "scene.glb", plausible(30, 0))

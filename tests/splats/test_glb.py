"""Written .glb files: nothing is rounded, and the bytes follow glTF and its extension."""

import os

import numpy as np
import pytest
import torch

from gscompleter import InputError, load_splat, save_splat
from gscompleter.splats import glb
from splat_files import covariances, parse_glb, plausible, write_glb, write_spz_2

NAME = "KHR_gaussian_splatting:"


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
    table, binary = parse_glb((tmp_path / "scene.glb").read_bytes())
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
    columns = read_columns(*parse_glb((tmp_path / "scene.glb").read_bytes()))
    assert columns["POSITION"].tolist() == [[-1, -2, 3]]
    assert np.allclose(columns["COLOR_0"], [[0.21404, 1, 0, 0.25]], atol=1e-4)


def test_a_file_that_exceeds_the_format_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(glb, "MAX_FILE_BYTES", 5000)
    with pytest.raises(InputError, match="4 GiB"):
        save_splat(tmp_path / "scene.glb", plausible(50, 0))
    assert os.listdir(tmp_path) == []
    save_splat(tmp_path / "scene.glb", plausible(30, 0))


# ------------------------------------------------------------------------------ SPZ within glTF


def pack(path, gaussians, name="KHR_gaussian_splatting_compression_spz", version=3, **changes):
    """Write a .glb whose buffer holds a .spz, as the extension describes it."""
    spz = path.with_name("inside.spz")
    save_splat(spz, gaussians)
    if version == 2:
        write_spz_2(spz, spz, gaussians)
    data = b"\0\0\0\0" + spz.read_bytes()
    table = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_gaussian_splatting", name],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **changes.get("node", {})}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "COLOR_0": 1},
                        "mode": 0,
                        "extensions": {
                            "KHR_gaussian_splatting": {
                                "extensions": {name: {"bufferView": 0}},
                            }
                        },
                    }
                ]
            }
        ],
        # Without buffers: they say what comes out of the .spz.
        "accessors": [
            {"componentType": 5126, "count": changes.get("count", len(gaussians)), "type": kind}
            for kind in ("VEC3", "VEC4")
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": 4, "byteLength": len(data) - 4}],
        "buffers": [{"byteLength": len(data)}],
    }
    return write_glb(path, table, data + b"\0" * (-len(data) % 4))


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("name", [f"{NAME[:-1]}_compression_spz", f"{NAME[:-1]}_compression_spz_2"])
def test_a_spz_within_gltf_is_the_splat_of_the_spz(tmp_path, name, version):
    """Its own axes become those of glTF by half a turn, and those of a .ply by another."""
    gaussians = plausible(60, 2)
    packed = load_splat(pack(tmp_path / "scene.glb", gaussians, name, version))
    alone = load_splat(tmp_path / "inside.spz")
    for field in ("means", "scales", "opacities", "sh"):
        assert torch.allclose(getattr(packed, field), getattr(alone, field), atol=1e-6)
    assert torch.allclose(covariances(packed), covariances(alone), atol=1e-6)


def test_a_node_moves_a_spz_within_gltf(tmp_path):
    gaussians = plausible(30, 1)
    node = {"translation": [1, 2, 3], "scale": [2, 2, 2]}
    moved = load_splat(pack(tmp_path / "scene.glb", gaussians, node=node))
    alone = load_splat(tmp_path / "inside.spz")
    # Axes of glTF are x left, y up, z forward.
    assert torch.allclose(moved.means, 2 * alone.means + torch.tensor([-1.0, -2, 3]), atol=1e-4)
    assert torch.allclose(moved.scales, 2 * alone.scales)


@pytest.mark.parametrize("count", [29, 31, 10**9])
def test_a_spz_of_another_size_than_its_accessors_is_refused(tmp_path, count):
    with pytest.raises(InputError, match="cannot be read: its"):
        load_splat(pack(tmp_path / "scene.glb", plausible(30, 0), count=count))


def test_a_damaged_spz_within_gltf_is_one_sentence(tmp_path):
    path = pack(tmp_path / "scene.glb", plausible(300, 1))
    table, binary = parse_glb(path.read_bytes())
    for cut in (0, 10, 200):
        write_glb(path, table, binary[:cut] + b"\xff" * (len(binary) - cut))
        with pytest.raises(InputError, match="cannot be read"):
            load_splat(path)
    table["bufferViews"][0]["byteLength"] //= 2
    with pytest.raises(InputError, match="cannot be read"):
        load_splat(write_glb(path, table, binary))


def test_many_primitives_cannot_unpack_one_spz_without_end(tmp_path):
    """A bomb: a thousand primitives that each name the same megabytes."""
    path = pack(tmp_path / "scene.glb", plausible(30, 0))
    table, binary = parse_glb(path.read_bytes())
    table["meshes"][0]["primitives"] *= 20_000
    table["accessors"][0]["count"] = 30
    with pytest.raises(InputError, match="claims to hold more than 10,000 primitives"):
        load_splat(write_glb(path, table, binary))
    # Nodes that share a mesh multiply them, and are counted one by one.
    table["nodes"] = [{"mesh": 0}] * 20_000
    table["scenes"][0]["nodes"] = list(range(20_000))
    table["accessors"][0]["count"] = 10**6
    with pytest.raises(InputError, match="bytes claim to hold 5,000,000 Gaussians"):
        load_splat(write_glb(path, table, binary))


@pytest.mark.parametrize(
    "transform",
    [
        {"matrix": [1.0, 2.0, 3.0]},
        {"scale": [2.0]},
        {"scale": [2.0, 2.0]},
        {"translation": [1.0, 2.0]},
        {"rotation": [[0.0, 0.0, 0.0, 1.0]]},
    ],
)
def test_a_transform_of_too_few_numbers_is_one_sentence(tmp_path, transform):
    path = tmp_path / "scene.glb"
    save_splat(path, plausible(5))
    table, binary = parse_glb(path.read_bytes())
    table["nodes"][0] = {"mesh": 0, **transform}
    write_glb(path, table, binary)
    with pytest.raises(InputError, match="a node has other than .* for a part of its transform"):
        load_splat(path)


def test_without_scenes_the_nodes_below_no_other_are_the_roots(tmp_path):
    path = tmp_path / "scene.glb"
    save_splat(path, plausible(5))
    table, binary = parse_glb(path.read_bytes())
    whole = load_splat(path)
    del table["scenes"], table["scene"]
    table["nodes"] = [{"children": [1]}, {"mesh": 0}]
    again = load_splat(write_glb(path, table, binary))
    assert torch.equal(again.means, whole.means)


@pytest.mark.parametrize("is_normalized", [True, False])
def test_labels_may_be_bytes(tmp_path, is_normalized):
    path = tmp_path / "scene.glb"
    save_splat(path, plausible(4))
    table, binary = parse_glb(path.read_bytes())
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": 4}
    table["bufferViews"].append(view)
    labels = {"componentType": 5121, "count": 4, "type": "SCALAR", "normalized": is_normalized}
    table["accessors"].append({"bufferView": len(table["bufferViews"]) - 1, **labels})
    attributes = table["meshes"][0]["primitives"][0]["attributes"]
    attributes[glb.LABELS_ATTRIBUTE] = len(table["accessors"]) - 1
    read = load_splat(write_glb(path, table, binary + bytes([0, 1, 2, 255])))
    assert read.generated.tolist() == [0, 1, 2, 255]


@pytest.mark.parametrize("scale", [[1, 2, 1], [-1, 1, 1], [0, 0, 0]])
def test_a_mesh_beside_the_splat_may_be_stretched_mirrored_or_hidden(tmp_path, scale):
    path = tmp_path / "scene.glb"
    save_splat(path, plausible(5))
    whole = load_splat(path)
    table, binary = parse_glb(path.read_bytes())
    table["meshes"].append({"primitives": [{"attributes": {"POSITION": 0}}]})
    table["nodes"].append({"mesh": 1, "scale": scale})
    table["scenes"][0]["nodes"] = [0, 1]
    assert torch.equal(load_splat(write_glb(path, table, binary)).means, whole.means)

    table["nodes"][0]["scale"] = scale
    with pytest.raises(InputError, match="has a node that mirrors Gaussians or stretches them"):
        load_splat(write_glb(path, table, binary))


def test_two_nodes_that_mirror_gaussians_together_turn_them(tmp_path):
    path = tmp_path / "scene.glb"
    save_splat(path, plausible(5))
    whole = load_splat(path)
    table, binary = parse_glb(path.read_bytes())
    table["nodes"] = [
        {"children": [1], "scale": [-1, 1, 1]},
        {"mesh": 0, "scale": [1, -1, 1]},
    ]
    turned = load_splat(write_glb(path, table, binary))
    assert torch.allclose(turned.means, whole.means * torch.tensor([-1.0, -1.0, 1.0]))


@pytest.mark.parametrize("scenes", [{}, {"scenes": [{"name": "empty"}]}])
def test_a_scene_of_nothing_holds_no_gaussians_and_is_not_damaged(tmp_path, scenes):
    path = write_glb(tmp_path / "scene.glb", {"asset": {"version": "2.0"}, **scenes}, b"")
    with pytest.raises(InputError, match="holds a mesh or points, no Gaussians"):
        load_splat(path)

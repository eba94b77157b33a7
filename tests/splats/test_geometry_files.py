"""Meshes and points from files: all hold the same room."""

import struct

import numpy as np
import pytest

from gscompleter import InputError, load_geometry, save_splat
from room_mesh import (
    mesh_of,
    points_of,
    write_glb_mesh,
    write_obj,
    write_ply_mesh,
    write_ply_points,
    write_ply_triangles,
)
from scenes import Room, camera_at, cast, random_gaussians
from splat_files import parse_glb, write_glb

CAMERA = camera_at(0.7, yaw=12, size=64)
WRITERS = {
    "binary.ply": write_ply_mesh,
    "ascii.ply": lambda path, mesh: write_ply_mesh(path, mesh, is_text=True),
    "big.ply": lambda path, mesh: write_ply_mesh(path, mesh, order=">"),
    "triangles.ply": write_ply_triangles,
    "room.obj": write_obj,
    "room.glb": write_glb_mesh,
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_mesh_file_has_the_depth_of_its_room(name, tmp_path):
    geometry = load_geometry(WRITERS[name](tmp_path / name, mesh_of()))
    truth = cast(Room(), CAMERA)[1]
    assert geometry.name == name
    assert (geometry.draw_depth(CAMERA) - truth).abs().max() < 1e-5 * truth.max()


def test_points_have_the_depth_of_their_room(tmp_path):
    geometry = load_geometry(write_ply_points(tmp_path / "scan.ply", points_of()))
    truth = cast(Room(), CAMERA)[1]
    depth = geometry.draw_depth(CAMERA)
    error = (depth - truth).abs() / truth
    assert (depth > 0).float().mean() > 0.7
    assert error[depth > 0].median() < 1e-4


def test_a_file_of_gaussians_is_no_geometry(tmp_path):
    for name in ("splat.ply", "splat.glb"):
        save_splat(tmp_path / name, random_gaussians(8))
        with pytest.raises(InputError, match="holds Gaussians; name a mesh or points"):
            load_geometry(tmp_path / name)


def test_another_file_is_refused_by_name(tmp_path):
    with pytest.raises(InputError, match=r"name a mesh or points as \.ply, \.obj, \.glb"):
        load_geometry(tmp_path / "scan.las")


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="scan.ply"):
        load_geometry(tmp_path / "scan.ply")


@pytest.mark.parametrize("name", ["binary.ply", "ascii.ply", "room.glb"])
def test_a_file_that_was_cut_is_refused(name, tmp_path):
    path = WRITERS[name](tmp_path / name, mesh_of())
    data = path.read_bytes()
    path.write_bytes(data[: len(data) - 40])
    with pytest.raises(InputError, match="ends"):
        load_geometry(path)


def test_a_glb_that_was_cut_lacks_corners_and_not_gaussians(tmp_path):
    path = write_glb_mesh(tmp_path / "room.glb", mesh_of())
    table, binary = parse_glb(path.read_bytes())
    write_glb(path, table, binary[:-40])
    with pytest.raises(InputError, match=r"it ends after \d+ of \d+ corners"):
        load_geometry(path)


@pytest.mark.parametrize(
    "part",
    [
        {"nodes": ["a"]},
        {"meshes": [{"primitives": ["a"]}]},
        {"nodes": [{"mesh": 0, "matrix": [1.0, 2.0, 3.0]}]},
        {"nodes": [{"mesh": 0, "scale": [1.0, 2.0]}]},
    ],
)
def test_a_glb_of_other_json_is_one_sentence(part, tmp_path):
    path = write_glb_mesh(tmp_path / "room.glb", mesh_of())
    table, binary = parse_glb(path.read_bytes())
    write_glb(path, table | part, binary)
    with pytest.raises(InputError, match=r"room\.glb cannot be read"):
        load_geometry(path)


def test_a_glb_that_nests_without_end_is_one_sentence(tmp_path):
    path = write_glb(tmp_path / "room.glb", {}, b"")
    text = b"[" * 200_000
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    with pytest.raises(InputError, match="cannot be read"):
        load_geometry(path)


def test_faces_of_missing_vertices_are_refused(tmp_path):
    vertices, quads = mesh_of()
    path = write_ply_mesh(tmp_path / "room.ply", (vertices, quads + 1))
    with pytest.raises(InputError, match="triangles of vertices that are not there"):
        load_geometry(path)


def test_a_corner_of_another_primitive_is_refused(tmp_path):
    path = write_glb_mesh(tmp_path / "room.glb", mesh_of())
    table, binary = parse_glb(path.read_bytes())
    primitives = table["meshes"][0]["primitives"]
    # A second primitive has the vertices that the indices of the first one lead to.
    accessor = table["accessors"][primitives[0]["attributes"]["POSITION"]]
    few = {**accessor, "count": accessor["count"] // 2}
    table["accessors"].append(few)
    primitives[0]["attributes"]["POSITION"] = len(table["accessors"]) - 1
    primitives.append({"attributes": {"POSITION": len(table["accessors"]) - 1}})
    write_glb(path, table, binary)
    with pytest.raises(InputError, match="a triangle has a corner beyond its"):
        load_geometry(path)


def test_primitives_that_share_a_few_vertices_cannot_make_triangles_without_end(tmp_path):
    """A bomb of 124 KB: 2,000 primitives whose 10,000 triangles are the same bytes."""
    corners = np.eye(3, dtype="<f4").tobytes()
    indices = bytes(range(3)) * 10_000
    view = {"buffer": 0}
    primitive = {"attributes": {"POSITION": 0}, "indices": 1}
    table = {
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive] * 2_000}],
        "bufferViews": [view | {"byteLength": 36}, view | {"byteOffset": 36, "byteLength": 30_000}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5121, "count": 30_000, "type": "SCALAR"},
        ],
    }
    path = write_glb(tmp_path / "room.glb", table, corners + indices)
    assert path.stat().st_size < 150_000
    with pytest.raises(InputError, match="bytes claim to hold 4,230,000 triangles"):
        load_geometry(path)


@pytest.mark.parametrize("mode", [4, 5, 6])
def test_a_primitive_of_one_vertex_has_no_triangle(tmp_path, mode):
    path = write_glb_mesh(tmp_path / "room.glb", mesh_of())
    whole = load_geometry(path).draw_depth(CAMERA)
    table, binary = parse_glb(path.read_bytes())
    primitives = table["meshes"][0]["primitives"]
    accessor = table["accessors"][primitives[0]["attributes"]["POSITION"]]
    table["accessors"].append({**accessor, "count": 1})
    position = {"POSITION": len(table["accessors"]) - 1}
    primitives.append({"attributes": position, "mode": mode})
    write_glb(path, table, binary)
    assert (load_geometry(path).draw_depth(CAMERA) == whole).all()


def test_a_line_that_is_no_vertex_is_named(tmp_path):
    path = tmp_path / "room.obj"
    path.write_text("v 0 0 0\nv 1 zero 0\n")
    with pytest.raises(InputError, match="line 2 is no vertex"):
        load_geometry(path)


def test_a_few_points_are_no_surface(tmp_path):
    path = write_ply_points(tmp_path / "few.ply", np.eye(3))
    with pytest.raises(InputError, match="neither triangles nor points"):
        load_geometry(path)


OBJ_CORNERS = "v 0 0 1\nv 1 0 1\nv 0 1 1\nv 1 1 1\n"


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("f 0 1 2\n" + OBJ_CORNERS, "line 5 has the index 0"),
        ("v 1 2\nv 1 1 1\nf 1 2 3\n", "line 5 is no vertex"),
    ],
)
def test_a_line_that_would_shift_indices_is_refused(lines, message, tmp_path):
    path = tmp_path / "room.obj"
    path.write_text(OBJ_CORNERS + lines)
    with pytest.raises(InputError, match=message):
        load_geometry(path)


@pytest.mark.parametrize("character", "\x0b\x0c\x85\u2028")
def test_only_line_feeds_and_carriage_returns_end_lines_of_obj(character, tmp_path):
    path = tmp_path / "room.obj"
    path.write_bytes(f"# by{character}v 9 9 9\r\n{OBJ_CORNERS}f 1 2 3\n".encode())
    assert load_geometry(path).vertices.max() == 1


PLY_HEADER = (
    "ply\nformat {} 1.0\ncomment once binary_big_endian\nelement vertex 4\nproperty float x\n"
    "property float y\nproperty float z\n{}element face 1\n{}"
    "property list char int vertex_indices\nend_header\n"
)
PLY_CORNERS = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]], "<f4")


def write_faces(path, kind, row, before="", beside=""):
    header = PLY_HEADER.format(kind, before, beside).encode()
    if kind == "ascii":
        text = "".join(f"{x} {y} {z}\n" for x, y, z in PLY_CORNERS)
        path.write_bytes(header + text.encode() + row)
    else:
        path.write_bytes(header + PLY_CORNERS.tobytes() + row)
    return path


@pytest.mark.parametrize("beside", ["obj_info by a scanner\n", "comment corners\nobj_info of it\n"])
def test_a_header_with_remarks_beside_faces_is_read(beside, tmp_path):
    path = write_faces(tmp_path / "room.ply", "ascii", b"3 0 1 2\n", beside=beside)
    assert load_geometry(path).faces.tolist() == [[0, 1, 2]]


def test_a_byte_order_in_a_comment_does_not_count(tmp_path):
    row = b"\3" + np.array([0, 1, 2], "<i4").tobytes()
    path = write_faces(tmp_path / "room.ply", "binary_little_endian", row)
    assert load_geometry(path).faces.tolist() == [[0, 1, 2]]


def test_another_element_before_faces_is_refused_by_any_name(tmp_path):
    before = "element edge-loop 1\nproperty int start\n"
    path = write_faces(tmp_path / "room.ply", "ascii", b"3 0 1 2\n3 0 1 2\n", before=before)
    with pytest.raises(InputError, match="other elements between"):
        load_geometry(path)


@pytest.mark.parametrize(
    ("kind", "row"),
    [
        ("ascii", b"4 0 1 2\n"),
        ("ascii", b"-1 0 1 2 3\n"),
        ("binary_little_endian", b"\xff" + np.array([0, 1, 2], "<i4").tobytes()),
    ],
)
def test_a_face_without_the_corners_that_it_counts_is_refused(kind, row, tmp_path):
    path = write_faces(tmp_path / "room.ply", kind, row)
    with pytest.raises(InputError, match="face 1 has not the corners that it counts"):
        load_geometry(path)

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


def test_a_line_that_is_no_vertex_is_named(tmp_path):
    path = tmp_path / "room.obj"
    path.write_text("v 0 0 0\nv 1 zero 0\n")
    with pytest.raises(InputError, match="line 2 is no vertex"):
        load_geometry(path)


def test_a_few_points_are_no_surface(tmp_path):
    path = write_ply_points(tmp_path / "few.ply", np.eye(3))
    with pytest.raises(InputError, match="neither triangles nor points"):
        load_geometry(path)

"""The walls of a synthetic room as a mesh and as points, in every file that holds geometry."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import plyfile
from jaxtyping import Float, Int
from numpy import ndarray

from scenes import Room, camera_at, cast

SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
"""Corners of the sides of a box, of which x, then y, then z is low (0) or high (1)."""

OTHER_ROOM = Room(
    (
        ((-2.0, -1.3, -2.0), (4.0, 1.3, 6.0)),
        ((1.5, 0.1, 1.0), (2.2, 1.3, 2.5)),
        ((-1.8, -0.4, 3.0), (-1.0, 1.3, 4.4)),
    )
)
"""A room of nearly the size of the default one, with other furniture."""

Mesh = tuple[Float[ndarray, "n 3"], Int[ndarray, "m 4"]]


def mesh_of(room: Room = Room()) -> Mesh:
    """Make the vertices and the quadrilaterals of a room's boxes."""
    vertices = [
        [box[bit][axis] * room.unit for axis, bit in enumerate(bits)]
        for box in room.boxes
        for bits in np.ndindex(2, 2, 2)
    ]
    sides = np.array(SIDES)
    quads = np.concatenate([sides + 8 * number for number in range(len(room.boxes))])
    return np.array(vertices, np.float64), quads


def triangles_of(quads: Int[ndarray, "m 4"]) -> Int[ndarray, "k 3"]:
    """Cut quadrilaterals into triangles."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def points_of(room: Room = Room(), size: int = 96) -> Float[ndarray, "n 3"]:
    """Scan a room from its middle, all around."""
    points = []
    for yaw in (0, 90, 180, 270):
        camera = camera_at(z=1.0, yaw=yaw, size=size, focal=0.5)
        depth = cast(room, camera)[1]
        points.append((camera.center + depth[..., None] * camera.z_rays()).reshape(-1, 3).numpy())
    return np.concatenate(points).astype(np.float64)


def write_ply_mesh(path: Path, mesh: Mesh, is_text: bool = False, order: str = "<") -> Path:
    """Write a mesh as a .ply of quadrilaterals."""
    vertices, quads = mesh
    rows = np.zeros(len(vertices), [(name, "f8") for name in "xyz"])
    for name, column in zip("xyz", vertices.T, strict=True):
        rows[name] = column
    faces = np.empty(len(quads), [("vertex_indices", object), ("quality", "f4")])
    faces["vertex_indices"] = [np.array(quad, np.int32) for quad in quads]
    elements = [
        plyfile.PlyElement.describe(rows, "vertex"),
        plyfile.PlyElement.describe(faces, "face"),
    ]
    plyfile.PlyData(elements, text=is_text, byte_order="=" if is_text else order).write(str(path))
    return path


def write_ply_triangles(path: Path, mesh: Mesh) -> Path:
    """Write a mesh as a .ply of triangles."""
    vertices, quads = mesh
    rows = np.array([tuple(vertex) for vertex in vertices], [(name, "f4") for name in "xyz"])
    faces = np.empty(2 * len(quads), [("vertex_index", "i4", (3,))])
    faces["vertex_index"] = triangles_of(quads)
    elements = [
        plyfile.PlyElement.describe(rows, "vertex"),
        plyfile.PlyElement.describe(faces, "face"),
    ]
    plyfile.PlyData(elements).write(str(path))
    return path


def write_ply_points(path: Path, points: Float[ndarray, "n 3"]) -> Path:
    """Write points as a .ply, with normals and colours as COLMAP writes them."""
    kinds = [(name, "f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    rows = np.zeros(len(points), [*kinds, *((name, "u1") for name in ("red", "green", "blue"))])
    for name, column in zip("xyz", points.T, strict=True):
        rows[name] = column
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(path))
    return path


def write_obj(path: Path, mesh: Mesh) -> Path:
    """Write a mesh as a .obj, with texture coordinates and indices of both kinds."""
    vertices, quads = mesh
    lines = ["# room", "vt 0 0", *(f"v {x} {y} {z}" for x, y, z in vertices), "usemtl wall"]
    for number, quad in enumerate(quads):
        shown = quad + 1 if number % 2 else quad - len(vertices)
        lines.append("f " + " ".join(f"{corner}/1" for corner in shown))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_glb_mesh(path: Path, mesh: Mesh) -> Path:
    """Write a mesh as a .glb below two nodes, which scale and shift it to its place."""
    vertices, quads = mesh
    shift = np.array([1.0, -2.0, 3.0])
    stored = ((vertices - shift) / [2.0, 1.0, 0.5]).astype("<f4")
    indices = triangles_of(quads).astype("<u4")
    table = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"translation": shift.tolist(), "children": [1]},
            {"scale": [2.0, 1.0, 0.5], "mesh": 0},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": stored.nbytes + indices.nbytes}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": stored.nbytes},
            {"buffer": 0, "byteOffset": stored.nbytes, "byteLength": indices.nbytes},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(stored), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": indices.size, "type": "SCALAR"},
        ],
    }
    text = json.dumps(table).encode()
    text += b" " * (-len(text) % 4)
    binary = stored.tobytes() + indices.tobytes()
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path

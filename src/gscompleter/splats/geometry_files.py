"""Reader of meshes and points: .ply, .obj, and .glb without Gaussians.

Coordinates are taken as they stand in a file, in the axes of the scene; colours are not read.
Readers raise UnsupportedError for content that is not read, and of damaged files DamagedError and
errors of `splats/formats.py`; `load_geometry` makes an InputError of all.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from gscompleter.numerics.given_geometry import GivenGeometry, make_geometry
from gscompleter.splats.formats import DECODING_ERRORS, JSON_ERRORS
from gscompleter.splats.glb import read_glb_meshes
from gscompleter.splats.packing import UnsupportedError
from gscompleter.splats.ply import MEANS
from gscompleter.system.damage import DamagedError, describe_damage
from gscompleter.system.errors import InputError, quote_value, require_path
from gscompleter.system.files.ply import (
    PLY_SCALARS,
    Element,
    PlyFile,
    parse_elements,
    read_ply_file,
)
from gscompleter.system.files.reading import read_bytes

Mesh = tuple[Float[ndarray, "n 3"], Int[ndarray, "m 3"]]
"""Vertices, and the triangles between them; none for points."""

NO_FACES = np.empty((0, 3), np.int64)
_FACE_LISTS = ("vertex_indices", "vertex_index")
"""Names of the list of a face's corners."""


def load_geometry(path: Path | str) -> GivenGeometry:
    """Load a mesh or points (.ply, .obj, .glb), for the argument `geometry` of a completion.

    Polygons are cut into triangles. Raises InputError for other files, and for damaged ones.
    """
    path = require_path(path)
    name = quote_value(path.name)
    read = READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(
            f"{quote_value(path)} is no geometry that is read; name a mesh or points as "
            f"{', '.join(READERS)}.",
            "geometry",
        )
    try:
        vertices, faces = read(path)
    except UnsupportedError as error:
        raise InputError(f"{quote_value(path)} {error}.", "geometry") from error
    except InputError:
        raise
    except (*DECODING_ERRORS, *JSON_ERRORS) as error:
        raise InputError(
            f"{quote_value(path)} cannot be read: {describe_damage(error)}; export it again.",
            "geometry",
        ) from error
    return make_geometry(vertices, faces, name)


def read_ply_geometry(path: Path) -> Mesh:
    """Read the vertices and faces of a .ply."""
    file = read_ply_file(path, MEANS, "mesh or point cloud")
    if "f_dc_0" in (file.rows.dtype.names or ()):
        raise UnsupportedError("holds Gaussians; name a mesh or points as geometry")
    vertices = np.stack([file.rows[name].astype(np.float64) for name in MEANS], axis=1)
    return vertices, _read_ply_faces(path, file)


def _read_ply_faces(path: Path, file: PlyFile) -> Int[ndarray, "m 3"]:
    """Read the faces of a .ply, which have to follow its vertices."""
    following = parse_elements(file.header)[1:]
    names = [element.name for element in following]
    number = names.index("face") if "face" in names else None
    if number is None or following[number].count == 0:
        return NO_FACES
    if any(element.count for element in following[:number]):
        raise UnsupportedError("has other elements between its vertices and its faces")
    face = following[number]
    if len(face.lists) != 1 or next(iter(face.lists)) not in _FACE_LISTS:
        raise UnsupportedError("has faces without one list of vertex indices")
    if file.is_ascii:
        return _read_ascii_faces(path, file, face)
    return _read_binary_faces(file, face)


def _read_ascii_faces(path: Path, file: PlyFile, face: Element) -> Int[ndarray, "m 3"]:
    """Read the faces of an ASCII .ply, whose rows follow those of its vertices."""
    place = list(face.dtype.names or ()).index(next(iter(face.lists)))
    lines = read_bytes(path)[len(file.header) :].split(b"\n")
    rows = [line.split() for line in lines if line.strip()]
    rows = rows[len(file.rows) : len(file.rows) + face.count]
    if len(rows) < face.count:
        raise DamagedError(f"it ends after {len(rows):,} of {face.count:,} faces")
    polygons = []
    for number, row in enumerate(rows, start=1):
        sides = int(row[place])
        corners = row[place + 1 :][: max(sides, 0)]
        if len(corners) != sides:
            raise DamagedError(f"face {number:,} has not the corners that it counts")
        polygons.append([int(corner) for corner in corners])
    return cut_polygons(polygons)


def _read_binary_faces(file: PlyFile, face: Element) -> Int[ndarray, "m 3"]:
    """Read the faces of a binary .ply, whose rows follow those of its vertices."""
    is_big_endian = re.search(rb"^format\s+binary_big_endian", file.header, re.MULTILINE)
    order = ">" if is_big_endian else "<"
    [(name, types)] = face.lists.items()
    number, index = (np.dtype(order + PLY_SCALARS[word]) for word in types)
    names = face.dtype.names or ()
    place = names.index(name)
    before = sum(face.dtype[column].itemsize for column in names[:place])
    after = sum(face.dtype[column].itemsize for column in names[place + 1 :])
    count = face.count
    data = np.asarray(file.trailer)

    # Nearly all files have triangles alone, whose rows are equally long.
    row = np.dtype(
        [
            ("before", f"V{before}"),
            ("number", number),
            ("corners", index, 3),
            ("after", f"V{after}"),
        ]
    )
    if len(data) >= count * row.itemsize:
        rows = np.frombuffer(data, row, count)
        if (rows["number"] == 3).all():
            return rows["corners"].astype(np.int64)

    polygons: list[list[int]] = []
    start = 0
    for _ in range(count):
        start += before
        if start + number.itemsize > len(data):
            raise DamagedError(f"it ends after {len(polygons):,} of {count:,} faces")
        sides = int(np.frombuffer(data, number, 1, start)[0])
        start += number.itemsize
        if sides < 0:
            raise DamagedError(f"face {len(polygons) + 1:,} has not the corners that it counts")
        if start + sides * index.itemsize + after > len(data):
            raise DamagedError(f"it ends after {len(polygons):,} of {count:,} faces")
        polygons.append(np.frombuffer(data, index, sides, start).tolist())
        start += sides * index.itemsize + after
    return cut_polygons(polygons)


def read_obj_geometry(path: Path) -> Mesh:
    """Read the vertices (v) and faces (f) of a .obj; all else is for looks."""
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    # As bytes, whose lines end with line feeds and carriage returns alone: comments may hold
    # other characters that Python takes for ends of a line.
    for number, line in enumerate(read_bytes(path).splitlines(), 1):
        match line.split():
            case [b"v", *coordinates]:
                # A short one cannot be left out: the indices after it would mean other vertices.
                try:
                    x, y, z = map(float, coordinates[:3])
                except ValueError as error:
                    raise DamagedError(f"line {number} is no vertex") from error
                vertices.append([x, y, z])
            case [b"f", *corners]:
                try:
                    indices = [int(corner.partition(b"/")[0]) for corner in corners]
                except ValueError as error:
                    raise DamagedError(f"line {number} is no face") from error
                if 0 in indices:
                    raise DamagedError(f"line {number} has the index 0, and indices begin with 1")
                # Indices count from 1, or back from the last vertex so far.
                polygons.append([i - 1 if i > 0 else len(vertices) + i for i in indices])
    if not vertices:
        raise DamagedError("it holds no vertices")
    return np.array(vertices), cut_polygons(polygons)


def cut_polygons(polygons: Iterable[list[int]]) -> Int[ndarray, "m 3"]:
    """Cut polygons into triangles that share their first corner."""
    triangles = [
        (corners[0], corners[i], corners[i + 1])
        for corners in polygons
        for i in range(1, len(corners) - 1)
    ]
    return np.array(triangles, np.int64).reshape(-1, 3)


READERS = {".ply": read_ply_geometry, ".obj": read_obj_geometry, ".glb": read_glb_meshes}
"""Readers by ending."""

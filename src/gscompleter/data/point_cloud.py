"""Point clouds in PLY files, from structure from motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.errors import InputError, quote_value
from gscompleter.io.ply import Element, read_header, read_vertices
from gscompleter.reading import open_file

AXES = ("x", "y", "z")


def read_point_cloud(path: Path) -> Float[np.ndarray, "n 3"]:
    """Read the vertices of a PLY file, in scene units."""
    try:
        with open_file(path) as file:
            file_format, elements = read_header(file, path)
            vertex = next((e for e in elements if e.name == "vertex"), None)
            if vertex is None or not _is_table(vertex):
                raise InputError(
                    f"{quote_value(path)} holds no points with x, y and z; export them again."
                )
            ahead = elements[: elements.index(vertex)]
            vertices = read_vertices(file, file_format, ahead, vertex, path)
    except OSError as error:
        raise InputError(
            f"{quote_value(path)} cannot be read: {error.strerror}; correct the path."
        ) from error
    return np.stack([vertices[axis].astype(np.float64) for axis in AXES], axis=-1)


def _is_table(vertex: Element) -> bool:
    names = [prop.name for prop in vertex.properties]
    return set(AXES) <= set(names) and len(set(names)) == len(names) and not vertex.has_lists

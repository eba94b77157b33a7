"""Gaussians in binary glTF (.glb) with the extension KHR_gaussian_splatting.

A primitive of points has one attribute per property: linear scales, opacities in [0, 1], xyzw
rotations, and a `SH_DEGREE_d_COEF_i` of three channels for each SH coefficient. Nodes give its
transform to the scene. Axes are x left, y up, z forward. All numbers are written as float32, with
linear colours for viewers that show points only. KHR_gaussian_splatting_compression_spz, whose
buffer holds a .spz in place of the attributes, is read.

Of a damaged file the readers raise `DECODING_ERRORS` and `JSON_ERRORS` (`splats/formats.py`), among
them `DamagedError`; of an intact one that they do not know, `UnsupportedError`.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from numpy import ndarray
from torch import Tensor

from gscompleter.numerics.geometry import quats_to_rotations
from gscompleter.splats.packing import (
    UnsupportedError,
    build_gaussians,
    check_count,
    with_labels,
)
from gscompleter.splats.provenance import KEY, NOTHING_KNOWN, Provenance
from gscompleter.splats.splat_format import FormatTexts, SplatFormat
from gscompleter.splats.spz import decode_spz
from gscompleter.splats.transform import (
    HALF_TURN_Z,
    merge_placed,
    place_gaussians,
    require_similarity,
    rotate_half_turn,
)
from gscompleter.system.damage import DamagedError, check_rows
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_bytes
from gscompleter.system.files.writing import replace_file
from gscompleter.types import SH_C0, Gaussians, Origin

GLB_MAGIC = b"glTF"
FILE_HEADER = struct.Struct("<4sII")
CHUNK_HEADER = struct.Struct("<II")
JSON_CHUNK = 0x4E4F534A
"""Type of the chunk of JSON: its name in ASCII."""
BINARY = 0x004E4942
"""Type of the binary chunk: "BIN" in ASCII."""
EXTENSION = "KHR_gaussian_splatting"
COMPRESSIONS = tuple(f"{EXTENSION}_compression_spz{version}" for version in ("", "_2"))
"""Extensions whose buffer holds a .spz: the name, and that of its later drafts."""
SH_NAMES = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{i}" for d in range(4) for i in range(2 * d + 1)]
LABELS_ATTRIBUTE = "_GENERATED"
"""Attribute of the labels, if anything was generated; names of applications begin with `_`."""
KNOWN_ATTRIBUTES = {
    *("POSITION", "NORMAL", "COLOR_0", LABELS_ATTRIBUTE, *SH_NAMES),
    *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")),
}
"""Attributes that are read, and what viewers of points show."""
KERNEL = "ellipse"
"""The shape of all Gaussians of 3DGS."""
COLOR_SPACE = "srgb_rec709_display"
"""The colour space in which all splat trainers work."""
COMPONENT_TYPES = {
    5120: "<i1",
    5121: "<u1",
    5122: "<i2",
    5123: "<u2",
    5125: "<u4",
    5126: "<f4",
}
"""numpy names of the component types."""
FLOAT = 5126
"""Component type that is written."""
POINTS = 0
"""Primitive mode that is written."""
TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN = 4, 5, 6
"""Primitive modes of meshes."""
NUM_COMPONENTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
MAX_FILE_BYTES = 2**32 - 1
"""Largest size that the header of a .glb can state."""
MAX_PRIMITIVES = 10_000
"""Most primitives of a scene; nodes that share meshes could name any number of them, and primitives
that share accessors any number of Gaussians, vertices and triangles (`check_count`)."""


class GlbDocument(NamedTuple):
    """The JSON and binary parts of a .glb."""

    table: dict[str, Any]
    binary: bytes


def read_glb(path: Path, leaves_out_band_4: bool = False) -> Gaussians:
    """Read all Gaussians of the scene in a .glb, in the axes of a .ply.

    A .spz in it may have harmonics of degree 4, which are refused or read without the fourth band.
    """
    document = _parse_document(read_bytes(path))
    placed = []
    count = 0
    # All are counted before any is decoded.
    for primitive, place in _find_primitives(document):
        placed.append((primitive, place))
        count += int(_get_accessor(document, primitive, "POSITION")["count"])
        check_count(count, len(document.binary))
    if not placed:
        raise UnsupportedError(_describe_other_content(document.table))
    parts = [
        place_gaussians(_decode_primitive(document, primitive, leaves_out_band_4), place)
        for primitive, place in placed
    ]
    return rotate_half_turn(merge_placed(parts), HALF_TURN_Z)


def read_glb_record(path: Path) -> object:
    """Read the record in the `extras` of the asset, or None if there is none."""
    table = _parse_document(read_bytes(path)).table
    return table.get("asset", {}).get("extras", {}).get(KEY)


def list_glb_names(path: Path) -> list[str]:
    """List the attributes of the Gaussians of a .glb that are not read, named as in a .ply."""
    primitives = _find_primitives(_parse_document(read_bytes(path)))
    attributes = dict.fromkeys(name for one, _ in primitives for name in one["attributes"])
    # Attributes of applications begin with `_`, as `_TRBF_CENTER`.
    further = [
        name.removeprefix(f"{EXTENSION}:") for name in attributes if name not in KNOWN_ATTRIBUTES
    ]
    return [name.lstrip("_").lower() for name in further]


def _describe_other_content(table: dict[str, Any]) -> str:
    """Describe a .glb without Gaussians of the final extension."""
    names = [name for name in table.get("extensionsUsed", ()) if "gaussian" in str(name).lower()]
    if names:
        return f"stores Gaussians by {quote_value(names[0])}, a draft or another extension"
    return f"holds a mesh or points, no Gaussians ({EXTENSION})"


def _parse_document(data: bytes) -> GlbDocument:
    chunks: dict[int, bytes] = {}
    start = FILE_HEADER.size
    while start < len(data):
        if len(data) - start < CHUNK_HEADER.size:
            raise DamagedError("it ends within the header of a chunk")
        size, kind = CHUNK_HEADER.unpack_from(data, start)
        start += CHUNK_HEADER.size + size
        if start > len(data):
            raise DamagedError(f"it ends after {len(data):,} of {start:,} bytes")
        chunks.setdefault(kind, data[start - size : start])
    if JSON_CHUNK not in chunks:
        raise DamagedError("it holds no description of its content")
    return GlbDocument(json.loads(chunks[JSON_CHUNK]), chunks.get(BINARY, b""))


def _find_primitives(
    document: GlbDocument,
) -> Iterator[tuple[dict[str, Any], Float[Tensor, "4 4"]]]:
    """Find the primitives of Gaussians in the scene, each with its transform to the scene.

    Of others, such as a mesh beside them, the transform may be any. Gaussians can only follow a
    similarity: an UnsupportedError is raised if their nodes, taken together, are none.
    """
    for primitive, place in _walk_primitives(document):
        if EXTENSION in primitive.get("extensions", {}):
            require_similarity(place, "node")
            yield primitive, place


def _walk_primitives(
    document: GlbDocument,
) -> Iterator[tuple[dict[str, Any], Float[Tensor, "4 4"]]]:
    """Walk through the primitives of the scene, of any kind, each with its transform to the scene.

    A primitive comes once for each node that has its mesh. Raises DamagedError if there are more
    than `MAX_PRIMITIVES`.
    """
    count = 0
    for node, place in _walk_nodes(document):
        if "mesh" not in node:
            continue
        for primitive in document.table["meshes"][node["mesh"]]["primitives"]:
            count += 1
            if count > MAX_PRIMITIVES:
                raise DamagedError(f"it claims to hold more than {MAX_PRIMITIVES:,} primitives")
            yield primitive, place


def _walk_nodes(
    document: GlbDocument,
) -> Iterator[tuple[dict[str, Any], Float[Tensor, "4 4"]]]:
    """Walk through the nodes of the scene, each with its transform to the scene."""
    table = document.table
    nodes = table.get("nodes", [])
    scenes = table.get("scenes")
    if scenes:
        roots = scenes[table.get("scene", 0)].get("nodes", [])
    else:
        # All trees of nodes are shown.
        below = {child for node in nodes for child in node.get("children", ())}
        roots = [index for index in range(len(nodes)) if index not in below]
    # Breadth first, with the transform of each node's parent to the scene. In a tree no node comes
    # twice.
    waiting = [(index, torch.eye(4, dtype=torch.float64)) for index in roots]
    visited: set[int] = set()
    while waiting:
        index, above = waiting.pop(0)
        if index in visited:
            raise DamagedError("its nodes contain each other")
        visited.add(index)
        node = nodes[index]
        place = above @ _read_transform(node)
        waiting += [(child, place) for child in node.get("children", ())]
        yield node, place


def _read_transform(node: dict[str, Any]) -> Float[Tensor, "4 4"]:
    """Read the transform of a node to the one above it."""
    if "matrix" in node:
        # Stored column by column.
        return _read_vector(node["matrix"], 16).reshape(4, 4).T
    # From xyzw to wxyz.
    quat = _read_vector(node.get("rotation", (0, 0, 0, 1)), 4).roll(1)
    place = torch.eye(4, dtype=torch.float64)
    place[:3, :3] = quats_to_rotations(quat)
    place[:3, :3] *= _read_vector(node.get("scale", (1, 1, 1)), 3)
    place[:3, 3] = _read_vector(node.get("translation", (0, 0, 0)), 3)
    return place


def _read_vector(numbers: Any, length: int) -> Float[Tensor, "k"]:
    """Read `length` numbers of the JSON part, in float64."""
    vector = torch.tensor(numbers, dtype=torch.float64)
    if vector.shape != (length,):
        raise DamagedError(f"a node has other than {length} numbers for a part of its transform")
    return vector


def read_glb_meshes(path: Path) -> tuple[Float[ndarray, "n 3"], Int[ndarray, "m 3"]]:
    """Read the vertices and triangles of a .glb that holds a mesh, or the points of one.

    Coordinates are those of the scene of the file: they are not turned to the axes of a .ply.
    """
    document = _parse_document(read_bytes(path))
    vertices = [np.empty((0, 3))]
    faces = [np.empty((0, 3), np.int64)]
    count = 0
    num_triangles = 0
    for primitive, place in _walk_primitives(document):
        if EXTENSION in primitive.get("extensions", {}):
            raise UnsupportedError("holds Gaussians; name a mesh or points as geometry")
        if primitive.get("extensions", {}).get("KHR_draco_mesh_compression"):
            raise UnsupportedError("holds a mesh compressed by Draco; export it without that")
        accessor = _get_accessor(document, primitive, "POSITION")
        points = _read_accessor(document, accessor, "vertices")
        linear, shift = place[:3, :3].numpy(), place[:3, 3].numpy()
        vertices.append(points.astype(np.float64) @ linear.T + shift)
        # Corners are counted through the vertices of all primitives.
        triangles = count + _read_triangles(document, primitive, len(points))
        faces.append(triangles)
        # Either may be shared where the other is not: primitives of few vertices may have as many
        # triangles as they have indices.
        count += len(points)
        check_count(count, len(document.binary), "vertices")
        num_triangles += len(triangles)
        check_count(num_triangles, len(document.binary), "triangles")
    if count == 0:
        raise UnsupportedError("holds neither a mesh nor points")
    return np.concatenate(vertices), np.concatenate(faces)


def _read_triangles(
    document: GlbDocument, primitive: dict[str, Any], count: int
) -> Int[ndarray, "m 3"]:
    """Read the triangles of a primitive of `count` vertices, as indices of these.

    Which side of a triangle is its front is not kept: every second one of a strip is turned over.
    """
    order = np.arange(count, dtype=np.int64)
    if "indices" in primitive:
        accessor = document.table["accessors"][primitive["indices"]]
        order = _read_numbers(document, accessor, "corners")[:, 0].astype(np.int64)
        # An index that is too large would be a vertex of the next primitive.
        if order.size and not 0 <= order.min() <= order.max() < count:
            raise DamagedError(f"a triangle has a corner beyond its {count:,} vertices")
    mode = primitive.get("mode", TRIANGLES)
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if mode == TRIANGLE_STRIP:
        return np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
    if mode == TRIANGLE_FAN:
        # All share the first corner.
        first = np.repeat(order[:1], max(len(order) - 2, 0))
        return np.stack([first, order[1:-1], order[2:]], axis=1)
    # Points and lines have no surface; their vertices count as points.
    return np.empty((0, 3), np.int64)


def _get_accessor(document: GlbDocument, primitive: dict[str, Any], name: str) -> dict[str, Any]:
    return document.table["accessors"][primitive["attributes"][name]]


def _find_compression(primitive: dict[str, Any]) -> dict[str, Any] | None:
    """Find the extension of a primitive whose buffer holds a .spz; None if there is none."""
    extensions = primitive["extensions"][EXTENSION].get("extensions", {})
    return next((extensions[name] for name in COMPRESSIONS if name in extensions), None)


def _decode_packed(
    document: GlbDocument,
    primitive: dict[str, Any],
    compression: dict[str, Any],
    leaves_out_band_4: bool,
) -> Gaussians:
    """Decode the .spz of a primitive, in the frame of its node."""
    view = document.table["bufferViews"][compression["bufferView"]]
    if view.get("buffer") != 0:
        raise UnsupportedError("holds its Gaussians in another file")
    start = int(view.get("byteOffset", 0))
    packed = document.binary[start : start + int(view["byteLength"])]
    # With the axes of a .ply, which are turned to those of glTF: a node gives its transform there.
    gaussians = decode_spz(packed, 4 if leaves_out_band_4 else 3)
    if len(gaussians) != _get_accessor(document, primitive, "POSITION")["count"]:
        raise DamagedError("its .spz has another number of Gaussians than its accessors")
    return rotate_half_turn(gaussians, HALF_TURN_Z)


def _decode_primitive(
    document: GlbDocument, primitive: dict[str, Any], leaves_out_band_4: bool
) -> Gaussians:
    """Decode the Gaussians of a primitive, in the frame of its node."""
    compression = _find_compression(primitive)
    if compression is not None:
        return _decode_packed(document, primitive, compression, leaves_out_band_4)
    extension = primitive["extensions"][EXTENSION]
    # Any further extension may store the same attributes in another way.
    extensions = ", ".join({**extension.get("extensions", {}), **primitive["extensions"]})
    kernel = extension.get("kernel", KERNEL)
    color_space = extension.get("colorSpace", COLOR_SPACE)
    stored = (extensions, kernel, color_space)
    if stored != (EXTENSION, KERNEL, COLOR_SPACE):
        raise UnsupportedError(f"stores Gaussians in an unknown way, {quote_value(stored)}")
    if f"{EXTENSION}:ROTATION" not in primitive["attributes"]:
        raise UnsupportedError(f"stores Gaussians as a draft of {EXTENSION} did")

    def find_attribute(name: str, kind: str) -> dict[str, Any]:
        accessor = _get_accessor(document, primitive, name)
        if accessor["type"] != kind:
            raise DamagedError(f"its attribute {name} is no {kind}")
        return accessor

    def read_attribute(name: str, kind: str = "VEC3") -> Float[ndarray, "n k"]:
        return _read_accessor(document, find_attribute(name, kind))

    sh = [read_attribute(name) for name in SH_NAMES if name in primitive["attributes"]]
    gaussians = build_gaussians(
        read_attribute("POSITION"),
        np.roll(read_attribute(f"{EXTENSION}:ROTATION", "VEC4"), 1, axis=1),
        read_attribute(f"{EXTENSION}:SCALE"),
        read_attribute(f"{EXTENSION}:OPACITY", "SCALAR")[:, 0],
        np.stack(sh, axis=1),
    )
    if LABELS_ATTRIBUTE not in primitive["attributes"]:
        return gaussians
    # Labels are whole numbers, of whatever type: here bytes do not stand for fractions.
    accessor = find_attribute(LABELS_ATTRIBUTE, "SCALAR")
    return with_labels(gaussians, _read_numbers(document, accessor, "Gaussians")[:, 0])


def _read_accessor(
    document: GlbDocument, accessor: dict[str, Any], what: str = "Gaussians"
) -> Float[ndarray, "n k"]:
    """Read the numbers of an accessor as float32.

    Integers that are `normalized` stand for fractions of the largest one; others for themselves,
    which positions, sizes and SH may be. `what` its rows are is for errors.
    """
    stored = _read_numbers(document, accessor, what)
    values = stored.astype(np.float32)
    if stored.dtype.kind == "f":
        return values
    if accessor.get("normalized"):
        # Signed ones are symmetric: the lowest one stands for -1, too.
        return np.maximum(values / np.iinfo(stored.dtype).max, -1)
    if values.shape[1] != 3:
        raise UnsupportedError("has rotations or opacities that are no fractions")
    return values


def _read_numbers(
    document: GlbDocument, accessor: dict[str, Any], what: str
) -> Shaped[ndarray, "n k"]:
    """Read the numbers of an accessor from the binary part, as they are stored.

    `what` its rows are is for errors.
    """
    view = {} if "sparse" in accessor else document.table["bufferViews"][accessor["bufferView"]]
    if view.get("buffer") != 0 or view.get("extensions"):
        raise UnsupportedError("holds its numbers sparse, compressed or in another file")
    kind = np.dtype(COMPONENT_TYPES[accessor["componentType"]])
    width = NUM_COMPONENTS[accessor["type"]]
    start = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
    stride = int(view.get("byteStride", 0)) or width * kind.itemsize
    shape = (int(accessor["count"]), width)
    # The last row may be shorter than the distance between two.
    num_bytes = len(document.binary) - start + max(stride - width * kind.itemsize, 0)
    check_rows(num_bytes, stride, shape[0], what)
    return np.ndarray(shape, kind, document.binary, start, (stride, kind.itemsize))


def write_glb(path: Path, gaussians: Gaussians, made_by: Provenance = NOTHING_KNOWN) -> None:
    """Write a .glb whose scene is one primitive of Gaussians, with all SH, at their origin."""
    turned = rotate_half_turn(gaussians, HALF_TURN_Z)
    columns = _make_columns(turned)
    scene = _describe_scene(columns, turned.origin)
    if made_by.runs:
        scene["asset"]["extras"] = {KEY: made_by.to_json()}
    text = json.dumps(scene).encode()
    # Chunks are aligned to four bytes, JSON with spaces.
    text += b" " * (-len(text) % 4)
    size = sum(column.nbytes for column in columns.values())
    total = FILE_HEADER.size + 2 * CHUNK_HEADER.size + len(text) + size
    if total > MAX_FILE_BYTES:
        raise InputError(f"{quote_value(path)} would exceed the 4 GiB of a .glb; write a .ply.")
    with replace_file(path) as file:
        file.write(FILE_HEADER.pack(GLB_MAGIC, 2, total))
        file.write(
            CHUNK_HEADER.pack(len(text), JSON_CHUNK) + text + CHUNK_HEADER.pack(size, BINARY)
        )
        for column in columns.values():
            file.write(column.data)


def _make_columns(gaussians: Gaussians) -> dict[str, Float[ndarray, "n k"]]:
    """Make the attributes of the primitive by name, from Gaussians in the axes of glTF."""
    opacities = gaussians.opacities[:, None]
    quats = gaussians.quats
    rgb = (0.5 + SH_C0 * gaussians.sh[:, 0]).clamp(0, 1)
    # The inverse of the transfer function of sRGB.
    linear = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    columns = {
        "POSITION": gaussians.means,
        "COLOR_0": torch.cat([linear, opacities], dim=1),
        f"{EXTENSION}:ROTATION": torch.nn.functional.normalize(quats, dim=1).roll(-1, dims=1),
        f"{EXTENSION}:SCALE": gaussians.scales,
        f"{EXTENSION}:OPACITY": opacities,
        **dict(zip(SH_NAMES, gaussians.sh.unbind(1), strict=False)),
    }
    if gaussians.generated.any():
        columns[LABELS_ATTRIBUTE] = gaussians.generated[:, None].float()
    return {name: np.require(tensor.numpy(), "<f4", ["C"]) for name, tensor in columns.items()}


def _describe_scene(
    columns: dict[str, Float[ndarray, "n k"]], origin: Origin | None
) -> dict[str, Any]:
    """Describe a scene of one primitive whose attributes follow each other in the binary part."""
    kinds = {count: kind for kind, count in NUM_COMPONENTS.items()}
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    size = 0
    for view, values in enumerate(columns.values()):
        views.append({"buffer": 0, "byteOffset": size, "byteLength": values.nbytes})
        form = {"componentType": FLOAT, "count": len(values), "type": kinds[values.shape[1]]}
        accessors.append({"bufferView": view, **form})
        size += values.nbytes
    means = columns["POSITION"]
    # The standard demands bounds of positions.
    accessors[0] |= {"min": means.min(0).tolist(), "max": means.max(0).tolist()}
    primitive = {
        "attributes": {name: index for index, name in enumerate(columns)},
        "mode": POINTS,
        "extensions": {EXTENSION: {"kernel": KERNEL, "colorSpace": COLOR_SPACE}},
    }
    return {
        "asset": {"version": "2.0", "generator": "gscompleter"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0} if origin is None else {"mesh": 0, "translation": list(origin)}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": size}],
        "bufferViews": views,
        "accessors": accessors,
    }


GLB = SplatFormat(
    name="glb",
    endings=(".glb",),
    texts=FormatTexts(
        title="KHR_gaussian_splatting",
        read="float and fractional attributes, a .spz in their place "
        "(`KHR_gaussian_splatting_compression_spz` and `…_spz_2`), nodes with rotation, uniform "
        "scale and shift, `srgb_rec709_display`",
        written="one node, all harmonics, linear `COLOR_0` for viewers that show points",
        precision="bit for bit, rotations normalised",
        axes="x left, y up, z forward",
        places={
            "holds_labels": "attribute `_GENERATED` of the primitive",
            "read_record": "`asset.extras.provenance`",
            "holds_origin": "the shift of a node",
            "list_names": "those of Gaussians",
        },
    ),
    read=read_glb,
    starts=(GLB_MAGIC,),
    write=write_glb,
    read_record=read_glb_record,
    list_names=list_glb_names,
    holds_labels=True,
    holds_origin=True,
    is_y_up=True,
    has_json=True,
    can_leave_out_band_4=True,
)

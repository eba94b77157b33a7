"""Files and folders that are no splat of a format we read, each named for what it is.

A sentence names what the file is and what to give instead: "cannot be read" would send people to
look for damage in an intact file.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from contextlib import suppress
from pathlib import Path

from gscompleter.data.file_names import is_photograph_name
from gscompleter.data.formats import find_format
from gscompleter.data.frame import FOLDERS
from gscompleter.data.sfm.poses import holds_packed_splat
from gscompleter.splats.packing import ZIP_MAGIC
from gscompleter.splats.sog import LOD_KEY, LOD_META, META, is_meta_of_others
from gscompleter.splats.splat_format import HEAD_BYTES, list_zip
from gscompleter.splats.spz import GZIP, GZIP_BITS
from gscompleter.splats.table import FILE_ENDINGS, SPLAT_FORMATS, match_ending
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import list_entries, make_read_error, read_bytes, read_head

OF_STREAMED = (
    "in several levels of detail; write one of them to a .ply with `gscompleter convert`, and name "
    "that"
)
MAX_SEARCHED_JSON = 1 << 26
"""Largest JSON that is looked into, in bytes."""
JSON_ENDINGS = (".json", ".gltf", ".lcc", ".lcc2")
CHECKPOINTS = (".pt", ".pth", ".ckpt")
POINT_CLOUDS = (".las", ".laz", ".e57", ".pcd", ".xyz", ".pts")
POINT_CLOUD_STARTS = (b"LASF", b"ASTM-E57", b"# .PCD")
MESHES = (".obj", ".stl", ".fbx", ".dae", ".off")
WITH_SPLAT_TRANSFORM = (
    "write one of them to a .ply with PlayCanvas' splat-transform (its option select-lod), and "
    "name that"
)
STARTS = {
    b"RAD0": (
        "is a .rad of Spark, in levels of detail that Spark alone reads; name the .ply or .spz "
        "that it was made of"
    ),
    b"Kg\x00\x00": (
        "is a moving splat of splaTV, which shows it in a browser; name the .ply of one moment"
    ),
    b"PKFL": "is a checkpoint of LichtFeld Studio; open it there, export a .ply, and name that",
    b"spx": "is a .spx of Reall3D; write it as .ply with its converter gsbox, and name that",
}
"""Kinds of files by their first bytes."""
KINDS_BY_ENDING = {
    ".rad": STARTS[b"RAD0"],
    ".splatv": STARTS[b"Kg\x00\x00"],
    ".resume": STARTS[b"PKFL"],
    ".spx": STARTS[b"spx"],
    ".lcc": f"is the index of a scene of XGRIDS in levels of detail; {WITH_SPLAT_TRANSFORM}",
    ".lcc2": f"is the index of a scene of XGRIDS in levels of detail; {WITH_SPLAT_TRANSFORM}",
    ".psht": "is a project of Postshot; open it there, export a .ply, and name that",
    ".ssproj": "is a project of SuperSplat; open it there, export a .ply, and name that",
}
"""Kinds of files by their endings: their first bytes do not tell, or those of a .zip or of JSON."""
MACOS_FOLDER = "__MACOSX/"
"""Folder of a .zip in which macOS keeps what its file system knows of each file."""

SPLAT_NEIGHBOURS = (None, "cameras-json", "photograph")
"""Formats that a folder may have beside the splat that it stands for: a trainer keeps the cameras
of its photographs, which lie elsewhere, and renders."""

# Where trainers write their splats, below the folder of a model; the number is the iteration.
_PATTERNS = (
    "point_cloud/iteration_*/point_cloud.ply",  # Inria, and most that build on it
    "iteration_*/point_cloud.ply",
    "point_cloud.ply",
    "ply/point_cloud_*.ply",  # gsplat
    "point_cloud_*.ply",
    "splat_*.ply",  # LichtFeld Studio
    "export_*.ply",  # Brush
    "splat.ply",  # nerfstudio, OpenSplat
    "ckpts/*.ply",
)


def find_newest_splat(folder: Path) -> Path | None:
    """Find the splat of the newest iteration in a trainer's model folder, or None.

    The first pattern with a file decides; of several files, the largest number in the name, and
    then the next largest ones.
    """

    def list_numbers(path: Path) -> list[int]:
        # Beside the iteration a name may have smaller numbers: of a process, a copy or a version.
        numbers = re.findall(r"\d+", str(path.relative_to(folder)))
        return sorted((int(digits) for digits in numbers), reverse=True)

    for pattern in _PATTERNS:
        paths = [path for path in list_entries(folder, pattern) if path.is_file()]
        if paths:
            return max(paths, key=lambda path: (list_numbers(path), str(path)))
    return None


def holds_splat_alone(folder: Path) -> bool:
    """Check whether a folder stands for a splat: it holds one, and no photographs to work on.

    It is an unpacked .sog, a streamed scene (which `refuse_folder` names), or a trainer's model
    folder. Such a folder may have cameras, and renders below it.
    """
    if holds_packed_splat(folder) or os.path.isfile(folder / LOD_META):
        return True
    if find_newest_splat(folder) is None or find_format(folder) not in SPLAT_NEIGHBOURS:
        return False
    names = [name.lower() for name in os.listdir(folder)]
    return not any(name in FOLDERS or is_photograph_name(name) for name in names)


def resolve_splat(path: Path) -> Path:
    """Return the newest splat of a trainer's model folder; other paths stay as they are."""
    if not os.path.isdir(path) or is_packed_folder(path):
        return path
    return find_newest_splat(path) or path


def is_packed_folder(folder: Path) -> bool:
    """Check that a folder is an unpacked .sog, damaged ones included."""
    return os.path.isfile(folder / META) and not is_meta_of_others(folder / META)


def refuse_folder(path: Path) -> None:
    """Raise InputError for a folder without a splat."""
    name = quote_value(path)
    if os.path.isfile(path / LOD_META):
        raise InputError(f"{name} is a streamed scene ({LOD_META}) {OF_STREAMED}.")
    try:
        names = sorted(child for child in os.listdir(path) if not child.startswith("."))
    except OSError as error:
        raise make_read_error(path, error) from error
    indices = [child for child in names if child.lower().endswith((".lcc", ".lcc2"))]
    if indices:
        raise InputError(
            f"{name} holds {quote_value(indices[0])}, which {KINDS_BY_ENDING['.lcc']}."
        )
    ending_so = (child for child in names if child.lower().endswith(FILE_ENDINGS))
    inside = next((child for child in ending_so if not is_other_kind(path / child)), None)
    if inside is not None:
        raise InputError(
            f"{name} is a folder; name one of the splats in it, such as {quote_value(inside)}."
        )
    raise InputError(f"{name} is a folder without a splat; name the file of a splat.")


def is_other_kind(path: Path) -> bool:
    """Check that a file shares ending and first bytes with a format of splats, and is none.

    A .zip or JSON of any program may be named so. Damaged files stay those of their ending: their
    reader says what is wrong.
    """
    named = match_ending(path)
    head = read_head(path, HEAD_BYTES)
    if named is None or not head.lstrip().startswith(named.starts):
        return False
    return not any(row.begins(path, head) for row in SPLAT_FORMATS.values())


def is_named_splat(path: Path) -> bool:
    """Check whether a path is a file that is named as a splat.

    Photographs with cameras may be described by a file of such a name, as a .json or a .npz; then
    its content decides.
    """
    if not os.path.isfile(path) or match_ending(path) is None:
        return False
    return not is_other_kind(path) or find_format(path) is None


def refuse_foreign(path: Path, head: bytes) -> None:
    """Raise InputError for a file of a known kind that is no splat; `head` are its first bytes.

    No format has recognised the file by its content. Those without a header have any first bytes,
    so that a few of them decide nothing.
    """
    kind = _describe_by_content(path, head) or _describe_by_name(path.suffix.lower())
    if kind is not None:
        raise InputError(f"{quote_value(path)} {kind}.")


def _describe_by_content(path: Path, head: bytes) -> str | None:
    start = head.lstrip()
    if start[:15].lower().startswith((b"<!doctype html", b"<html")):
        return "is a web page; download the file that it links to"
    if head.startswith(ZIP_MAGIC):
        return _describe_zip(path)
    if head.startswith(GZIP) and (path.suffix.lower() == ".gz" or can_unpack_start(head)):
        return "is packed with gzip; unpack it (gunzip), and name the file inside"
    if start.startswith((b"{", b"[")):
        return _describe_json(path)
    if head.startswith(POINT_CLOUD_STARTS):
        return _describe_points()
    for first, kind in STARTS.items():
        if head.startswith(first):
            return kind
    return None


def can_unpack_start(head: bytes) -> bool:
    """Check that the first bytes of a file can be unpacked as those of gzip."""
    with suppress(zlib.error):
        zlib.decompressobj(GZIP_BITS).decompress(head)
        return True
    return False


def _describe_by_name(ending: str) -> str | None:
    if ending in KINDS_BY_ENDING:
        return KINDS_BY_ENDING[ending]
    if ending in CHECKPOINTS:
        return _describe_checkpoint()
    if ending in POINT_CLOUDS:
        return _describe_points()
    if ending in MESHES:
        return "is a mesh, not a splat; train a splat from photographs, and name its .ply"
    return None


def _describe_checkpoint() -> str:
    return (
        "is a checkpoint of a trainer or a network, not a splat; export the splat as .ply with "
        "that trainer (nerfstudio: ns-export gaussian-splat) and name the .ply"
    )


def _describe_points() -> str:
    return "is a point cloud, not a splat; train a splat from photographs, and name its .ply"


def _describe_zip(path: Path) -> str:
    """Describe a .zip that is none of a splat."""
    ending = path.suffix.lower()
    if ending in KINDS_BY_ENDING:
        return KINDS_BY_ENDING[ending]
    names = [name for name in list_zip(path) if not name.startswith(MACOS_FOLDER)]
    if any(name.endswith("data.pkl") for name in names) or ending in CHECKPOINTS:
        return _describe_checkpoint()
    if any(Path(name).name == LOD_META for name in names):
        return f"is a streamed scene {OF_STREAMED}, once it is unpacked"
    if names and all(name.endswith(".npy") for name in names):
        return "holds arrays of NumPy, no splat; name the file of a splat"
    splats = [name for name in names if name.lower().endswith(FILE_ENDINGS)]
    if splats:
        return f"is a .zip archive; unpack it, and name {quote_value(splats[0])} in it"
    return "is a .zip archive without a splat; name the file of a splat"


def _describe_json(path: Path) -> str | None:
    """Describe a JSON file that is none of a splat; None if it is no JSON."""
    table: object = None
    # By its name, one that is too large to look into, or damaged.
    is_json = path.suffix.lower() in JSON_ENDINGS
    with suppress(InputError, ValueError, RecursionError):
        table = json.loads(read_bytes(path, MAX_SEARCHED_JSON))
        is_json = True
    if not is_json:
        return None
    keys = set(table) if isinstance(table, dict) else set()
    ending = path.suffix.lower()
    if ending == ".gltf" or (keys >= {"asset"} and keys & {"meshes", "nodes", "scenes", "buffers"}):
        return "is glTF with its data in other files; export it as one .glb, or as .ply"
    if ending in KINDS_BY_ENDING:
        return KINDS_BY_ENDING[ending]
    if path.name.lower() == LOD_META or LOD_KEY in keys:
        return f"is the index of a streamed scene {OF_STREAMED}"
    return "is a JSON file without Gaussians; name the file of a splat, such as a .ply"

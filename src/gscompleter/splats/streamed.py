"""One level of detail of a streamed .sog: a `lod-meta.json` and a .sog for each level and place.

The tree in `lod-meta.json` has boxes, of which each names by level the file, the first Gaussian and
the number of Gaussians that show it. Level 0 is the finest.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gscompleter.splats.formats import decode_splat, list_property_names
from gscompleter.splats.ply import require_finite
from gscompleter.splats.properties import refuse_other_kinds
from gscompleter.splats.sog import LOD_KEY, LOD_META, META
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_json
from gscompleter.system.progress import track
from gscompleter.types import Gaussians, merge

MAX_NODES = 1_000_000
"""Most boxes of a tree."""
FILES_KEY = "filenames"
"""Key of an index that lists its files, by whose numbers the boxes name them."""
INDEX_ADVICE = "export the scene again"
"""Advice where an index cannot be read."""

FileRange = tuple[int, int, int]
"""Number of a file, of its first Gaussian, and of Gaussians."""


def is_streamed(path: Path) -> bool:
    """Check whether a path names a streamed scene: its folder, or its index."""
    index = locate_index(path)
    return index.name.lower() == LOD_META and index.is_file()


def list_streamed_files(path: Path) -> list[Path]:
    """List the files that the index of a streamed scene names, a folder or its `lod-meta.json`.

    They are none if it has no such list: `load_level` refuses it.
    """
    index = locate_index(path)
    table = read_json(index, INDEX_ADVICE)
    files = table.get(FILES_KEY) if isinstance(table, dict) else None
    return [index.parent / str(file) for file in files] if isinstance(files, list) else []


def locate_index(path: Path) -> Path:
    """Locate the index of a streamed scene, a folder or its `lod-meta.json`."""
    return path / LOD_META if path.is_dir() else path


def load_level(path: Path, level: int, drop_nonfinite: bool = False) -> Gaussians:
    """Load the Gaussians of one level of a streamed scene, a folder or its `lod-meta.json`.

    `drop_nonfinite` drops those with NaN, infinity or a zero quaternion instead of refusing them.

    Raises:
        InputError: The scene has no such level, its index or a file of this level is missing,
            damaged or outside of the folder, or what is not finite is not dropped.
    """
    index = locate_index(path)
    name = quote_value(index)
    table = read_json(index, INDEX_ADVICE)
    try:
        levels = int(table[LOD_KEY])
        files = [str(file) for file in table[FILES_KEY]]
        parts = sorted(set(_list_parts(table["tree"], level)))
        fits = all(0 <= file < len(files) and first >= 0 < count for file, first, count in parts)
    # An infinity, which JSON may write as 1e999, overflows.
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{name} is no index of levels; {INDEX_ADVICE}.") from error
    if not 0 <= level < levels:
        raise InputError(f"{name} has levels 0 to {levels - 1}, 0 the finest.", "level")
    if not fits or not parts:
        raise InputError(f"{name} names no Gaussians of level {level}; {INDEX_ADVICE}.")

    gaussians = []
    by_file: dict[int, list[FileRange]] = {}
    for part in parts:
        by_file.setdefault(part[0], []).append(part)
    for number, wanted in track(list(by_file.items()), "reading places"):
        place = _locate_sog(index, files[number])
        # Parts are rows of the file as it is, so that what is not finite goes afterwards.
        scene = decode_splat(place)
        refuse_other_kinds(list_property_names(place), place)
        if any(first + count > len(scene) for _, first, count in wanted):
            raise InputError(
                f"{quote_value(place)} has {len(scene):,} Gaussians, fewer than {name} says; "
                f"{INDEX_ADVICE}."
            )
        gaussians += [scene[first : first + count] for _, first, count in wanted]
    return require_finite(merge(gaussians), index, drop_nonfinite)


def _list_parts(tree: Mapping[str, Any], level: int) -> Iterator[FileRange]:
    """List what the boxes of a tree name for a level.

    What is no tree leaves as one of the errors that `load_level` converts.
    """
    nodes = [tree]
    for _ in range(MAX_NODES):
        if not nodes:
            return
        node = nodes.pop()
        part = node.get("lods", {}).get(str(level))
        if part is not None:
            yield int(part["file"]), int(part["offset"]), int(part["count"])
        nodes += node.get("children", [])
    raise ValueError("its tree has too many boxes")


def _locate_sog(index: Path, file: str) -> Path:
    """Locate a .sog that an index names, in its own folder or below."""
    path = index.parent / file
    if not path.resolve().is_relative_to(index.parent.resolve()):
        raise InputError(f"{quote_value(index)} names a file outside of its folder.")
    return path.parent if path.name == META else path

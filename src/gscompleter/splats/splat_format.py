"""The row of the table of splat formats that each format file brings along."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from gscompleter.system.files.reading import ZIP_ERRORS
from gscompleter.types import Gaussians

PLY_MAGIC = b"ply"
HEAD_BYTES = 8192
"""Bytes read to detect a format; the header of a compressed .ply fits."""


@dataclass(frozen=True, kw_only=True)
class FormatTexts:
    """What the tables of the documentation say of a format; rows that share them share a line."""

    title: str = ""
    """Whose format it is, in brackets after its endings."""
    read: str = "yes"
    """What is read of all that there is."""
    written: str = ""
    """What is written; empty for "yes", or "no" without a writer."""
    precision: str
    """How far a file keeps numbers; empty if it is never written."""
    axes: str = "as the .ply"
    places: Mapping[str, str] = field(default_factory=dict)
    """How a file holds what fields of the row say that it holds, by their names, where "yes" says
    too little."""


@dataclass(frozen=True)
class SplatFormat:
    """All that is known of a file format of Gaussians.

    A format is a file of this package that ends with its row, and an import in `table.py`. Readers
    return, and writers get, Gaussians in the axes of a 3DGS .ply, on the CPU.
    """

    name: str
    endings: tuple[str, ...]
    """Ends of names of its files. It is written to such a name; the first is said in sentences.
    A file that is named in the place of photographs counts as a splat by its ending alone, and so
    do names in a .zip that is no splat; of files in a folder, the content decides as well."""
    texts: FormatTexts
    read: Callable[..., Gaussians]
    """Takes a path. Damage may be raised as any error of a decoder, best as `DamagedError`."""
    starts: tuple[bytes, ...] = ()
    """First bytes of a file, white space aside; none if only the name tells the format."""
    recognize: Callable[[Path, bytes], bool] | None = None
    """Tells files of it, by path and first 8 KB, from others with the same first bytes; None if
    these bytes are its own."""
    write: Callable[..., None] | None = None
    """Takes a path and Gaussians, and the record of who made them if there is `read_record`; None
    for a format that is only read."""
    read_record: Callable[[Path], object] | None = None
    """Reads from a file who made it, as values of JSON, or None if it does not say; None for a
    format without a place for it, whose record lies beside the file."""
    list_names: Callable[[Path], list[str]] | None = None
    """Lists properties of a file that are not read, named as in a .ply; None for a format that can
    hold no others."""
    holds_labels: bool = False
    """True if a file holds the labels of generated Gaussians, which otherwise lie beside it; the
    record has its own field, `read_record`."""
    holds_origin: bool = False
    """True if a file holds the origin of Gaussians in float64; others get absolute positions."""
    holds_harmonics: bool = True
    """True if colours depend on the direction of view."""
    marks_antialiased: bool = False
    """True if a file says whether its Gaussians are antialiased."""
    is_sorted: bool = False
    """True if Gaussians are written along a Morton curve, where neighbours take fewer bits."""
    is_y_up: bool = False
    """True if the format defines y as up, which its reader turns to -y."""
    rounds_geometry: bool = False
    """True if positions and sizes take fewer bits than float32, so that their rounding is said."""
    has_json: bool = False
    """True if JSON tells what is where, so that values of another type are damage, too."""
    can_leave_out_band_4: bool = False
    """True if `read` takes `leaves_out_band_4`, to read harmonics of degree 4 without it."""
    extra: str = ""
    """Extra of the installation without which it is neither read nor written; empty for none."""

    @property
    def has_ply_header(self) -> bool:
        """True if a file begins with the header of a .ply, which may have comments."""
        return PLY_MAGIC in self.starts

    def begins(self, path: Path, head: bytes) -> bool:
        """Check by content whether a file has this format; `head` are its first bytes."""
        # An empty tuple begins nothing.
        if not head.lstrip().startswith(self.starts):
            return False
        return self.recognize is None or self.recognize(path, head)


def list_zip(path: Path) -> list[str]:
    """List the names in a .zip; none if it is damaged."""
    with suppress(*ZIP_ERRORS), zipfile.ZipFile(path) as archive:
        return archive.namelist()
    return []

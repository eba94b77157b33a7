"""Camera exports of other programs that are not supported, and what to export instead."""

from __future__ import annotations

import os
from pathlib import Path

from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import read_head

HEAD = 4096
EXPORT_ADVICE = {
    "Metashape": "export its cameras as COLMAP, which Metashape does since 2.2",
    "RealityScan": "export its registration as COLMAP",
    "Polycam": "turn it into nerfstudio's transforms.json by ns-process-data polycam",
}
PROJECTS = {
    ".psx": "Metashape",
    ".psz": "Metashape",
    ".rspj": "RealityScan",
    ".rcproj": "RealityScan",
}

POLYCAM_CAMERAS = ("cameras", "corrected_cameras")


def refuse_other_exports(path: Path) -> None:
    """Raise an InputError with advice if `path` holds cameras of an unsupported program."""
    files = sorted(path.iterdir()) if os.path.isdir(path) else [path]
    found = "Polycam" if _is_polycam(path) else None
    for file in files:
        if found is None and os.path.isfile(file):
            found, path = _detect_program(file), file
    if found is not None:
        raise InputError(
            f"{quote_value(path)} holds cameras of {found}, which cannot be read; "
            f"{EXPORT_ADVICE[found]}, or name a folder of the photographs alone."
        )


def _detect_program(file: Path) -> str | None:
    ending = file.suffix.lower()
    if ending in (".xml", ".csv"):
        head = _read_file_head(file)
        if ending == ".xml" and b"<document" in head and b"<chunk" in head:
            return "Metashape"
        if ending == ".csv" and head.startswith((b"#name,", b"#cameras")):
            return "RealityScan"
    return PROJECTS.get(ending)


def _read_file_head(file: Path) -> bytes:
    return read_head(file, HEAD).removeprefix(b"\xef\xbb\xbf")


def _is_polycam(path: Path) -> bool:
    """Check for Polycam's raw data, or the keyframes in it."""
    homes = (path / home / kind for home in ("", "keyframes") for kind in POLYCAM_CAMERAS)
    found = (sorted(home.glob("*.json"))[:1] for home in homes if os.path.isdir(home))
    cameras = (file for files in found for file in files)
    return any(b'"t_00"' in _read_file_head(file) for file in cameras)

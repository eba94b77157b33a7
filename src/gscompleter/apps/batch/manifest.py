"""Manifests of a batch: a CSV file, JSON lines, or a folder of scenes.

A row has the options of `complete` and, optionally, a `name`; the default is the name of the scene
folder. Empty CSV cells are ignored. Paths are relative to the manifest.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError, quote_value
from gscompleter.io.files import UNFINISHED_PREFIX
from gscompleter.io.reading import read_bytes
from gscompleter.jobs.jobs import Job, check_jobs, make_job_name
from gscompleter.jobs.places import is_address, open_store

FOLDER, NAME = "folder", "name"
"""Columns of the scene folder and of the job name."""
PATHS = (FOLDER, "scene", "weights")
"""Options that are paths."""
LONGEST_FILE = 2 * 10**9
"""Maximum number of bytes of a manifest."""


def read_manifest(manifest: str, common: Mapping[str, Any]) -> list[Job]:
    """Read the jobs of a `.csv` or `.jsonl` file or a folder of scenes, by path or address.

    Raises:
        InputError: The manifest cannot be read, names no job, or repeats a name.
    """
    base = os.path.dirname(os.path.abspath(manifest))
    here = resolve_paths(common, os.getcwd())
    rows = [
        {**here, **(row if is_address(manifest) else resolve_paths(row, base))}
        for row in read_rows(manifest)
    ]
    jobs = [Job(name, row) for name, row in zip(name_jobs(rows), map(drop_name, rows), strict=True)]
    check_jobs(jobs)
    return jobs


def resolve_paths(row: Mapping[str, Any], base: str) -> dict[str, Any]:
    """Make the paths of a row absolute; addresses and invalid values stay."""

    def join(value: Any) -> Any:
        path = isinstance(value, str) and value and not is_address(value)
        return os.path.join(base, value) if path else value

    result = {key: join(value) if key in PATHS else value for key, value in row.items()}
    target, config = result.get("target"), result.get("config")
    if isinstance(target, str) and not re.fullmatch(r"[\d\s]*", target):
        result["target"] = [join(target)]
    if isinstance(config, str) and config.endswith((".yaml", ".yml")):
        result["config"] = join(config)
    return result


def read_rows(manifest: str) -> list[dict[str, Any]]:
    """Read the rows of a manifest as they are."""
    if not is_address(manifest) and os.path.isdir(manifest):
        return [{FOLDER: os.path.abspath(folder)} for folder in list_scenes(Path(manifest))]
    if manifest.endswith(".csv"):
        return list(parse_csv(read_manifest_text(manifest), manifest))
    if manifest.endswith((".jsonl", ".ndjson")):
        return list(parse_json_lines(read_manifest_text(manifest), manifest))
    if is_address(manifest):
        store = open_store(manifest)
        found = [e for e in store.ls(manifest, detail=True) if e["type"] == "directory"]
        return [{FOLDER: store.unstrip_protocol(e["name"])} for e in found]
    raise InputError(
        f"The manifest {quote_value(manifest)} is neither a .csv or .jsonl file nor a folder of "
        "scenes; "
        "correct the path."
    )


def list_scenes(folder: Path) -> list[Path]:
    """List the visible folders in a folder by name."""
    return sorted(
        p
        for p in folder.iterdir()
        if p.is_dir() and not p.name.startswith((UNFINISHED_PREFIX, "."))
    )


def read_manifest_text(manifest: str) -> str:
    """Read the text of a manifest; raise InputError if that fails."""
    try:
        if is_address(manifest):
            return bytes(open_store(manifest).cat_file(manifest)).decode("utf-8-sig")
        return read_bytes(Path(manifest), LONGEST_FILE).decode("utf-8-sig")
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(
            f"The manifest {quote_value(manifest)} cannot be read: {reason}."
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(
            f"The manifest {quote_value(manifest)} is not text in UTF-8; save it as UTF-8."
        ) from error


def parse_csv(text: str, manifest: str) -> Iterator[dict[str, Any]]:
    """Parse the rows of a CSV file with a header."""
    try:
        for row in csv.DictReader(io.StringIO(text, newline=""), strict=True):
            given = {k: v.strip() for k, v in row.items() if isinstance(v, str) and v.strip()}
            if row.get(None) is not None:
                given["too many cells"] = " ".join(row[None])
            yield given
    except csv.Error as error:
        raise InputError(
            f"The manifest {quote_value(manifest)} is not valid CSV: {error}."
        ) from error


def parse_json_lines(text: str, manifest: str) -> Iterator[dict[str, Any]]:
    """Parse JSON lines."""
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"Line {number} of the manifest {quote_value(manifest)} is not JSON "
                f"({quote_value(str(error))}); correct it."
            ) from error
        if not isinstance(row, dict):
            raise InputError(
                f"Line {number} of the manifest {quote_value(manifest)} is not a JSON object; "
                "write it "
                'as {"folder": "scene", "target": [6]}.'
            )
        yield row


def name_jobs(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Name the jobs by their `name` or scene folder, numbered if several share a folder."""
    rows = list(rows)
    given = [make_job_name(str(row[NAME])) if NAME in row else None for row in rows]
    scenes = [make_job_name(os.path.basename(str(row.get(FOLDER, "")).rstrip("/"))) for row in rows]
    count, seen = (
        Counter(s for s, n in zip(scenes, given, strict=True) if n is None),
        Counter[str](),
    )
    names = []
    for name, scene in zip(given, scenes, strict=True):
        seen[scene] += name is None
        names.append(name or (scene if count[scene] == 1 else f"{scene}-{seen[scene]}"))
    return names


def drop_name(row: Mapping[str, Any]) -> dict[str, Any]:
    """Drop the name of a row."""
    return {key: value for key, value in row.items() if key != NAME}

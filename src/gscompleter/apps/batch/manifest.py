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
from collections.abc import Iterator, Mapping
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

Options = dict[str, Any]
"""Options of `complete` by name."""


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
    jobs = [
        Job(name, {key: value for key, value in row.items() if key != NAME})
        for name, row in zip(name_jobs(rows), rows, strict=True)
    ]
    check_jobs(jobs)
    return jobs


def resolve_paths(row: Mapping[str, Any], base: str) -> Options:
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


def read_rows(manifest: str) -> list[Options]:
    """Read the rows of a manifest as they are."""
    if not is_address(manifest) and os.path.isdir(manifest):
        names = (UNFINISHED_PREFIX, ".")
        folders = [p for p in Path(manifest).iterdir() if p.is_dir()]
        shown = sorted(p for p in folders if not p.name.startswith(names))
        return [{FOLDER: os.path.abspath(folder)} for folder in shown]
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
        "scenes; correct the path."
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


def parse_csv(text: str, manifest: str) -> Iterator[Options]:
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


def parse_json_lines(text: str, manifest: str) -> Iterator[Options]:
    """Parse JSON lines."""
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        place = f"Line {number} of the manifest {quote_value(manifest)}"
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"{place} is not JSON ({quote_value(str(error))}); correct it."
            ) from error
        if not isinstance(row, dict):
            raise InputError(
                f'{place} is not a JSON object; write it as {{"folder": "scene", "target": [6]}}.'
            )
        yield row


def name_jobs(rows: list[Options]) -> Iterator[str]:
    """Name the jobs by their `name` or scene folder, numbered if several share a folder."""
    scenes = [
        None
        if NAME in row
        else make_job_name(os.path.basename(str(row.get(FOLDER, "")).rstrip("/")))
        for row in rows
    ]
    count, seen = Counter(scenes), Counter[str]()
    for row, scene in zip(rows, scenes, strict=True):
        if scene is None:
            yield make_job_name(str(row[NAME]))
        else:
            seen[scene] += 1
            yield scene if count[scene] == 1 else f"{scene}-{seen[scene]}"

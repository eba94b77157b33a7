"""What is to be done: a CSV file, JSON lines, or a folder of scenes.

A row has the options of `complete` by their names, and may have a `name`. Without one it is called
as the folder of its scene. A cell of a CSV that is empty says nothing. Paths are relative to the
manifest.
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

from gscompleter.batch.jobs import Job, check_jobs, slug
from gscompleter.batch.places import is_address, store_of
from gscompleter.errors import InputError, quoted
from gscompleter.io.unfinished import MARK
from gscompleter.reading import read_bytes

FOLDER, NAME = "folder", "name"
"""What every row has: where the scene lies, and what the job is called."""
PATHS = (FOLDER, "scene", "weights")
"""Options that are paths."""
LONGEST_FILE = 2 * 10**9
"""Bytes of a manifest."""


def read_manifest(manifest: str, common: Mapping[str, Any]) -> list[Job]:
    """The jobs that a manifest names, in its order.

    Args:
        manifest: A file `.csv` or `.jsonl`, or a folder whose folders are scenes; a path or an
            address.
        common: Options of every row that has not its own.

    Raises:
        InputError: where it cannot be read, names no job, or gives two the same name.
    """
    base = os.path.dirname(os.path.abspath(manifest))
    here = placed(common, os.getcwd())
    rows = [
        {**here, **(row if is_address(manifest) else placed(row, base))}
        for row in rows_of(manifest)
    ]
    jobs = [Job(name, row) for name, row in zip(names_of(rows), map(plain, rows), strict=True)]
    check_jobs(jobs)
    return jobs


def placed(row: Mapping[str, Any], base: str) -> dict[str, Any]:
    """`row` with its paths from the root; addresses, numbers and what is wrong stay as they are."""

    def joined(value: Any) -> Any:
        path = isinstance(value, str) and value and not is_address(value)
        return os.path.join(base, value) if path else value

    result = {key: joined(value) if key in PATHS else value for key, value in row.items()}
    target, config = result.get("target"), result.get("config")
    if isinstance(target, str) and not re.fullmatch(r"[\d\s]*", target):
        result["target"] = [joined(target)]
    if isinstance(config, str) and config.endswith((".yaml", ".yml")):
        result["config"] = joined(config)
    return result


def rows_of(manifest: str) -> list[dict[str, Any]]:
    """The rows of a manifest, as they stand there."""
    if not is_address(manifest) and os.path.isdir(manifest):
        return [{FOLDER: os.path.abspath(folder)} for folder in scenes_in(Path(manifest))]
    if manifest.endswith(".csv"):
        return list(csv_rows(text_of(manifest), manifest))
    if manifest.endswith((".jsonl", ".ndjson")):
        return list(json_rows(text_of(manifest), manifest))
    if is_address(manifest):
        store = store_of(manifest)
        found = [e for e in store.ls(manifest, detail=True) if e["type"] == "directory"]
        return [{FOLDER: store.unstrip_protocol(e["name"])} for e in found]
    raise InputError(
        f"The manifest {quoted(manifest)} is neither a .csv or .jsonl file nor a folder of scenes; "
        "correct the path."
    )


def scenes_in(folder: Path) -> list[Path]:
    """The folders in a folder, by their names; hidden ones are none."""
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith((MARK, ".")))


def text_of(manifest: str) -> str:
    """The content of a manifest.

    Raises:
        InputError: where it cannot be read.
    """
    try:
        if is_address(manifest):
            return bytes(store_of(manifest).cat_file(manifest)).decode("utf-8-sig")
        return read_bytes(Path(manifest), LONGEST_FILE).decode("utf-8-sig")
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"The manifest {quoted(manifest)} cannot be read: {reason}.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"The manifest {quoted(manifest)} is no text in UTF-8.") from error


def csv_rows(text: str, manifest: str) -> Iterator[dict[str, Any]]:
    """The rows of a CSV file under its head."""
    try:
        for row in csv.DictReader(io.StringIO(text, newline=""), strict=True):
            given = {k: v.strip() for k, v in row.items() if isinstance(v, str) and v.strip()}
            if row.get(None) is not None:
                given["too many cells"] = " ".join(row[None])
            yield given
    except csv.Error as error:
        raise InputError(f"The manifest {quoted(manifest)} is no CSV: {error}.") from error


def json_rows(text: str, manifest: str) -> Iterator[dict[str, Any]]:
    """The rows of JSON lines."""
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"Line {number} of the manifest {quoted(manifest)} is not JSON "
                f"({quoted(str(error))}); correct it."
            ) from error
        if not isinstance(row, dict):
            raise InputError(
                f"Line {number} of the manifest {quoted(manifest)} is no object; write it as "
                '{"folder": "scene", "target": [6]}.'
            )
        yield row


def names_of(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """What the jobs of rows are called: as they say, or as the folder of the scene, with a number
    where several rows that have no name of their own share one."""
    rows = list(rows)
    said = [slug(str(row[NAME])) if NAME in row else None for row in rows]
    scenes = [slug(os.path.basename(str(row.get(FOLDER, "")).rstrip("/"))) for row in rows]
    count, seen = Counter(s for s, n in zip(scenes, said, strict=True) if n is None), Counter[str]()
    names = []
    for name, scene in zip(said, scenes, strict=True):
        seen[scene] += name is None
        names.append(name or (scene if count[scene] == 1 else f"{scene}-{seen[scene]}"))
    return names


def plain(row: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a row, without its name."""
    return {key: value for key, value in row.items() if key != NAME}

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
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from gscompleter.system.damage import DamagedError, describe_damage
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.names import fold_name, make_valid_name
from gscompleter.system.files.output_folder import read_command
from gscompleter.system.files.reading import list_folders, read_bytes
from gscompleter.system.jobs.jobs import Job
from gscompleter.system.plugins import is_in_file

FOLDER = "folder"
"""Column of the scene folder."""
NAME_COLUMN = "name"
"""Column of the job name."""
PATH_COLUMNS = (
    FOLDER,
    "scene",
    "cameras",
    "weights",
    "depth_weights",
    "images",
    "ignore",
    "geometry",
)
"""Options that are always a path."""
PROGRAM_COLUMNS = ("reconstructor", "depth", "generator")
"""Options that may name a function in a file of Python, as in `my_models.py:predict_depth`."""
MARKERS = ("batch.json", "run.json")
"""Files that mark the output folders of `batch` and `evaluate`."""
COMPLETING = ("complete", "clean", "demo")
"""Commands whose output folders hold scenes of Gaussians and no photographs."""
LONGEST_FILE = 2 * 10**9
"""Maximum number of bytes of a manifest."""
LONGEST_NAME = 120
"""Maximum number of characters of a job name."""

OptionValues = dict[str, Any]
"""Options of `complete` by name."""


def read_manifest(manifest: Path, common: Mapping[str, Any], out: Path | None = None) -> list[Job]:
    """Read the jobs of a `.csv` or `.jsonl` file or a folder of scenes.

    `common` are the options of all rows that do not set them. In a folder of scenes those of
    `list_results` are left out.
    """
    # Options of the command line count from the working folder, those of a row from the manifest,
    # and the row wins.
    base = manifest.resolve().parent
    here = resolve_paths(unify_names(common), Path.cwd())
    own = [unify_names(row) for row in read_manifest_rows(manifest, out)]
    rows = [{**here, **resolve_paths(row, base)} for row in own]
    if not rows:
        raise InputError("The manifest names no job; give it a row for each scene.")
    names = [make_job_name(row) for row in rows]
    # Where case does not count, two of them would be one folder.
    folded, count = Counter(map(fold_name, names)).most_common(1)[0]
    if count > 1:
        name = next(name for name in names if fold_name(name) == folded)
        raise InputError(
            f"Two jobs have the name {quote_value(name)}; give each row a name of its own."
        )
    return [
        Job(name, {key: value for key, value in row.items() if key != NAME_COLUMN})
        for name, row in zip(names, rows, strict=True)
    ]


def unify_names(row: Mapping[str, Any]) -> OptionValues:
    """Name options as in `depth_weights`, which may also be written as in `depth-weights`.

    Raise InputError if a row has both, of which only one would count.
    """
    counts = Counter(key.replace("-", "_") for key in row)
    for name, count in counts.items():
        if count > 1:
            raise InputError(
                f"A row has {quote_value(name)} in two spellings, with - and with _; give it once."
            )
    return {key.replace("-", "_"): value for key, value in row.items()}


def resolve_paths(row: Mapping[str, Any], base: Path) -> OptionValues:
    """Make the paths of a row absolute, `base` being their folder; invalid values stay."""

    def join(value: Any) -> Any:
        return os.path.join(base, value) if isinstance(value, str) and value else value

    def exists(value: Any) -> bool:
        return isinstance(value, str) and bool(value) and os.path.exists(join(value))

    result = {key: join(value) if key in PATH_COLUMNS else value for key, value in row.items()}
    for key in PROGRAM_COLUMNS:
        if is_in_file(result.get(key)):
            result[key] = join(result[key])
    # Other weights are names of the hub.
    for key in ("generator_weights", "generator_depth"):
        if exists(result.get(key)):
            result[key] = join(result[key])
    target = result.get("target")
    config = result.get("config")
    # A text is the path of a file of cameras, or else numbers and names of photographs. A list
    # keeps a path with spaces in one piece.
    if exists(target) and not re.fullmatch(r"[\d\s]*", str(target)):
        result["target"] = [join(target)]
    masks = result.get("mask")
    if isinstance(masks, str):
        masks = [masks] if exists(masks) else split_masks(masks)
    if isinstance(masks, list):
        result["mask"] = [join(mask) for mask in masks]
    if isinstance(config, str) and config.endswith((".yaml", ".yml")):
        result["config"] = join(config)
    return result


def split_masks(text: str) -> list[str]:
    """Split the paths of masks as a shell does; what it cannot split is one path."""
    with suppress(ValueError):
        return shlex.split(text) or [text]
    return [text]


def read_manifest_rows(manifest: Path, out: Path | None = None) -> list[OptionValues]:
    """Read the rows of a manifest as they are."""
    if os.path.isdir(manifest):
        results = list_results(manifest, out)
        folders = list_folders(manifest.resolve())
        return [{FOLDER: str(path)} for path in folders if path not in results]
    parsers = {".csv": parse_csv, ".jsonl": parse_json_lines, ".ndjson": parse_json_lines}
    if manifest.suffix not in parsers:
        raise InputError(
            f"The manifest {quote_value(manifest)} is neither a .csv or .jsonl file nor a folder "
            "of scenes; correct the path."
        )
    content = read_bytes(manifest, LONGEST_FILE)
    try:
        return list(parsers[manifest.suffix](content.decode("utf-8-sig")))
    except csv.Error as error:  # its words are about lines, quotation marks and the like
        raise InputError(
            f"The manifest {quote_value(manifest)} cannot be read: {quote_value(str(error))}; "
            "correct it."
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"The manifest {quote_value(manifest)} cannot be read: {describe_damage(error)}; "
            "correct it."
        ) from error


def list_results(manifest: Path, out: Path | None = None) -> list[Path]:
    """List the folders in a folder of scenes that hold results: `out`, and those of other runs."""
    return [path for path in list_folders(manifest.resolve()) if is_result(path, out)]


def is_result(folder: Path, out: Path | None) -> bool:
    """Return True for `out` itself and for what `batch`, `evaluate` and completions wrote.

    The output folder of `poses` is a scene.
    """
    if out is not None and os.path.realpath(folder) == os.path.realpath(out):
        return True
    has_marker = any(os.path.isfile(folder / name) for name in MARKERS)
    return has_marker or read_command(folder) in COMPLETING


def parse_csv(text: str) -> Iterator[OptionValues]:
    """Parse the rows of a CSV file with a header."""
    for row in csv.DictReader(io.StringIO(text, newline=""), strict=True):
        options = {k: v.strip() for k, v in row.items() if isinstance(v, str) and v.strip()}
        # `DictReader` collects cells beyond the header under None; as an option of this name they
        # are refused like any unknown one.
        if row.get(None) is not None:
            options["too many cells"] = " ".join(row[None])
        yield options


def parse_json_lines(text: str) -> Iterator[OptionValues]:
    """Parse JSON lines."""
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip():
            try:
                row = json.loads(line)
            except ValueError as error:
                raise DamagedError(f"line {number} is no JSON") from error
            if not isinstance(row, dict):
                raise DamagedError(f"line {number} is not a JSON object")
            yield row


def make_job_name(row: OptionValues) -> str:
    """Turn the name of a row, or that of its scene folder, into a valid file name."""
    name = str(row[NAME_COLUMN]) if NAME_COLUMN in row else Path(str(row.get(FOLDER, ""))).name
    return make_valid_name(name.strip(".")[:LONGEST_NAME]) or "job"

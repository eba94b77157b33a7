"""Manifests of a batch: a CSV file, JSON lines, or a folder of scenes.

A row has the options of `complete` and, optionally, a `name`; the default is the name of the scene
folder. Empty CSV cells are ignored. Paths are relative to the manifest. JSON may nest options, as
in {"config": {"holes": {"dilation": 3}}}, where CSV has a column `config.holes.dilation`.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from gscompleter.data.file_names import PHOTOGRAPH_ENDINGS
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
GUARDS_COLUMN = "config.guards"
"""Option with several words, each of which may name a class in a file of Python."""
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
    """Name options as in `config.holes.max_alpha`, so that each of them is told by its name.

    They may also be nested, or written as in `max-alpha`. Raise InputError if a row has two
    spellings of one, of which only one would count.
    """
    pairs = [(key.replace("-", "_"), value) for key, value in flatten_row(row)]
    if (name := find_repeated_name(name for name, _ in pairs)) is not None:
        raise InputError(
            f"A row has {quote_value(name)} in two spellings, such as with - and with _, or nested "
            "and with dots; give it once."
        )
    return dict(pairs)


def flatten_row(row: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Flatten nested options, as `{"holes": {"dilation": 3}}` to `holes.dilation`."""
    for key, value in row.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from flatten_row(value, f"{name}.")
        # Null leaves a column out. Nested it is the value None, which a command line cannot give.
        elif prefix and value is None:
            raise InputError(
                f"A row has null at {quote_value(name)}, which only a YAML file can set; leave it "
                f"out, or name such a file at {quote_value(prefix.partition('.')[0])}."
            )
        else:
            yield name, value


def find_repeated_name(names: Iterable[str]) -> str | None:
    """Find the first name that is there twice; None if there is none."""
    return next((name for name, count in Counter(names).items() if count > 1), None)


def resolve_paths(row: Mapping[str, Any], base: Path) -> OptionValues:
    """Make the paths of a row absolute, `base` being their folder; invalid values stay."""

    def join(value: Any) -> Any:
        return os.path.join(base, value) if isinstance(value, str) and value else value

    def exists(value: Any) -> bool:
        return isinstance(value, str) and bool(value) and os.path.exists(join(value))

    def is_file(word: Any) -> bool:
        # Numbers are those of photographs.
        return exists(word) and not re.fullmatch(r"[\d\s]*", word)

    def is_camera_file(word: Any) -> bool:
        return is_file(word) and not word.lower().endswith(PHOTOGRAPH_ENDINGS)

    def resolve_words(name: str, is_path: Callable[[Any], bool]) -> None:
        words = result.get(name)
        if isinstance(words, str):
            # The path of a file may have spaces; a list keeps it in one piece.
            words = [words] if is_file(words) else split_words(words)
        if isinstance(words, list):
            result[name] = [join(word) if is_path(word) else word for word in words]

    result = {key: join(value) if key in PATH_COLUMNS else value for key, value in row.items()}
    for key in PROGRAM_COLUMNS:
        if is_in_file(result.get(key)):
            result[key] = join(result[key])
    # Other weights are names of the hub.
    for key in ("generator_weights", "generator_depth"):
        if exists(result.get(key)):
            result[key] = join(result[key])
    # Photographs are those of the scene, wherever the manifest lies.
    resolve_words("target", is_camera_file)
    resolve_words("mask", lambda word: True)
    resolve_words(GUARDS_COLUMN, is_in_file)
    config = result.get("config")
    if isinstance(config, str) and config.endswith((".yaml", ".yml")):
        result["config"] = join(config)
    return result


def split_words(text: str) -> list[str]:
    """Split a text as a shell does; what it cannot split is one word."""
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
    parse = parsers.get(manifest.suffix.lower())
    if parse is None:
        raise InputError(
            f"The manifest {quote_value(manifest)} is neither a .csv or .jsonl file nor a folder "
            "of scenes; correct the path."
        )
    content = read_bytes(manifest, LONGEST_FILE)
    try:
        return list(parse(content.decode("utf-8-sig")))
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
    """Parse the rows of a CSV file with a header; white space around names and cells is ignored."""
    table = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    header = [name.strip() for name in table.fieldnames or ()]
    # `DictReader` keeps the last of two columns. Spreadsheets add empty columns without a name.
    if (name := find_repeated_name(filter(None, header))) is not None:
        raise DamagedError(f"it has the column {quote_value(name)} twice")
    table.fieldnames = header
    for row in table:
        options = {k: v.strip() for k, v in row.items() if isinstance(v, str) and v.strip()}
        # `DictReader` collects cells beyond the header under None; as an option of this name they
        # are refused like any unknown one.
        if surplus := " ".join(row.get(None) or ()).strip():
            options["too many cells"] = surplus
        yield options


def parse_json_lines(text: str) -> Iterator[OptionValues]:
    """Parse JSON lines."""
    # Not `splitlines`, which also splits at characters that a text in JSON may have, as U+2028.
    for number, line in enumerate(text.split("\n"), start=1):
        if line.strip():
            try:
                row = json.loads(line, object_pairs_hook=make_object)
            except DamagedError as error:
                raise DamagedError(f"line {number} {error}") from error
            except ValueError as error:
                raise DamagedError(f"line {number} is no JSON") from error
            if not isinstance(row, dict):
                raise DamagedError(f"line {number} is not a JSON object")
            yield row


def make_object(pairs: list[tuple[str, Any]]) -> OptionValues:
    """Make an object of JSON, or raise DamagedError for a name that is there twice."""
    if (name := find_repeated_name(name for name, _ in pairs)) is not None:
        raise DamagedError(f"has {quote_value(name)} twice")
    return dict(pairs)


def make_job_name(row: OptionValues) -> str:
    """Turn the name of a row, or that of its scene folder, into a valid file name."""
    given = row.get(NAME_COLUMN)
    name = Path(str(row.get(FOLDER, ""))).name if given in (None, "") else str(given)
    return make_valid_name(name.strip(".")[:LONGEST_NAME]) or "job"

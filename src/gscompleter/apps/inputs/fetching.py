"""Download of a job's inputs from object stores."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gscompleter.errors import InputError, quote_value
from gscompleter.jobs.places import is_address, open_store


@contextmanager
def download_inputs(options: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Replace addresses in the options of a row by downloaded files, inside the block."""
    with TemporaryDirectory(prefix="gscompleter-") as folder:
        yield {key: download_value(value, Path(folder) / key) for key, value in options.items()}


def download_value(value: Any, folder: Path) -> Any:
    """Download a value if it is an address."""
    if isinstance(value, list):
        return [download_value(item, folder / str(number)) for number, item in enumerate(value)]
    if not isinstance(value, str) or not is_address(value):
        return value
    store, path = open_store(value), folder / value.rstrip("/").rsplit("/", 1)[-1]
    try:
        found = store.isdir(value), store.isfile(value)
        if not any(found):
            raise InputError(f"There is nothing at {quote_value(value)}; correct the address.")
        path.parent.mkdir(parents=True, exist_ok=True)
        store.get(value.rstrip("/") + ("/" if found[0] else ""), str(path), recursive=found[0])
    except OSError as error:
        raise ConnectionError(f"{value} cannot be downloaded: {error}") from error
    return str(path)

"""Outputs that are, hold or lie in an input, which would mix both or replace the input.

Files and folders are compared by what they are on the disk and not by their names: the same folder
has other names through links, and on file systems that ignore case.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_folder import holds_results, read_listing

MAX_LINK_DEPTH = 2
"""Levels of an input folder whose links are followed: those of photographs, depth and models."""

Identity = tuple[int, int]
"""Device and number of a file or folder."""


def refuse_overlap(
    out: Path, inputs: Iterable[Path], argument: str = "out", may_continue: bool = True
) -> None:
    """Raise an InputError if the output folder `out` is, holds or lies in an input.

    With `may_continue`, an input may be a file that an earlier run wrote to `out` itself, or one
    of its folders that are results of their own: a completion is cleaned in place, or completed
    from the cameras that were found for it.
    """
    chain = list(_identify_chain(out))
    for given in inputs:
        if may_continue and _is_earlier_result(given, out):
            continue
        # Photographs may be links to a folder elsewhere, which is an input as well.
        for path in [given, *_list_linked(given)]:
            relation = _relate(out, chain, path)
            if relation is not None:
                through = "" if path == given else f", to which {quote_value(given)} links"
                raise InputError(
                    f"The output {quote_value(out)} {relation} the input "
                    f"{quote_value(path)}{through}; name another place for the results.",
                    argument,
                )


def do_overlap(one: Path, other: Path) -> bool:
    """Return True if one of two outputs, which need not exist yet, is or holds the other."""
    places = [Path(os.path.realpath(path)) for path in (one, other)]
    holds = [place in (last, *last.parents) for place, last in (places, places[::-1])]
    chains = [list(_identify_chain(path)) for path in (one, other)]
    # On a disk that ignores case the same folder has several names.
    return any(holds) or _relate(one, chains[0], other) is not None


def refuse_input_file(file: Path, inputs: Iterable[Path], argument: str = "out") -> None:
    """Raise an InputError if the output `file` is an input, or lies in an input folder.

    It may lie in the output folder of an earlier run, but not be one of the results there.
    """
    for given in inputs:
        if _identify(given) is not None and _identify(file) == _identify(given):
            relation = "is"
        elif os.path.isdir(given) and _relate(file, list(_identify_chain(file)), given) is not None:
            listed = read_listing(given)
            name = os.path.relpath(os.path.realpath(file), os.path.realpath(given))
            if listed and Path(name).as_posix() not in listed:
                continue
            relation = "is a part of" if listed else "lies in"
        else:
            continue
        raise InputError(
            f"The output {quote_value(file)} {relation} the input {quote_value(given)}; name "
            "another file.",
            argument,
        )


def _relate(out: Path, chain: Sequence[Identity], path: Path) -> str | None:
    """Describe how an output and an input overlap; `chain` are `out` and its parents."""
    identity = _identify(path)
    if identity is None:
        return None
    own = _identify(out)
    if identity == own:
        return "is"
    if os.path.isdir(path) and identity in chain:
        return "lies in"
    return "holds" if own is not None and own in set(_identify_chain(path)) else None


def _identify_chain(path: Path) -> Iterator[Identity]:
    """Identify a file or folder and all folders that hold it, as far as they exist."""
    real = Path(os.path.realpath(path))
    for place in (real, *real.parents):
        identity = _identify(place)
        if identity is not None:
            yield identity


def _identify(path: Path) -> Identity | None:
    """Identify a file or folder; None if there is none."""
    try:
        # Also `missing/../folder` is written to the folder.
        status = os.stat(os.path.realpath(path))
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


def _list_linked(folder: Path, depth: int = MAX_LINK_DEPTH) -> Iterator[Path]:
    """List the folders outside of an input folder that links in it lead to."""
    try:
        entries = list(os.scandir(folder)) if os.path.isdir(folder) else []
    except OSError:
        return
    for entry in entries:
        if entry.is_symlink() and os.path.isdir(entry.path):
            yield Path(os.path.realpath(entry.path))
        elif depth > 1 and entry.is_dir(follow_symlinks=False):
            yield from _list_linked(Path(entry.path), depth - 1)


def _is_earlier_result(given: Path, out: Path) -> bool:
    """Return True for a result of an earlier run in `out`, or a folder of results of its own."""
    if os.path.realpath(given.parent) != os.path.realpath(out):
        return False
    listed = read_listing(out)
    if os.path.isdir(given):
        is_listed = any(name.startswith(f"{given.name}/") for name in listed)
        return not is_listed and holds_results(given)
    return given.name in listed

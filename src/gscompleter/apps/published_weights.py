"""Published weights as a table or JSON. Listing them needs no torch; downloading does."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from gscompleter.models.weights.fetching import (
    INSTALL,
    check_available,
    find_cached,
    get_cache_path,
    is_hub_installed,
)
from gscompleter.models.weights.published import PUBLISHED, PublishedWeights
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError, quote_value

WEIGHT_KINDS = {
    "Gaussians": "",
    "scene depth": ", scene depth only",
    "monocular depth": ", for --depth",
    "depth": ", depth only",
    "image": ", a generator",
}
"""Description of a network in the table, by its output."""


def list_weights(names: Sequence[str], as_json: bool) -> None:
    """Print the published weights and their location on this machine; download `names` first."""
    # All of them before any download, which takes minutes.
    for name in names:
        check_downloadable(name)
    for name in names:
        download(name)
    cached = [(weights, find_cached(weights)) for weights in PUBLISHED.values()]
    if not as_json:
        print_models(cached)
        return
    rows = [
        {
            **asdict(weights),
            "url": weights.url,
            "pinned_by": weights.integrity_check,
            "cached": None if path is None else str(path),
            "place": str(get_cache_path(weights)),
        }
        for weights, path in cached
    ]
    print(json.dumps(rows, indent=2))


def check_downloadable(name: str) -> None:
    """Raise InputError for weights that do not exist, or that cannot be downloaded."""
    if name not in PUBLISHED:
        raise InputError(
            f"There are no weights '{quote_value(name)}'; choose one of {', '.join(PUBLISHED)}.",
            "download",
        )
    check_available(PUBLISHED[name])


def download(name: str) -> None:
    """Get a file, downloaded unless it is here, and compare its SHA-256 if one is published."""
    from gscompleter.models.weights.reading import fetch_checked

    fetch_checked(PUBLISHED[name])


def print_models(cached: Sequence[tuple[PublishedWeights, Path | None]]) -> None:
    """Print the table and its footnotes; `cached` has the file of each, or None."""
    table = Table(box=None)
    for title in ("name", "model", "parameters", "views", "size", "code / weights", "cached"):
        table.add_column(title, no_wrap=title == "name")
    table.add_column("source", overflow="fold")
    for weights, path in cached:
        table.add_row(*format_model_cells(weights, path))
    # In a file or a pipe rows are not wrapped, so that a line has a model.
    width = None if sys.stdout.isatty() else 1000
    make_console(width=width).print(table)

    # Models of one repository share a caution, which is printed once after all their names.
    print("\n(!) Whether commercial use is allowed is unclear:")
    names_by_caution: dict[str, list[str]] = {}
    for weights in PUBLISHED.values():
        if weights.caution:
            names_by_caution.setdefault(weights.caution, []).append(weights.name)
    for caution, names in names_by_caution.items():
        print(f"    {', '.join(names)}: {caution}.")
    if not is_hub_installed():
        print(f"\nThe hub's cache was not searched, for lack of huggingface_hub: {INSTALL}")


def format_model_cells(weights: PublishedWeights, path: Path | None) -> tuple[str, ...]:
    """Format a row of the table."""
    fewest, most = weights.views
    count = weights.parameters
    return (
        weights.name,
        weights.model + WEIGHT_KINDS[weights.gives],
        "?" if count is None else f"{count / 1e6:.1f} M",
        f"{fewest}" if fewest == most else f"{fewest}-{most}",
        weights.size,
        f"{weights.code_licence} / {weights.weights_licence}{' (!)' if weights.caution else ''}",
        "no" if path is None else str(path),
        weights.source,
    )

"""The report page of an evaluation, made from its Markdown tables and its plots."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from gscompleter.apps.report.page import Picture, encode_uri, render_template
from gscompleter.apps.report.schema import find_result
from gscompleter.io.image import read_image_size
from gscompleter.io.reading import read_bytes

TABLES_FILE, TIMINGS_FILE = "tables.md", "timings.md"
PLOT_CAPTIONS = {
    "gain_by_hole": "ΔPSNR at the target by hole size",
}


@dataclass(frozen=True)
class Block:
    """A paragraph, or a table with a caption."""

    text: str
    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


def render_evaluation_page(folder: Path) -> str:
    """Render the page of the evaluation in `folder`.

    Raises:
        InputError: if the folder has no evaluation.
    """
    return render_template(
        "evaluation.html",
        {
            "scores": list(read_markdown(find_result(folder, TABLES_FILE))),
            "times": list(read_markdown(find_result(folder, TIMINGS_FILE))),
            "plots": [embed_plot(path) for path in sorted(folder.glob("*.png"))],
        },
    )


def read_markdown(path: Path) -> Iterator[Block]:
    """Read paragraphs and tables; the heading before a table is its caption."""
    caption = "Seconds"
    for text in read_bytes(path).decode("utf-8", "replace").strip().split("\n\n"):
        if text.startswith("### "):
            caption = text.strip("# \n")
        elif text.startswith("| "):
            head, _, *rows = map(split_row, text.strip().splitlines())
            yield Block(caption, head, rows)
        else:
            yield Block(text)


def split_row(line: str) -> list[str]:
    """Split a row of a Markdown table into its cells."""
    cells = re.split(r"(?<!\\)\|", line)[1:-1]
    return [cell.strip().replace("\\|", "|") for cell in cells]


def embed_plot(path: Path) -> Picture:
    """Embed a plot as it is."""
    caption = PLOT_CAPTIONS.get(path.stem, path.stem.replace("_", " "))
    return Picture(caption, *read_image_size(path), encode_uri("image/png", path.read_bytes()))

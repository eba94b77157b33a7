"""The page of all commands, with a sentence for each one.

It is made without tyro and without the options of the commands, which take most of the time of
other pages. The sentences are those of the command's own page, read from its file.
"""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

HELP = ("-h", "--help")
HELP_ALL = "--help-all"

DESCRIPTION = "Complete 3D Gaussian Splatting scenes: generate, then register."
GENERAL_OPTIONS = {
    "-h, --help": "show this help message and exit",
    "--version": "Print the version.",
}
COMMANDS_FOLDER = Path(__file__).parents[1] / "commands"
WIDTHS = (40, 106)
"""Fewest and most characters in a line; with the most, each sentence is in one."""
BORDERS = 4
"""Characters beside the text of a line in a box."""
PLAIN_BOX = str.maketrans("╭╮╰╯─│•", "++++-|*")
"""Plain characters to print for those of boxes, where the encoding of the output lacks them."""


def format_command_list(names: Sequence[str]) -> str:
    """Format the page of the commands with these names, as wide as the terminal.

    It looks like the page that tyro would make of them.
    """
    narrowest, widest = WIDTHS
    width = min(max(narrowest, shutil.get_terminal_size().columns), widest)
    commands = {f"  • {name}": read_command_sentence(name) for name in names}
    boxes = (
        format_box("options", format_list_rows(GENERAL_OPTIONS, 4, width), width),
        format_box("subcommands", ["(required)", *format_list_rows(commands, 2, width)], width),
    )
    usage = f"usage: gscompleter [-h] [--version] {{{','.join(names)}}}"
    page = "\n".join([usage, "", DESCRIPTION, "", *boxes, ""])
    return page if is_printable(page) else page.translate(PLAIN_BOX)


def is_printable(text: str) -> bool:
    """Return True if the standard output has all characters; pipes on Windows lack some."""
    try:
        text.encode(sys.stdout.encoding or "ascii")
    except UnicodeEncodeError:
        return False
    return True


def read_command_sentence(name: str) -> str:
    """Read the first paragraph of the docstring of a command's options from its file."""
    text = (COMMANDS_FOLDER / f"{name}.py").read_text(encoding="utf-8")
    start = text.index(f"class {name.capitalize()}Options(")
    docstring = text[start:].split('"""', 2)[1]
    return " ".join(docstring.split("\n\n")[0].split())


def format_list_rows(texts: dict[str, str], gap: int, width: int) -> Iterable[str]:
    """Format lines of a box: each name, and its text beside it."""
    indent = max(map(len, texts)) + gap
    for name, text in texts.items():
        lines = textwrap.wrap(text, width - BORDERS - indent)
        for first, line in zip([name, *[""] * len(lines)], lines, strict=False):
            yield f"{first:{indent}}{line}"


def format_box(title: str, lines: Iterable[str], width: int) -> str:
    """Format lines in a box with a title."""
    top = f"╭─ {title} ".ljust(width - 1, "─") + "╮"
    inside = [f"│ {line:{width - BORDERS}} │" for line in lines]
    return "\n".join([top, *inside, "╰" + "─" * (width - 2) + "╯"])

"""Write what pages list from the code: all options, generators, and splat formats.

`options.md` is written as a whole: the table of all options, one row a meaning. In other pages what
stands between `<!-- rows: NAME -->` and `<!-- end -->` is. Run `make pages` after a change of an
option or a row; a test compares the pages.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import tyro
from typing_extensions import Doc

from gscompleter.apps.command_line.old_spellings import OLD_SPELLINGS
from gscompleter.cli import COMMANDS, OptionClasses
from gscompleter.config.generators import GENERATORS, PREFIX, GeneratorEntry, GeneratorOptions
from gscompleter.models.tables import GENERATORS as LEARNED_GENERATORS
from gscompleter.models.tables import GeneratorLoader
from gscompleter.splats.splat_format import SplatFormat
from gscompleter.splats.table import SPLAT_FORMATS

DOCS = Path(__file__).parent
OPTIONS_PAGE = "options.md"
PAGES = ("formats.md", "generators.md", "provenance.md")
"""Pages with tables that are made from rows."""
REGION = re.compile(r"(<!-- rows: (?P<name>[\w ]+) -->\n).*?(<!-- end -->)", re.DOTALL)
SETTINGS = "config"
"""The option that has a tree of settings below it."""
KINDS = {bool: "switch", int: "whole number", float: "number", Path: "path", str: "text"}
ABOVE = """# Options

One word has one meaning in every command: where an option has the same name, it takes the same
kind of value, and the first sentence of its help is the same. What follows there is what one
command adds, such as a default or the files that it writes (`gscompleter COMMAND --help-all`). A
command may take fewer of the choices, or one value where another takes several. Settings of the
method, `--config NAME` and `--config.GROUP.NAME VALUE`, are in
[another table](reference/completing.md#options).

Of masks two options say which way: `--mask` marks what goes, and `--ignore` what to leave out of
photographs, both in white. Masks that lie beside photographs are black where a photograph is
ignored ([masks](formats.md#masks)).

"""
BELOW = """
An option that had another name is refused with a sentence that names the new one:

"""


@dataclass(frozen=True)
class Option:
    """An option of one command."""

    name: str
    command: str
    kinds: frozenset[str]
    """Kinds of one value; a choice of words is a kind for each word."""
    sentence: str
    """First sentence of the help, which says what the option means."""


def list_all_options() -> list[Option]:
    """List the options of all commands, but settings of the method and what is given by place."""
    found = []
    for command in COMMANDS:
        for name, kind, text in walk_fields(OptionClasses()[command]):
            sentence = re.split(r"(?<=\.) ", text, maxsplit=1)[0]
            kinds = frozenset(list_kinds(kind))
            found.append(Option(f"--{name.replace('_', '-')}", command, kinds, sentence))
    return found


def walk_fields(options: type) -> Iterator[tuple[str, Any, str]]:
    """Walk through the options of a class: name, type, and help in one line."""
    hints = get_type_hints(options, include_extras=True)
    for field in fields(options):
        kind = hints[field.name]
        if field.name == SETTINGS or tyro.conf.Positional in get_args(kind)[1:]:
            continue
        if is_dataclass(field.default):
            yield from walk_fields(type(field.default))
        else:
            # As for tyro, a `Doc` of the type comes before the text below the field.
            docs = [part.documentation for part in get_args(kind)[1:] if isinstance(part, Doc)]
            yield field.name, kind, docs[0] if docs else find_help(options, field.name)


def find_help(options: type, name: str) -> str:
    """Find the text below a field, in the class itself or the next one above that has the field."""
    texts = (read_helps(kind).get(name) for kind in options.__mro__ if is_dataclass(kind))
    return next((text for text in texts if text is not None), "")


@cache
def read_helps(options: type) -> dict[str, str]:
    """Read the texts below the fields of one class, empty where there is none."""
    (tree,) = ast.parse(inspect.cleandoc(inspect.getsource(options))).body
    assert isinstance(tree, ast.ClassDef)
    helps: dict[str, str] = {}
    for before, node in zip(tree.body, [*tree.body[1:], None], strict=True):
        if not isinstance(before, ast.AnnAssign) or not isinstance(before.target, ast.Name):
            continue
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        # A field that is declared again without a text keeps that of the class above.
        if is_text:
            helps[before.target.id] = " ".join(str(node.value.value).split())
    return helps


def list_kinds(kind: Any) -> Iterator[str]:
    """List the kinds of one value of an option, whether it takes one or several."""
    origin = get_origin(kind)
    if origin is Annotated:
        yield from list_kinds(get_args(kind)[0])
    elif origin is Literal:
        yield from (f"`{word}`" for word in get_args(kind))
    elif origin is None:
        yield KINDS[kind]
    elif origin is tuple and Ellipsis not in get_args(kind):
        # All of one kind, as the three numbers of a place.
        (noun,) = {one for part in get_args(kind) for one in list_kinds(part)}
        yield f"{len(get_args(kind))} {noun}s"
    else:
        for part in get_args(kind):
            if part not in (NoneType, Ellipsis):
                yield from list_kinds(part)


def make_options_page() -> str:
    """Make the page of options: a row for each name, with the kinds of its widest command."""
    options = list_all_options()
    rows = []
    for name in sorted({option.name for option in options}):
        same = [option for option in options if option.name == name]
        widest = max(same, key=lambda option: len(option.kinds))
        commands = ", ".join(option.command for option in same)
        commands = "all" if len(same) == len(COMMANDS) else commands
        kinds = ", ".join(sorted(widest.kinds))
        rows.append([f"`{name}`", kinds, widest.sentence, commands])
    table = format_table(["option", "value", "meaning", "commands"], rows)
    old = [
        f"* `{command} --{name}`: {sentence}."
        for (command, name), sentence in OLD_SPELLINGS.items()
    ]
    return ABOVE + table + BELOW + "\n".join(old) + "\n"


def format_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a table of Markdown."""
    lines = [titles, ["---"] * len(titles), *rows]
    heads, rules, *others = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([heads, rules.replace(" ", ""), *others]) + "\n"


# ---- generators ---------------------------------------------------------------------------------


ALL_GENERATORS: Mapping[str, GeneratorEntry | GeneratorLoader] = {
    **GENERATORS,
    **LEARNED_GENERATORS,
}
"""Rows by name: built-in generators, then those with weights."""


def make_generators() -> str:
    """Make the table of generators."""
    default = GeneratorOptions().generator
    rows = []
    for name, row in ALL_GENERATORS.items():
        title = f"`{name}` (default)" if name == default else f"`{name}`"
        rows.append([title, row.line.input, row.line.output, row.line.needs])
    return format_table(["name", "input", "output", "needs"], rows)


def make_generator_options() -> str:
    """Make the table of their options, with the generators that have each."""
    rows = []
    for name, _, text in walk_fields(GeneratorOptions):
        if not name.startswith(PREFIX):
            continue
        setting = name.removeprefix(PREFIX)
        owners = [
            f"`{owner}`" for owner, row in ALL_GENERATORS.items() if hasattr(row.settings, setting)
        ]
        rows.append([f"`--{name.replace('_', '-')}`", ", ".join(owners), text])
    return format_table(["option", "for", "meaning"], rows)


# ---- splat formats ------------------------------------------------------------------------------

HOLDINGS = {
    "holds_harmonics": "harmonics",
    "holds_origin": "map coordinates",
    "marks_antialiased": "antialiased mark",
    "list_names": "further properties are found",
}
"""Titles of what formats can hold, by the fields of their rows."""


def list_format_lines() -> dict[str, SplatFormat]:
    """List formats by the first cell of their line; rows with the same texts share a line."""
    lines: dict[str, SplatFormat] = {}
    for row in SPLAT_FORMATS.values():
        same = [one for one in SPLAT_FORMATS.values() if one.texts is row.texts]
        endings = [ending for one in same for ending in one.endings if ending.startswith(".")]
        title = f" ({row.texts.title})" if row.texts.title else ""
        lines.setdefault(", ".join(endings) + title, row)
    return lines


def say(row: SplatFormat, field: str, plain: str = "yes", without: str = "no") -> str:
    """Say whether and how a file holds what a field of its row says."""
    return row.texts.places.get(field, plain if getattr(row, field) else without)


def make_formats() -> str:
    """Make the table of formats: what is read and written, how exactly, and in which axes."""
    rows = []
    for title, row in list_format_lines().items():
        texts = row.texts
        written = texts.written or ("yes" if row.write else "no")
        if row.extra:
            written += f" (`pip install 'gscompleter[{row.extra}]'`)"
        rows.append([title, texts.read, written, texts.precision or "–", texts.axes])
    return format_table(["format", "read", "written", "precision", "axes"], rows)


def make_contents() -> str:
    """Make the table of what files of each format can hold, and by what they are recognised."""
    rows = []
    for title, row in list_format_lines().items():
        holdings = [say(row, field) for field in HOLDINGS]
        rounds = "–" if row.write is None else "yes" if row.rounds_geometry else "no"
        known = "first bytes" if row.starts else "name"
        rows.append([title, known, *holdings, rounds])
    titles = ["format", "known by its", *HOLDINGS.values(), "rounds positions and sizes"]
    return format_table(titles, rows)


def make_records() -> str:
    """Make the table of where labels and records are, of the formats that have a place for one."""
    lines = [
        [
            title,
            say(row, "holds_labels", "in the file", "beside the file"),
            say(row, "read_record", "in the file", "beside the file: `provenance`"),
        ]
        for title, row in list_format_lines().items()
        if row.holds_labels or row.read_record
    ]
    lines.append(["all others", "beside the file", "beside the file: `provenance`"])
    return format_table(["format", "`generated`", "record"], lines)


# ---- pages --------------------------------------------------------------------------------------

TABLES: Mapping[str, Callable[[], str]] = {
    "generators": make_generators,
    "generator options": make_generator_options,
    "splat formats": make_formats,
    "splat contents": make_contents,
    "splat records": make_records,
}
"""Makers of tables, by the names in the pages."""


def fill_page(text: str) -> str:
    """Write the tables of a page anew."""
    return REGION.sub(lambda found: f"{found[1]}\n{TABLES[found['name']]()}\n{found[3]}", text)


def make_pages() -> dict[Path, str]:
    """Make all pages that list what is in the code."""
    pages = {DOCS / OPTIONS_PAGE: make_options_page()}
    return pages | {DOCS / name: fill_page((DOCS / name).read_text("utf-8")) for name in PAGES}


if __name__ == "__main__":
    for path, text in make_pages().items():
        path.write_text(text, encoding="utf-8")

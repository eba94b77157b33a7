"""Write `options.md`: the table of all options, one row a meaning.

Run `python docs/make_option_table.py` after a change of an option; a test compares the page.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import tyro
from typing_extensions import Doc

from gscompleter.apps.command_line.old_spellings import OLD_SPELLINGS
from gscompleter.cli import COMMANDS, OptionClasses

PAGE = Path(__file__).with_name("options.md")
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
    else:
        for part in get_args(kind):
            if part not in (NoneType, Ellipsis):
                yield from list_kinds(part)


def make_page() -> str:
    """Make the page: a row for each name, with the kinds of its widest command."""
    options = list_all_options()
    rows = ["| option | value | meaning | commands |", "|---|---|---|---|"]
    for name in sorted({option.name for option in options}):
        same = [option for option in options if option.name == name]
        widest = max(same, key=lambda option: len(option.kinds))
        commands = ", ".join(option.command for option in same)
        commands = "all" if len(same) == len(COMMANDS) else commands
        kinds = ", ".join(sorted(widest.kinds))
        rows.append(f"| `{name}` | {kinds} | {widest.sentence} | {commands} |")
    old = [
        f"* `{command} --{name}`: {sentence}."
        for (command, name), sentence in OLD_SPELLINGS.items()
    ]
    return ABOVE + "\n".join(rows) + "\n" + BELOW + "\n".join(old) + "\n"


if __name__ == "__main__":
    PAGE.write_text(make_page(), encoding="utf-8")

"""Words of a command line as options."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from io import StringIO
from itertools import dropwhile, takewhile
from typing import Any

import tyro
from tyro.constructors import ConstructorRegistry, StructTypeInfo

from gscompleter.commands.generator_options import generator_flags
from gscompleter.commands.help import HELP_ALL, Rule, asks_for_help, rule_for_help
from gscompleter.commands.options import FOUND
from gscompleter.commands.renamed import use_new_names
from gscompleter.config import CompleterConfig, load_config
from gscompleter.config.renamed import refuse_old_options
from gscompleter.errors import InputError, quoted

NEAR = 0.75
"""Likeness from which on an option is near enough to be named, from 0 to 1."""


def sentence_of(error: InputError) -> str:
    """What went wrong, and the option that can mend it."""
    if error.argument is None:
        return str(error)
    return f"{str(error).removesuffix('.')} (--{error.argument.replace('_', '-')})."


def read_words(words: Sequence[str], command: Any, names: Collection[str]) -> Any:
    """The options of the command that `words` name, one of the types that `command` is a union of.

    Raises:
        InputError: where they are wrong, or the config that they name is.
        SystemExit: where they ask for help, which is printed.
    """
    words = use_new_names(words)
    show_all = HELP_ALL in words
    helps = [rule_for_help(show_all)] if asks_for_help(words) else []
    words = ["--help" if word == HELP_ALL else word for word in words]
    check_once(words)
    refuse_old_options(words)
    check_command(words, names)
    printed, config = StringIO(), CompleterConfig()
    read = partial(
        tyro.cli,
        command,
        prog="gscompleter",
        description="Complete 3D Gaussian Splatting scenes: generate, then register.",
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    try:
        with redirect_stderr(printed):
            config, words = config_named(auto_counted(words))
            return read(args=words, registry=registry_from(config, *helps))
    except SystemExit as stop:
        if not stop.code:
            raise
        options = options_in(lambda words: read(args=words, registry=registry_from(config)), words)
        sentence = misspelt(words, options, names) or unboxed(printed.getvalue(), words, names)
        raise InputError(sentence) from None


def check_command(words: Sequence[str], names: Collection[str]) -> None:
    """Refuse a command that does not exist, and name the nearest one.

    Raises:
        InputError: where the first of `words` is like one of `names`, but none of them.
    """
    near = get_close_matches(words[0], names, 1) if words else []
    if near and words[0] not in names:
        raise InputError(
            f"There is no command {quoted(words[0])}; the nearest is {near[0]} (see gscompleter "
            "--help)."
        )


def options_in(read: Callable[[Sequence[str]], Any], words: Sequence[str]) -> list[str]:
    """List the options that the help of the command in `words` begins its lines with, or those that
    stand without one."""
    if not words or words[0].startswith("--"):
        return ["--help", "--version"]
    help_text = StringIO()
    with redirect_stdout(help_text), suppress(SystemExit):
        read([*words[:1], "--help"])
    found = re.findall(r"^[ │]*(?:-h, )?(--[a-z][\w.-]*)", help_text.getvalue(), re.MULTILINE)
    return [*found, HELP_ALL]


def misspelt(words: Sequence[str], options: Sequence[str], names: Collection[str]) -> str | None:
    """Name the option that is nearest to one that does not exist; None where there is none."""
    given = [word.split("=")[0] for word in words if word.startswith("--")]
    for word in given:
        option = word.replace("_", "-")
        near = get_close_matches(option, options, 1, NEAR)
        if near and near[0] != option:
            see = f"(see {command_in(words, names)} --help)"
            return f"There is no option {quoted(word)}; the nearest is {near[0]} {see}."
    return None


def command_in(words: Sequence[str], names: Collection[str]) -> str:
    """Return what one types to call the command that `words` name, if any."""
    return " ".join(["gscompleter", *(word for word in words[:1] if word in names)])


def check_once(words: Sequence[str]) -> None:
    """Refuse an option that is named twice, for the later one alone would count.

    Raises:
        InputError: where `words` hold one.
    """
    named = [word.split("=")[0].replace("_", "-") for word in words if word.startswith("--")]
    twice = next((name for name in named if named.count(name) > 1), None)
    if twice is not None:
        raise InputError(
            f"{quoted(twice)} is given twice, and only one of them would count; name it once, with "
            "all its values after it."
        )


def auto_counted(words: Sequence[str]) -> list[str]:
    """`words` with a number after `--auto`, which may stand alone."""
    alone = [
        w == "--auto" and not n.isdecimal() for w, n in zip(words, [*words, ""][1:], strict=True)
    ]
    counted = [(w, str(FOUND)) if a else (w,) for w, a in zip(words, alone, strict=True)]
    return [word for pair in counted for word in pair]


@dataclass(frozen=True)
class NamedConfig:
    """What is read before the rest: the config that single settings are applied over."""

    config: str = "default"


def config_named(words: Sequence[str]) -> tuple[CompleterConfig, Sequence[str]]:
    """What `--config NAME` names, and the other words, which may change some of it."""
    if words[:1] not in (["complete"], ["live"]):
        return CompleterConfig(), words
    named, others = tyro.cli(
        NamedConfig, prog="gscompleter", args=words, return_unknown_args=True, add_help=False
    )
    return load_config(named.config), others


def registry_from(config: CompleterConfig, *rules: Rule) -> ConstructorRegistry:
    """How tyro reads our classes: a CompleterConfig begins as `config`."""

    def config_flags(info: StructTypeInfo) -> Any:
        if info.type is not CompleterConfig or info.default == config:
            return None
        return ConstructorRegistry.get_struct_spec(StructTypeInfo.make(info.type, config, False))

    registry = ConstructorRegistry()
    registry.struct_rule(generator_flags)
    registry.struct_rule(config_flags)
    for rule in rules:
        registry.struct_rule(rule)
    return registry


def unboxed(box: str, words: Sequence[str], names: Collection[str]) -> str:
    """The sentence in the box that tyro draws around an error; indented or below it stands help."""

    def is_empty(line: str) -> bool:
        return not line.strip("─- ")

    lines = [line[2:].rstrip("│ ") for line in box.splitlines()[1:]]
    said = takewhile(lambda line: not is_empty(line), dropwhile(is_empty, lines))
    sentence = " ".join(line.strip() for line in said if not line.startswith(" " * 5))
    usage = lines.index("Argument helptext:") + 1 if "Argument helptext:" in lines else None
    needed = "" if usage is None else f"; give {lines[usage].strip()}"
    command = command_in(words, names)
    return f"{quoted(sentence, 200).removesuffix('.')}{needed} (see {command} --help)."

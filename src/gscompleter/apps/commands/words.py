"""Parser of the command line."""

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

from gscompleter.apps.commands.generator_options import make_generator_spec
from gscompleter.apps.commands.help import HELP_ALL, Rule, asks_for_help, make_help_rule
from gscompleter.apps.commands.options import DEFAULT_NUM_TARGETS
from gscompleter.apps.commands.renamed import use_new_names
from gscompleter.config import CompleterConfig, load_config
from gscompleter.config.renamed import refuse_old_options
from gscompleter.errors import InputError, quote_value

MIN_SIMILARITY = 0.75
"""Smallest similarity of an option to a misspelt one, from 0 to 1."""


def format_error(error: InputError) -> str:
    """Add the option that can correct it to the sentence of an error."""
    if error.argument is None:
        return str(error)
    return f"{str(error).removesuffix('.')} (--{error.argument.replace('_', '-')})."


def parse_words(words: Sequence[str], command: Any, names: Collection[str]) -> Any:
    """Parse a command line into one of the option classes of the union `command`.

    It raises InputError for wrong words, and SystemExit after printing the help.
    """
    words = use_new_names(words)
    show_all = HELP_ALL in words
    helps = [make_help_rule(show_all)] if asks_for_help(words) else []
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
            config, words = load_named_config(insert_auto_count(words))
            return read(args=words, registry=make_registry(config, *helps))
    except SystemExit as stop:
        if not stop.code:
            raise
        options = list_options(
            lambda words: read(args=words, registry=make_registry(config)), words
        )
        sentence = find_misspelling(words, options, names) or extract_sentence(
            printed.getvalue(), words, names
        )
        raise InputError(sentence) from None


def check_command(words: Sequence[str], names: Collection[str]) -> None:
    """Refuse an unknown command, and name the nearest one."""
    near = get_close_matches(words[0], names, 1) if words else []
    if near and words[0] not in names:
        raise InputError(
            f"There is no command {quote_value(words[0])}; the nearest is {near[0]} (see "
            "gscompleter "
            "--help)."
        )


def list_options(read: Callable[[Sequence[str]], Any], words: Sequence[str]) -> list[str]:
    """List the options of the command in `words`."""
    if not words or words[0].startswith("--"):
        return ["--help", "--version"]
    help_text = StringIO()
    with redirect_stdout(help_text), suppress(SystemExit):
        read([*words[:1], "--help"])
    found = re.findall(r"^[ │]*(?:-h, )?(--[a-z][\w.-]*)", help_text.getvalue(), re.MULTILINE)
    return [*found, HELP_ALL]


def find_misspelling(
    words: Sequence[str], options: Sequence[str], names: Collection[str]
) -> str | None:
    """Write a sentence on an unknown option that is similar to a known one, if any."""
    given = [word.split("=")[0] for word in words if word.startswith("--")]
    for word in given:
        option = word.replace("_", "-")
        near = get_close_matches(option, options, 1, MIN_SIMILARITY)
        if near and near[0] != option:
            see = f"(see {get_command_name(words, names)} --help)"
            return f"There is no option {quote_value(word)}; the nearest is {near[0]} {see}."
    return None


def get_command_name(words: Sequence[str], names: Collection[str]) -> str:
    """Return the program with the command in `words`, if any."""
    return " ".join(["gscompleter", *(word for word in words[:1] if word in names)])


def check_once(words: Sequence[str]) -> None:
    """Refuse an option that is given twice."""
    named = [word.split("=")[0].replace("_", "-") for word in words if word.startswith("--")]
    twice = next((name for name in named if named.count(name) > 1), None)
    if twice is not None:
        raise InputError(
            f"{quote_value(twice)} is given twice, and only one of them would count; name it "
            "once, with "
            "all its values after it."
        )


def insert_auto_count(words: Sequence[str]) -> list[str]:
    """Insert the default number after an `--auto` without one."""
    alone = [
        w == "--auto" and not n.isdecimal() for w, n in zip(words, [*words, ""][1:], strict=True)
    ]
    counted = [
        (w, str(DEFAULT_NUM_TARGETS)) if a else (w,) for w, a in zip(words, alone, strict=True)
    ]
    return [word for pair in counted for word in pair]


@dataclass(frozen=True)
class NamedConfig:
    """The option `--config NAME`, which is parsed first."""

    config: str = "default"


def load_named_config(words: Sequence[str]) -> tuple[CompleterConfig, Sequence[str]]:
    """Load the config of `--config NAME`, and return it with the other words."""
    if words[:1] not in (["complete"], ["live"]):
        return CompleterConfig(), words
    named, others = tyro.cli(
        NamedConfig, prog="gscompleter", args=words, return_unknown_args=True, add_help=False
    )
    is_splat = any(word.partition("=")[0] == "--scene" for word in others)
    return load_config(named.config, is_splat), others


def make_registry(config: CompleterConfig, *rules: Rule) -> ConstructorRegistry:
    """Create tyro's registry, with `config` as the default CompleterConfig."""

    def config_flags(info: StructTypeInfo) -> Any:
        if info.type is not CompleterConfig or info.default == config:
            return None
        return ConstructorRegistry.get_struct_spec(StructTypeInfo.make(info.type, config, False))

    registry = ConstructorRegistry()
    registry.struct_rule(make_generator_spec)
    registry.struct_rule(config_flags)
    for rule in rules:
        registry.struct_rule(rule)
    return registry


def extract_sentence(box: str, words: Sequence[str], names: Collection[str]) -> str:
    """Extract the sentence from tyro's boxed error message."""

    def is_empty(line: str) -> bool:
        return not line.strip("─- ")

    lines = [line[2:].rstrip("│ ") for line in box.splitlines()[1:]]
    first_lines = takewhile(lambda line: not is_empty(line), dropwhile(is_empty, lines))
    sentence = " ".join(line.strip() for line in first_lines if not line.startswith(" " * 5))
    usage = lines.index("Argument helptext:") + 1 if "Argument helptext:" in lines else None
    needed = "" if usage is None else f"; give {lines[usage].strip()}"
    command = get_command_name(words, names)
    return f"{quote_value(sentence, 200).removesuffix('.')}{needed} (see {command} --help)."

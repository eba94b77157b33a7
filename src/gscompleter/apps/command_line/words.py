"""Parser of the command line."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import fields, is_dataclass
from functools import cache
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry

from gscompleter.apps.command_line.chosen_config import (
    CONFIG_OPTION,
    ChosenConfig,
    make_parsing_rule,
    make_showing_rule,
)
from gscompleter.apps.command_line.command_list import HELP, HELP_ALL
from gscompleter.apps.command_line.help_pages import Rule, describe_command, make_help_rule
from gscompleter.apps.command_line.named_splat import names_splat
from gscompleter.apps.command_line.old_spellings import refuse_old_spellings
from gscompleter.apps.command_line.wrong_values import explain_values
from gscompleter.apps.requests.completion import DEFAULT_NUM_TARGETS
from gscompleter.config import CompleterConfig, load_config
from gscompleter.system.environment import set_variables
from gscompleter.system.errors import InputError, join_names, quote_value

CONTINUING = ("batch", "evaluate")
"""Commands that continue the run in their folder, and replace nothing there."""
CONFIGURED = ("complete", "live", "update", "remove", "repair")
"""Commands with the option `--config NAME`."""
OF_SPLATS = ("update", "remove", "repair")
"""Those of them that always work on a splat."""
ADAPTED = {"remove": CompleterConfig.for_removal, "repair": CompleterConfig.for_marks}
"""Changes of the config for what a command does."""
MAX_NAMED_COMMANDS = 3
"""Most commands that a sentence names as those with an option."""

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.IGNORECASE)
"""A word that is meant as a number, of whatever range."""
SURPLUS = "Unrecognized options: "
"""Beginning of tyro's message on words that nothing takes."""
OPTION_AMONG = re.compile(r"(^|, )-")
"""Option in the list of these words."""
HINTS = {"Argument helptext:": "give", "Perhaps you meant:": "the nearest is"}
"""Titles in tyro's messages before the option that is meant, and words for it in a sentence."""
PLAIN_TERMINAL = {"COLUMNS": "1000000", "TERM": "dumb"}
"""Environment in which tyro breaks no line of an error, and colours none."""


def format_error(error: InputError) -> str:
    """Add the option that can correct an error to its sentence, unless the sentence names it."""
    sentence = str(error)
    if error.argument is None:
        return sentence
    option = f"--{error.argument.replace('_', '-')}"
    if re.search(rf"{re.escape(option)}(?![\w-])", sentence):
        return sentence
    return f"{sentence.removesuffix('.')} ({option})."


def parse_words(words: Sequence[str], kinds: Mapping[str, type]) -> Any:
    """Parse a command line into the options of its command; `kinds` has the class of each command.

    It raises InputError for wrong words, and SystemExit after printing the help.
    """
    refuse_old_spellings(words)
    if not words or words[0] not in kinds:
        wrong = f"There is no command {quote_value(words[0])}" if words else "No command is named"
        raise InputError(f"{wrong}; choose one of {', '.join(kinds)} (see gscompleter --help).")
    refuse_empty_words(words)
    check_once(words)

    # tyro prints an error in a box and ends the process. The box is caught, and one sentence of it
    # becomes that of an InputError.
    box = ""
    for knows_settings, terminal in list_attempts(words):
        printed = StringIO()
        try:
            with redirect_stderr(printed), set_variables(terminal):
                return parse_known_words(words, kinds, knows_settings)
        except SystemExit as stop:
            # Code 0: the help was printed.
            if not stop.code:
                raise
            box = printed.getvalue()
    sentence = explain_words(words, kinds, box)
    see = " ".join(["gscompleter", *words[:1]])
    raise InputError(f"{sentence} (see {see} --help).")


def list_attempts(words: Sequence[str]) -> list[tuple[bool, Mapping[str, str]]]:
    """List the ways to parse a command line, each taken if the one before ends in an error.

    A way is whether tyro knows the settings of the method, and variables of its environment. The
    last one prints errors as `extract_sentence` needs them.
    """
    if asks_for_help(words):
        # A help page has the width and the colours of the terminal. tyro asks for those of the
        # standard output also where it prints an error, which goes elsewhere.
        return [(True, {}), (True, PLAIN_TERMINAL)]
    # Settings of the method are options as well, more than a command has of its own. To prepare
    # them takes tyro up to a tenth of a second, 3 % of a small completion. Without them it knows
    # the words of most command lines, but not always the option that is meant by a wrong one.
    has_setting = any(word.startswith(f"--{CONFIG_OPTION}.") for word in words)
    return [(known, PLAIN_TERMINAL) for known in ((True,) if has_setting else (False, True))]


def parse_known_words(words: Sequence[str], kinds: Mapping[str, type], knows_settings: bool) -> Any:
    """Let tyro parse a command line, with or without the settings of the method as options."""
    words = insert_auto_count(words)
    rules: list[Rule] = [make_parsing_rule(knows_settings)]
    # To find help texts tyro parses source code, also where it shows none.
    marks: tuple[Any, ...] = (tyro.conf.HelptextFromCommentsOff,)
    if asks_for_help(words):
        # Rules for help pages change the fields, so that no option could be parsed by them.
        words, rules = prepare_help(words)
        marks = ()
    registry = ConstructorRegistry()
    for rule in rules:
        registry.struct_rule(rule)
    about = describe_command(kinds[words[0]])
    prog = f"gscompleter {words[0]}"
    parsed = call_tyro(kinds[words[0]], prog, about, words[1:], registry, marks)
    check_config(parsed)
    return parsed


def asks_for_help(words: Sequence[str]) -> bool:
    """Return True if a command line asks for a help page of its command."""
    return any(word in (*HELP, HELP_ALL) for word in words)


def check_config(options: Any) -> None:
    """Refuse a config that there is not, and settings out of range, whatever the input is."""
    chosen = getattr(options, CONFIG_OPTION, None)
    if isinstance(chosen, ChosenConfig):
        chosen.decide(is_splat=False, has_photographs=True)


def call_tyro(
    kind: Any,
    prog: str,
    description: str,
    words: Sequence[str],
    rules: ConstructorRegistry,
    more_marks: tuple[Any, ...],
) -> Any:
    """Parse words into the options `kind`; `prog` stands before them in the help pages."""
    marks = (
        tyro.conf.DisallowNone,
        tyro.conf.FlagCreatePairsOff,
        *more_marks,
    )
    return tyro.cli(
        kind, prog=prog, description=description, args=words, config=marks, registry=rules
    )


def explain_words(words: Sequence[str], kinds: Mapping[str, type], box: str) -> str:
    """Explain wrong words by tyro's message; `kinds` has the option class of each command."""
    # tyro only says that an option is unknown; that it belongs to another command says more.
    own = list_options(kinds[words[0]])
    sentence = (
        describe_foreign_option(words, own, kinds)
        or explain_values(words, own, "\n".join(list_box_lines(box)))
        or extract_sentence(box)
    )
    # tyro calls all words options that nothing takes, also where none of them is one.
    surplus = sentence.removeprefix(SURPLUS)
    if surplus != sentence and not OPTION_AMONG.search(surplus):
        return (
            f"{surplus} belongs to no option of {words[0]}, and an option takes one value unless "
            "its help shows several"
        )
    return sentence


@cache
def list_options(kind: Any, prefix: str = "") -> Mapping[str, Any]:
    """List the options of a command by name, without dashes before it, with their types."""
    options: dict[str, Any] = {}
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        hint = hints[field.name]
        # `Annotated[inner, *marks]`. Of a plain union, tuple or Literal the first argument is
        # `inner`, and the others count as marks; none of them is searched for.
        marks = get_args(hint)[1:]
        inner: Any = get_args(hint)[0] if marks else hint
        name = f"{prefix}{field.name.replace('_', '-')}"
        if inner is ChosenConfig:
            options[CONFIG_OPTION] = str
            options |= list_options(CompleterConfig, f"{CONFIG_OPTION}.")
        elif is_dataclass(inner):
            is_flat = tyro.conf.OmitArgPrefixes in marks
            options |= list_options(inner, "" if is_flat else f"{name}.")  # type: ignore[arg-type]
        elif tyro.conf.Positional not in marks:
            options[name] = hint
    return options


def describe_foreign_option(
    words: Sequence[str], own: Collection[str], kinds: Mapping[str, type]
) -> str:
    """Describe the first option that only other commands have; empty if there is none."""
    for word in words[1:]:
        name = word.partition("=")[0].removeprefix("--").replace("_", "-")
        if not word.startswith("--") or name in own:
            continue
        owners = [other for other, kind in kinds.items() if name in list_options(kind)]
        if owners:
            sentence = f"{words[0]} has no option --{name}, which belongs to "
            sentence += join_names(owners, MAX_NAMED_COMMANDS)
            if name == "overwrite" and words[0] in CONTINUING:
                sentence += f"; {words[0]} continues the run in its folder"
            return sentence
    return ""


def refuse_empty_words(words: Sequence[str]) -> None:
    """Refuse an empty word, which as a path would mean the working folder."""
    for before, word in pairwise(words):
        name, sign, value = word.partition("=")
        # Empty is the word itself, or what follows the sign in `--out=`.
        if word and not (name.startswith("--") and sign and not value):
            continue
        raise InputError(
            f"The word after {quote_value(name or before)} is empty; give it a value, or leave it "
            "out (a variable of the shell may not be set)."
        )


def check_once(words: Sequence[str]) -> None:
    """Refuse an option that is given twice."""
    named = [word.split("=")[0].replace("_", "-") for word in words if word.startswith("--")]
    for name in named:
        if named.count(name) > 1:
            raise InputError(
                f"{quote_value(name)} is given twice, and only one of them would count; name it "
                "once, with all its values after it."
            )


def insert_auto_count(words: Sequence[str]) -> list[str]:
    """Insert the default number after an `--auto` without one.

    A word that is no number belongs to something else, as SCENE does. Wrong numbers stay, so that
    they are refused as those of `--auto`.
    """
    counted = [*words]
    if "--auto" in counted:
        place = counted.index("--auto") + 1
        if not counted[place:] or not NUMBER.fullmatch(counted[place]):
            counted.insert(place, str(DEFAULT_NUM_TARGETS))
    return counted


def prepare_help(words: Sequence[str]) -> tuple[list[str], list[Rule]]:
    """Prepare words that ask for help: those that tyro knows, and the rules for the page.

    The page shows the settings of the config that the words name.
    """
    shown, others = show_config(words)
    asked = ["--help" if word == HELP_ALL else word for word in others]
    return asked, [make_showing_rule(shown), make_help_rule(show_all=HELP_ALL in words)]


def show_config(words: Sequence[str]) -> tuple[CompleterConfig, list[str]]:
    """Load the config that a help page shows, and return it with the words but `--config NAME`.

    A splat is alone in the place of SCENE, or if `--scene` names it and SCENE is left out. SCENE
    counts as the first word after the command: behind options it may be one of their values.
    """
    others: list[str] = []
    name = ChosenConfig.name
    for before, word in pairwise(("", *words)):
        option, sign, value = word.partition("=")
        # An option in the place of the name, such as --help, is no name.
        if before == f"--{CONFIG_OPTION}" and not word.startswith("-"):
            name = word
        elif option != f"--{CONFIG_OPTION}":
            others.append(word)
        elif sign:
            name = value
    if not words or words[0] not in CONFIGURED:
        return CompleterConfig(), others
    given = {word.partition("=")[0] for word in others}
    has_first = len(words) > 1 and not words[1].startswith("-")
    is_alone = names_splat(Path(words[1])) if has_first else "--scene" in given
    is_splat = is_alone or "--scene" in given or words[0] in OF_SPLATS
    # With a mask `complete` does what `repair` does.
    does = "repair" if words[0] == "complete" and "--mask" in given else words[0]
    adapt = ADAPTED.get(does, lambda config: config)
    return load_config(name, is_splat, not is_alone, adapt), others


def list_box_lines(box: str) -> list[str]:
    """List the lines of tyro's boxed error message, without the border."""
    # The first line is its top, or its title where the output has no such characters. The others
    # begin with `│ `, or with two spaces there; `PLAIN_TERMINAL` leaves out the codes of colours
    # that would stand around them. The bottom stays.
    return [line[2:].rstrip("│ ") for line in box.splitlines()[1:]]


def extract_sentence(box: str) -> str:
    """Extract the sentence from tyro's boxed error message, with the option that is meant."""
    lines = list_box_lines(box)

    # The message is the first paragraph, up to an empty line or a rule. It may list arguments,
    # which tyro indents by 4 spaces. The help of each stands below it, indented by 8, and is no
    # part of a sentence.
    paragraph: list[str] = []
    for line in lines:
        if line.strip("─- "):
            paragraph.append(line)
        elif paragraph:
            break
    sentence = " ".join(line.strip() for line in paragraph if not line.startswith(" " * 8))
    # A value that cannot be read comes with tyro's words on where.
    sentence = re.sub(r"^Error parsing [\w.-]+: ", "", sentence)

    # Below a title tyro lists the option that is meant, in the next line; the last title counts.
    hint = ""
    for title, words in HINTS.items():
        if title in lines:
            hint = f"; {words} {lines[lines.index(title) + 1].strip()}"
    return f"{quote_value(sentence, 200).removesuffix('.')}{hint}"

"""Entry point of the command line: parse the options, run the command, choose the exit code."""

from __future__ import annotations

import io
import logging
import os
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from types import ModuleType
from typing import Any

from gscompleter import __version__
from gscompleter.apps.command_line.command_list import HELP, HELP_ALL, format_command_list
from gscompleter.apps.command_line.exit_codes import ERROR, INTERRUPTED, WRONG_INPUT
from gscompleter.system.errors import (
    FullDiskError,
    InputError,
    NoCaseError,
    WorkerError,
    print_error,
)
from gscompleter.system.files.writing import FULL_DISK_ERRORS
from gscompleter.system.interrupts import handle_stop_signals
from gscompleter.system.process import let_idle_threads_sleep, skip_last_collection
from gscompleter.system.threads import limit_threads

COMMANDS = (
    *("complete", "batch", "live", "update", "remove", "repair", "clean", "demo", "evaluate"),
    *("tables", "index", "models", "convert", "poses", "report", "strip", "view"),
    *("inspect", "doctor", "warmup"),
)
"""Names of all commands, in the order of the help page.

Each is a file: `complete` is `apps/commands/complete.py`, with its options in `CompleteOptions` and
the function `run_complete` that gets them and returns an exit code, or None for 0.
"""


class OptionClasses(Mapping[str, type]):
    """Class of the options of each command by its name, imported when it is asked for."""

    def __getitem__(self, name: str) -> type:
        if name not in COMMANDS:
            raise KeyError(name)
        kind: type = getattr(import_command(name), f"{name.capitalize()}Options")
        return kind

    def __iter__(self) -> Iterator[str]:
        return iter(COMMANDS)

    def __len__(self) -> int:
        return len(COMMANDS)


def run() -> None:
    """Run `main` as the command `gscompleter`.

    Its standard output may be closed, on a full disk, or a pipe whose reader has left.
    """
    replace_closed_outputs()

    # An encoding may lack characters: that of pipes on Windows is not UTF-8, and bytes of a file
    # name may be no characters in any.
    for output in (sys.stdout, sys.stderr):
        if isinstance(output, io.TextIOWrapper):
            output.reconfigure(errors="backslashreplace")

    try:
        try:
            main()
        finally:
            # What is buffered fails here, where it can be caught, and not when Python ends.
            sys.stdout.flush()
    except BrokenPipeError:  # the reader, such as `head`, has ended
        leave_output()
        sys.exit(ERROR)
    except OSError as error:
        # `main` explains a full disk if the error names a file. The standard output has no name.
        if error.errno not in FULL_DISK_ERRORS:
            raise
        leave_output()
        print_error(f"the standard output cannot be written: {error.strerror}.")
        sys.exit(ERROR)


def replace_closed_outputs() -> None:
    """Open the null device in the place of a standard output or error that is closed (`>&-`).

    Otherwise Python has None there, and the next file that is opened gets its number. Processes
    that are started inherit it for the same reason.
    """
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            # `open` takes the lowest free number, which may be this one.
            null = os.open(os.devnull, os.O_WRONLY)
            if null != number:
                os.dup2(null, number)
            os.set_inheritable(number, True)
            setattr(sys, name, open(number, "w", encoding="utf-8", closefd=False))  # noqa: SIM115


def leave_output() -> None:
    """Send all that is still written to the standard output to the null device.

    Python writes what is buffered when it ends, and would print another error.
    """
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def main() -> None:
    """Run the command that `sys.argv` names; exit with one of the codes of `exit_codes` but 0.

    What went wrong is one sentence on the standard error. A defect raises its own exception.
    """
    # Before anything imports torch, which reads this setting once.
    let_idle_threads_sleep()
    words = sys.argv[1:]
    if words == ["--version"]:
        print(__version__)
        return
    handle_stop_signals()
    if words and words[0] in (*HELP, HELP_ALL):
        sys.stdout.write(format_command_list(COMMANDS))
        return

    try:
        code = run_words(words)
    except KeyboardInterrupt as stop:
        # `defer_interrupts` gives the reason where results were complete when the signal came.
        reason = str(stop) or "no unfinished result was written"
        print_error(f"interrupted; {reason}.")
        code = INTERRUPTED
    if code:
        sys.exit(code)


def run_words(words: Sequence[str]) -> int | None:
    """Run the command that the words name, and return its exit code; None is 0.

    What the user or the machine did wrong is printed as one sentence. A defect raises its own
    exception.
    """
    # Imported here, since tyro and the classes of options and settings take most of the time of a
    # help page, and the page of all commands does without them.
    from gscompleter.apps.command_line.failures import explain_failure
    from gscompleter.apps.command_line.words import format_error
    from gscompleter.apps.commands.shared_options import ComputeOptions, Options
    from gscompleter.config.settings import validate

    skip_last_collection()
    # Damaged photographs are read or refused with a sentence; Pillow's warnings add nothing.
    warnings.filterwarnings("ignore", module="PIL")
    try:
        check_working_folder()

        # tyro converts the words to types, and `validate` adds the ranges of the annotations.
        command_options = validate(parse_command(words))
        # Torch and numba read the number of threads when they are imported, which the check of the
        # output may do.
        if isinstance(command_options, ComputeOptions):
            limit_threads(command_options.threads)
        if isinstance(command_options, Options):
            command_options.refuse_addresses()
            command_options.check_overlap()
            if command_options.quiet:
                logging.getLogger("gscompleter").setLevel(logging.ERROR)

        run_command = getattr(import_command(words[0]), f"run_{words[0]}")
        code: int | None = run_command(command_options)
        return code
    except InputError as error:
        print_error(format_error(error))
        # These three are InputErrors for their sentences alone: no other input would help.
        is_failure = isinstance(error, (FullDiskError, NoCaseError, WorkerError))
        return ERROR if is_failure else WRONG_INPUT
    except Exception as error:
        # A lack of memory or a path of the user gets a sentence, a defect its traceback.
        failure = explain_failure(error)
        if failure is None:
            raise
        print_error(failure.sentence)
        return failure.code


def check_working_folder() -> None:
    """Raise InputError in a working folder that was deleted: libraries end the process there."""
    try:
        os.getcwd()
    except OSError as error:
        raise InputError(
            "The working folder was deleted or cannot be read; change to another one with cd."
        ) from error


def parse_command(words: Sequence[str]) -> Any:
    """Parse the words into the options of their command; raise the errors of `parse_words`."""
    from gscompleter.apps.command_line.words import parse_words

    return parse_words(words, OptionClasses())


def import_command(name: str) -> ModuleType:
    """Import the file of a command."""
    return import_module(f"gscompleter.apps.commands.{name}")

"""Entry point of the command line: options in, a command called, exit codes out."""

from __future__ import annotations

import atexit
import gc
import io
import os
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any, Union

import tyro

from gscompleter import __version__
from gscompleter.apps.commands import options
from gscompleter.apps.commands.words import format_error, parse_words
from gscompleter.config.settings import validate
from gscompleter.cpu_threads import limit_threads
from gscompleter.errors import PROGRAM, InputError
from gscompleter.io.files import handle_stop_signals

# Options, module and function of each command. The module is imported after the options are
# validated, so that `--help` does not wait for torch.
COMMANDS: dict[str, tuple[type, str, str]] = {
    "complete": (options.CompleteOptions, "complete", "run_completion"),
    "batch": (options.BatchOptions, "batch", "run_batch"),
    "live": (options.LiveOptions, "live", "run_live"),
    "remove": (options.RemoveOptions, "remove", "run_removal"),
    "clean": (options.CleanOptions, "clean", "run_clean"),
    "demo": (options.DemoOptions, "demo", "run_demo"),
    "evaluate": (options.EvaluateOptions, "reproduce", "run_evaluation"),
    "tables": (options.TablesOptions, "evaluate", "run_tables"),
    "index": (options.IndexOptions, "evaluate", "run_index"),
    "bench": (options.BenchOptions, "bench", "run_bench"),
    "models": (options.ModelsOptions, "models", "run_models"),
    "convert": (options.ConvertOptions, "convert", "run_convert"),
    "poses": (options.PosesOptions, "poses", "run_poses"),
    "report": (options.ReportOptions, "complete", "run_report"),
    "strip": (options.StripOptions, "convert", "run_strip"),
    "view": (options.ViewOptions, "view", "run_view"),
    "doctor": (options.DoctorOptions, "doctor", "run_doctor"),
    "warmup": (options.WarmupOptions, "doctor", "run_warmup"),
}

Command: Any = Union[  # noqa: UP007  (of as many as there are)
    tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, (kind, _, _) in COMMANDS.items())
]


def run() -> None:
    """Run `main` as the command `gscompleter`, whose output a reader may leave."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # Windows writes no UTF-8 into pipes
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        try:
            main()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # the reader, such as `head`, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def main() -> None:
    """Run a command. Exit codes: 0 done, 2 wrong input, 1 anything else."""
    # Waiting threads of torch must not spin, which slows a busy machine down ten times.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    words = sys.argv[1:]
    if words == ["--version"]:
        print(__version__)
        return
    handle_stop_signals()
    # Without a last garbage collection of torch Python ends a second earlier.
    atexit.register(gc.freeze)
    # Damaged photographs are read or refused with a sentence; Pillow's warnings add nothing.
    warnings.filterwarnings("ignore", module="PIL")
    try:
        given = validate(parse_command(words))
        if isinstance(given, options.ComputeOptions):
            limit_threads(given.threads)
        _, module, function = COMMANDS[words[0]]
        gc.disable()  # imports leave no garbage, and searching for it takes 0.25 s
        command = getattr(import_module(f"gscompleter.apps.commands.{module}"), function)
        gc.freeze()  # each later search of torch for garbage would take 0.2 s
        gc.enable()
        command(given)
    except InputError as error:
        print(f"{PROGRAM}{format_error(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt as stop:
        reason = str(stop) or "no unfinished result was written"
        print(f"{PROGRAM}interrupted; {reason}.", file=sys.stderr)
        sys.exit(130)


def parse_command(words: Sequence[str]) -> Any:
    """Parse the options of the command; raises as `parse_words`."""
    return parse_words(words, Command, COMMANDS)

"""Entry point of the command line: options in, a command called, exit codes out."""

from __future__ import annotations

import atexit
import gc
import os
import select
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any, TextIO, Union

import tyro

from gscompleter import __version__
from gscompleter.apps.commands import options, tool_options
from gscompleter.apps.commands.words import format_error, parse_words
from gscompleter.apps.warmup.compilation import freeze_objects
from gscompleter.config.settings import validate
from gscompleter.cpu_threads import limit_threads
from gscompleter.errors import PROGRAM, InputError
from gscompleter.io.interrupts import handle_stop_signals

# Options, module and function of each command. The module is imported after the options are
# validated, so that `--help` does not wait for torch.
COMMANDS: dict[str, tuple[type, str, str]] = {
    "complete": (options.CompleteOptions, "complete", "run_completion"),
    "batch": (options.BatchOptions, "batch", "run_batch"),
    "live": (options.LiveOptions, "live", "run_live"),
    "clean": (options.CleanOptions, "clean", "run_clean"),
    "demo": (options.DemoOptions, "demo", "run_demo"),
    "evaluate": (options.EvaluateOptions, "evaluate", "run_evaluation"),
    "tables": (options.TablesOptions, "evaluate", "run_tables"),
    "index": (options.IndexOptions, "evaluate", "run_index"),
    "bench": (options.BenchOptions, "bench", "run_bench"),
    "models": (tool_options.ModelsOptions, "models", "run_models"),
    "convert": (tool_options.ConvertOptions, "convert", "run_convert"),
    "poses": (tool_options.PosesOptions, "poses", "run_poses"),
    "report": (tool_options.ReportOptions, "report", "run_report"),
    "strip": (tool_options.StripOptions, "convert", "run_strip"),
    "view": (tool_options.ViewOptions, "view", "run_view"),
    "doctor": (tool_options.DoctorOptions, "doctor", "run_doctor"),
    "warmup": (tool_options.WarmupOptions, "warmup", "run_warmup"),
}

Command: Any = Union[  # noqa: UP007  (of as many as there are)
    tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, (kind, _, _) in COMMANDS.items())
]


def run() -> None:
    """Run `main` and end the process at once: the command `gscompleter`.

    Python would otherwise take a fifth of a second to free torch's operators.
    """
    done: list[bool] = []
    # Functions that are registered later run before it.
    atexit.register(end_at_once, done)
    try:
        main()
    except BrokenPipeError:
        if not is_pipe_closed(sys.stdout):
            raise
        discard_output(sys.stdout)
        sys.exit(1)
    done.append(True)


def end_at_once(done: Sequence[bool]) -> None:
    """Flush the output, and end the process if it is `done`."""
    code = 0
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:
            discard_output(stream)
            code = 1
        except OSError:
            return  # Python reports it.
    if done:
        os._exit(code)


def is_pipe_closed(stream: TextIO) -> bool:
    """Return True if the reader of a pipe, such as `head`, has ended."""
    if not hasattr(select, "poll"):  # Windows
        return False
    poll = select.poll()
    poll.register(stream.fileno(), select.POLLOUT)
    return any(events & select.POLLERR for _, events in poll.poll(0))


def discard_output(stream: TextIO) -> None:
    """Discard all further output of a stream."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


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
        with freeze_objects():
            given = validate(parse_command(words))
            if isinstance(given, options.ComputeOptions):
                limit_threads(given.threads)
            _, module, function = COMMANDS[words[0]]
            module = f"gscompleter.apps.commands.{module}"
            command = getattr(import_module(module), function)
        command(given)
    except InputError as error:
        print(f"{PROGRAM}{format_error(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt as stop:
        goes_on = words[:1] in (["batch"], ["evaluate"])
        state = "run the same command again to continue" if goes_on else "nothing was written"
        print(f"gscompleter: interrupted; {str(stop) or state}.", file=sys.stderr)
        sys.exit(130)


def parse_command(words: Sequence[str]) -> Any:
    """Parse the options of the command; raises as `parse_words`."""
    return parse_words(words, Command, COMMANDS)

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
from gscompleter.apps.commands.convert import ConvertOptions
from gscompleter.apps.commands.doctor import DoctorOptions
from gscompleter.apps.commands.options import (
    BatchOptions,
    BenchOptions,
    CleanOptions,
    CompleteOptions,
    ComputeOptions,
    DemoOptions,
    EvaluateOptions,
    IndexOptions,
    LiveOptions,
    ModelsOptions,
    RunOptions,
    TablesOptions,
)
from gscompleter.apps.commands.poses import PosesOptions
from gscompleter.apps.commands.report import ReportOptions
from gscompleter.apps.commands.strip import StripOptions
from gscompleter.apps.commands.view import ViewOptions
from gscompleter.apps.commands.warmup import WarmupOptions
from gscompleter.apps.commands.words import format_error, parse_words
from gscompleter.apps.warmup.compilation import begin_compilation
from gscompleter.apps.warmup.garbage import freeze_objects
from gscompleter.config.settings import validate
from gscompleter.cpu_threads import limit_threads
from gscompleter.errors import PROGRAM, InputError
from gscompleter.io.interrupts import handle_stop_signals

# Options, module and function of each command. The module is imported after the options are
# validated, so that `--help` does not wait for torch.
COMMANDS: dict[str, tuple[type, str, str]] = {
    "complete": (CompleteOptions, "gscompleter.apps.commands.complete", "run_completion"),
    "batch": (BatchOptions, "gscompleter.apps.commands.batch", "run_batch"),
    "live": (LiveOptions, "gscompleter.apps.commands.live", "run_live"),
    "clean": (CleanOptions, "gscompleter.apps.commands.clean", "run_clean"),
    "demo": (DemoOptions, "gscompleter.apps.commands.demo", "run_demo"),
    "evaluate": (EvaluateOptions, "gscompleter.apps.commands.evaluate", "run_evaluation"),
    "tables": (TablesOptions, "gscompleter.apps.commands.evaluate", "run_tables"),
    "index": (IndexOptions, "gscompleter.apps.commands.evaluate", "run_index"),
    "bench": (BenchOptions, "gscompleter.apps.commands.bench", "run_bench"),
    "models": (ModelsOptions, "gscompleter.apps.commands.models", "run_models"),
    "convert": (ConvertOptions, "gscompleter.apps.commands.convert", "run_convert"),
    "poses": (PosesOptions, "gscompleter.apps.commands.poses", "run_poses"),
    "report": (ReportOptions, "gscompleter.apps.commands.report", "run_report"),
    "strip": (StripOptions, "gscompleter.apps.commands.strip", "run_strip"),
    "view": (ViewOptions, "gscompleter.apps.commands.view", "run_view"),
    "doctor": (DoctorOptions, "gscompleter.apps.commands.doctor", "run_doctor"),
    "warmup": (WarmupOptions, "gscompleter.apps.commands.warmup", "run_warmup"),
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
            options = validate(parse_command(words))
            if isinstance(options, ComputeOptions):
                limit_threads(options.threads)
            if isinstance(options, RunOptions):
                begin_compilation(options.models)
            _, module, function = COMMANDS[words[0]]
            command = getattr(import_module(module), function)
        command(options)
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

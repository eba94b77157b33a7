"""The command line: options in, a command called, errors turned into exit codes."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Annotated

import tyro

from gscompleter import __version__
from gscompleter.commands.convert import ConvertOptions
from gscompleter.commands.options import (
    CompleteOptions,
    DemoOptions,
    EvaluateOptions,
    IndexOptions,
    ModelsOptions,
    TablesOptions,
)
from gscompleter.commands.strip import StripOptions
from gscompleter.errors import InputError

Command = (
    Annotated[CompleteOptions, tyro.conf.subcommand("complete")]
    | Annotated[DemoOptions, tyro.conf.subcommand("demo")]
    | Annotated[EvaluateOptions, tyro.conf.subcommand("evaluate")]
    | Annotated[TablesOptions, tyro.conf.subcommand("tables")]
    | Annotated[IndexOptions, tyro.conf.subcommand("index")]
    | Annotated[ModelsOptions, tyro.conf.subcommand("models")]
    | Annotated[ConvertOptions, tyro.conf.subcommand("convert")]
    | Annotated[StripOptions, tyro.conf.subcommand("strip")]
)

# Where each command lives. Its module is imported once the arguments are known to be right, so
# that `--help` does not wait for torch.
COMMANDS = {
    CompleteOptions: ("gscompleter.commands.complete", "run_completion"),
    DemoOptions: ("gscompleter.commands.demo", "run_demo"),
    EvaluateOptions: ("gscompleter.commands.evaluate", "run_evaluation"),
    TablesOptions: ("gscompleter.commands.evaluate", "run_tables"),
    IndexOptions: ("gscompleter.commands.evaluate", "run_index"),
    ModelsOptions: ("gscompleter.commands.models", "run_models"),
    ConvertOptions: ("gscompleter.commands.convert", "run_convert"),
    StripOptions: ("gscompleter.commands.strip", "run_strip"),
}


def main() -> None:
    """Entry point. Exit codes: 0 done, 2 the input is wrong, 1 anything else."""
    # Threads of torch that spin while they wait cost a busy machine ten times the work they do.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if sys.argv[1:] == ["--version"]:
        print(__version__)
        return
    options = tyro.cli(
        Command,
        prog="gscompleter",
        description="Complete 3D Gaussian Splatting scenes: generate, then register.",
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    module, function = COMMANDS[type(options)]
    try:
        getattr(import_module(module), function)(options)
    except InputError as error:
        print(f"gscompleter: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        goes_on = isinstance(options, EvaluateOptions)
        state = "the same command goes on from here" if goes_on else "nothing was written"
        print(f"gscompleter: interrupted; {state}.", file=sys.stderr)
        sys.exit(130)

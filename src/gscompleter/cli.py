"""The command line: options in, a command called, errors turned into exit codes."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Annotated

import tyro

from gscompleter import __version__
from gscompleter.errors import InputError
from gscompleter.options import CompleteOptions, DemoOptions

Command = (
    Annotated[CompleteOptions, tyro.conf.subcommand("complete")]
    | Annotated[DemoOptions, tyro.conf.subcommand("demo")]
)

# Where each command lives. Its module is imported once the arguments are known to be right, so
# that `--help` does not wait for torch.
COMMANDS = {
    CompleteOptions: ("gscompleter.run", "run_completion"),
    DemoOptions: ("gscompleter.demo", "run_demo"),
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
        print("gscompleter: interrupted; nothing was written.", file=sys.stderr)
        sys.exit(130)

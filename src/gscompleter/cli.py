"""The command line: options in, a command called, errors turned into exit codes."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from importlib import import_module
from io import StringIO
from itertools import dropwhile, takewhile
from typing import Annotated, Any, Union

import tyro
from tyro.constructors import ConstructorRegistry, StructTypeInfo

from gscompleter import __version__
from gscompleter.commands.convert import ConvertOptions
from gscompleter.commands.doctor import DoctorOptions
from gscompleter.commands.generator_options import generator_flags
from gscompleter.commands.options import (
    FOUND,
    BenchOptions,
    CleanOptions,
    CompleteOptions,
    ComputeOptions,
    DemoOptions,
    EvaluateOptions,
    IndexOptions,
    LiveOptions,
    ModelsOptions,
    TablesOptions,
)
from gscompleter.commands.poses import PosesOptions
from gscompleter.commands.report import ReportOptions
from gscompleter.commands.strip import StripOptions
from gscompleter.commands.view import ViewOptions
from gscompleter.commands.warmup import WarmupOptions
from gscompleter.config import CompleterConfig, load_config
from gscompleter.config.settings import checked
from gscompleter.errors import InputError, quoted
from gscompleter.interrupts import treat_stops_alike
from gscompleter.threads import bound_threads

# Where each command lives. Its module is imported once the arguments are known to be right, so
# that `--help` does not wait for torch.
COMMANDS: dict[str, tuple[type, str, str]] = {
    "complete": (CompleteOptions, "gscompleter.commands.complete", "run_completion"),
    "live": (LiveOptions, "gscompleter.commands.live", "run_live"),
    "clean": (CleanOptions, "gscompleter.commands.clean", "run_clean"),
    "demo": (DemoOptions, "gscompleter.commands.demo", "run_demo"),
    "evaluate": (EvaluateOptions, "gscompleter.commands.evaluate", "run_evaluation"),
    "tables": (TablesOptions, "gscompleter.commands.evaluate", "run_tables"),
    "index": (IndexOptions, "gscompleter.commands.evaluate", "run_index"),
    "bench": (BenchOptions, "gscompleter.commands.bench", "run_bench"),
    "models": (ModelsOptions, "gscompleter.commands.models", "run_models"),
    "convert": (ConvertOptions, "gscompleter.commands.convert", "run_convert"),
    "poses": (PosesOptions, "gscompleter.commands.poses", "run_poses"),
    "report": (ReportOptions, "gscompleter.commands.report", "run_report"),
    "strip": (StripOptions, "gscompleter.commands.strip", "run_strip"),
    "view": (ViewOptions, "gscompleter.commands.view", "run_view"),
    "doctor": (DoctorOptions, "gscompleter.commands.doctor", "run_doctor"),
    "warmup": (WarmupOptions, "gscompleter.commands.warmup", "run_warmup"),
}

Command: Any = Union[  # noqa: UP007  (of as many as there are)
    tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, (kind, _, _) in COMMANDS.items())
]


def main() -> None:
    """Entry point. Exit codes: 0 done, 2 the input is wrong, 1 anything else."""
    # Threads of torch that spin while they wait cost a busy machine ten times the work they do.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    words = sys.argv[1:]
    if words == ["--version"]:
        print(__version__)
        return
    treat_stops_alike()
    # Pillow warns of damage in a photograph that is read all the same, or refused in a sentence.
    warnings.filterwarnings("ignore", module="PIL")
    try:
        options = checked(parsed(words))
        if isinstance(options, ComputeOptions):
            bound_threads(options.threads)
        _, module, function = COMMANDS[words[0]]
        getattr(import_module(module), function)(options)
    except InputError as error:
        print(f"gscompleter: {sentence_of(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt as stop:
        goes_on = words[:1] == ["evaluate"]
        state = "the same command goes on from here" if goes_on else "nothing was written"
        print(f"gscompleter: interrupted; {str(stop) or state}.", file=sys.stderr)
        sys.exit(130)


def sentence_of(error: InputError) -> str:
    """What went wrong, and the option that can mend it."""
    if error.argument is None:
        return str(error)
    return f"{str(error).removesuffix('.')} (--{error.argument.replace('_', '-')})."


def parsed(words: Sequence[str]) -> Any:
    """The options of the command that `words` name.

    Raises:
        InputError: where they are wrong, or the config that they name is.
        SystemExit: where they ask for help, which is printed.
    """
    said = StringIO()
    try:
        with redirect_stderr(said):
            config, words = config_named(auto_counted(words))
            return tyro.cli(
                Command,
                prog="gscompleter",
                description="Complete 3D Gaussian Splatting scenes: generate, then register.",
                args=words,
                config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
                registry=registry_from(config),
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise InputError(unboxed(said.getvalue(), words)) from None


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


def registry_from(config: CompleterConfig) -> ConstructorRegistry:
    """How tyro reads our classes: a CompleterConfig begins as `config`."""

    def config_flags(info: StructTypeInfo) -> Any:
        if info.type is not CompleterConfig or info.default == config:
            return None
        return ConstructorRegistry.get_struct_spec(StructTypeInfo.make(info.type, config, False))

    registry = ConstructorRegistry()
    registry.struct_rule(generator_flags)
    registry.struct_rule(config_flags)
    return registry


def unboxed(box: str, words: Sequence[str]) -> str:
    """The sentence in the box that tyro draws around an error; indented or below it stands help."""

    def is_empty(line: str) -> bool:
        return not line.strip("─- ")

    lines = [line[2:].rstrip("│ ") for line in box.splitlines()[1:]]
    said = takewhile(lambda line: not is_empty(line), dropwhile(is_empty, lines))
    sentence = " ".join(line.strip() for line in said if not line.startswith(" " * 5))
    usage = lines.index("Argument helptext:") + 1 if "Argument helptext:" in lines else None
    needed = "" if usage is None else f"; give {lines[usage].strip()}"
    command = " ".join(["gscompleter", *(word for word in words[:1] if word in COMMANDS)])
    return f"{quoted(sentence, 200).removesuffix('.')}{needed} (see {command} --help)."

"""The outputs of all commands compared with their inputs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gscompleter.apps.commands.options import (
    BatchOptions,
    ConvertOptions,
    IndexOptions,
    LiveOptions,
    StripOptions,
    ViewOptions,
    list_inputs,
)
from gscompleter.io.files import REMOVED_FILE
from gscompleter.io.overlap import refuse_input_file, refuse_overlap


def check_overlap(options: Any) -> None:
    """Raise an InputError if an output of a command is, holds or lies in one of its inputs."""
    inputs = list_inputs(options)
    if isinstance(options, ViewOptions):
        if options.save is not None:
            refuse_input_file(options.save, inputs, "save")
    elif isinstance(options, StripOptions):
        # The originals beside the completed scene are read, too.
        refuse_input_file(options.out, [*inputs, options.completed.with_name(REMOVED_FILE)])
    elif isinstance(options, (ConvertOptions, IndexOptions)):
        refuse_input_file(options.out, inputs)
    elif isinstance(getattr(options, "out", None), Path):
        if isinstance(options, BatchOptions):
            # Results may lie in a folder of scenes; the scenes themselves are compared later.
            inputs = [path for path in inputs if not path.is_dir()]
        # A live session saves several times, and reads its splat each time.
        refuse_overlap(options.out, inputs, may_continue=not isinstance(options, LiveOptions))

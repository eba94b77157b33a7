"""The outputs of all commands compared with their inputs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gscompleter.apps.commands.options import (
    BatchOptions,
    ConvertOptions,
    EvaluateOptions,
    IndexOptions,
    LiveOptions,
    StripOptions,
    ViewOptions,
    list_inputs,
)
from gscompleter.system.files.overlap import refuse_input_file, refuse_overlap
from gscompleter.system.files.writing import REMOVED_FILE


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
        if isinstance(options, IndexOptions):
            inputs = replace_by_scenes(inputs, [options.path])
        refuse_input_file(options.out, inputs)
    elif isinstance(getattr(options, "out", None), Path):
        if isinstance(options, BatchOptions):
            # Results may lie in a folder of scenes; the scenes themselves are compared later.
            inputs = [path for path in inputs if not path.is_dir()]
        if isinstance(options, EvaluateOptions):
            inputs = replace_by_scenes(inputs, options.paths)
        # A live session saves several times, and reads its splat each time.
        refuse_overlap(options.out, inputs, may_continue=not isinstance(options, LiveOptions))


def replace_by_scenes(inputs: Sequence[Path], folders: Sequence[Path]) -> list[Path]:
    """Replace folders of scenes by their scenes, beside which results may lie."""
    from gscompleter.evaluation.cases import list_scenes  # it needs torch, for which no help waits

    scenes = {path: list_scenes(path) for path in folders}
    return [place for path in inputs for place in scenes.get(path, [path])]

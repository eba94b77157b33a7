"""The record of a completion for its files: which values it labelled, and with which models."""

from __future__ import annotations

from gscompleter import __version__
from gscompleter.apps.inputs.task import InputSplatFile
from gscompleter.splats.provenance import ModelRecord, RunRecord, shorten
from gscompleter.state import NEW_PHOTO_ID, Completion
from gscompleter.system.files.reading import hash_file

TOOL = "gscompleter"
LICENCE = "Apache-2.0"
"""Licence of gscompleter, whose own models have no weights."""
OWN_MODULES = ("gscompleter.reconstructors.", "gscompleter.generators.")
"""Starts of the modules of its own models."""


def make_run(
    completion: Completion,
    splat_file: InputSplatFile | None,
    reconstructor: ModelRecord,
    generator: ModelRecord,
    depth: ModelRecord | None = None,
) -> RunRecord:
    """Make the record of a completion by these models, of the given splat if there is one."""
    added = completion.added.generated
    recolored = completion.recolored_context.generated[completion.recolored_mask]
    labels = [*added.unique().tolist(), *recolored.unique().tolist()]
    invented = [label for label in labels if label != NEW_PHOTO_ID]
    painters = [result.painter for result in completion.targets if result.painter]
    return RunRecord(
        TOOL,
        __version__,
        (min(invented), max(invented)) if invented else None,
        reconstructor,
        depth,
        generator if invented else None,
        shorten(painters[0]) if painters and invented else None,
        completion.seed,
        None if splat_file is None else hash_given(splat_file),
    )


def make_run_of_objects(completion: Completion, splat_file: InputSplatFile | None) -> RunRecord:
    """Make the record of a completion in Python, whose models are known by their names alone."""
    reconstructor, generator = map(describe_object, completion.made_with)
    return make_run(completion, splat_file, reconstructor, generator)


def describe_object(name: str) -> ModelRecord:
    """Describe the model of a class or function, by its name alone if it is ours.

    Of others the licence is not known.
    """
    if name.startswith(OWN_MODULES):
        return ModelRecord(name.rpartition(".")[2], None, LICENCE)
    return ModelRecord(shorten(name))


def hash_given(splat_file: InputSplatFile) -> str | None:
    """Compute the SHA-256 of the given splat; None for the folder of a .sog."""
    return hash_file(splat_file.path) if splat_file.path.is_file() else None

"""The record of a completion that was made in Python, for the files that it writes."""

from __future__ import annotations

from pathlib import Path

from gscompleter import __version__
from gscompleter.config.generators import GENERATORS
from gscompleter.parts import NOT_INVENTED
from gscompleter.splats.edits import hash_given
from gscompleter.splats.provenance import ModelRecord, RunRecord, shorten
from gscompleter.state import Completion

TOOL = "gscompleter"
LICENCE = "Apache-2.0"
"""Licence of gscompleter, whose own models have no weights."""
OWN_MODELS = ("plane-sweep", *(name for name, entry in GENERATORS.items() if entry.is_own))
"""Names of the models that are part of gscompleter."""


def make_run_record(
    completion: Completion,
    reconstructor: ModelRecord | None,
    depth: ModelRecord | None,
    generator: ModelRecord | None,
    given: Path | None,
) -> RunRecord:
    """Make the record of a completion with its models; `given` is the file of a given scene.

    A model is None where none took part. Of several painters the first is named.
    """
    labels = [part.origin.label for part in completion.added_parts if len(part)]
    # A recoloured Gaussian of the context has the number of its target, which is never 0.
    labels += completion.recolored.generated.unique().tolist()
    # What photographs show was added as well, and nobody invented it.
    invented = [label for label in labels if label != NOT_INVENTED]
    painters = [result.painter for result in completion.targets if result.painter]
    return RunRecord(
        tool=TOOL,
        version=__version__,
        labels=(min(invented), max(invented)) if invented else None,
        reconstructor=reconstructor,
        depth=depth,
        generator=generator if invented else None,
        painter=shorten(painters[0]) if painters and invented else None,
        seed=completion.seed,
        given=hash_given(given),
    )


def describe_python_run(completion: Completion, given: Path | None) -> RunRecord:
    """Describe a completion of the Python interface, whose models are known by their names."""
    names = completion.models
    return make_run_record(
        completion,
        record_model_by_name(names.get("reconstructor")),
        record_model_by_name(names.get("depth")),
        record_model_by_name(names.get("generator")),
        given,
    )


def record_model_by_name(name: str | None) -> ModelRecord | None:
    """Record a model by its name, without its weights; None if there is none."""
    if not name:
        return None
    return ModelRecord(shorten(name), licence=LICENCE if name in OWN_MODELS else None)

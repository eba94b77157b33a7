"""The record of a completion for the files that it writes: with which models, from what."""

from __future__ import annotations

import os
from pathlib import Path

from gscompleter.apps.inputs.task import CompletionTask
from gscompleter.apps.report.run_record import (
    LICENCE,
    OWN_MODELS,
    make_run_record,
    record_model_by_name,
)
from gscompleter.apps.requests.models import ModelRequest
from gscompleter.models.diffusion.published import PE_FIELD, find_usual_licence
from gscompleter.models.weights.published import PUBLISHED, UNSTATED
from gscompleter.splats.provenance import ModelRecord, RunRecord, shorten
from gscompleter.state import Completion
from gscompleter.system.plugins import is_in_file

PUBLISHED_BY_AUTHORS = {
    "pe-field": ModelRecord("pe-field", PE_FIELD.location, "non-commercial, of FLUX.1-Kontext-dev"),
}
"""Generators whose default weights are not in the table of published weights."""


def describe_maker(models: ModelRequest, task: CompletionTask, completion: Completion) -> RunRecord:
    """Describe a completion as the run that made its files."""
    weights = getattr(models.generator_settings, "weights", None)
    return make_run_record(
        completion,
        record_model(models.reconstructor, models.weights),
        record_depth(models, completion),
        record_model(models.generator, weights),
        None if task.splat_file is None else task.splat_file.path,
    )


def record_depth(models: ModelRequest, completion: Completion) -> ModelRecord | None:
    """Describe the monocular depth that helped Ψ; None if none did."""
    if models.depth != "none":
        return record_model(models.depth, models.depth_weights)
    # Maps beside the photographs help without an option: only the completion tells of them.
    return record_model_by_name(completion.models.get("depth"))


def record_model(name: str, weights: Path | str | None) -> ModelRecord:
    """Describe a model by its name on the command line, with weights that the user named.

    Of paths, which tell about the machine, only the last part is recorded.
    """
    if is_in_file(name):
        name = Path(name).name
    if weights is not None:
        # In full, since the last part of a path such as `.` names nothing. The links of annexed
        # files are not followed: they lead to names that are checksums.
        path = os.path.abspath(os.path.expanduser(weights))
        if os.path.exists(path):
            # The name of a file or folder tells no licence.
            return ModelRecord(shorten(name), shorten(os.path.basename(path)))
        # Everything else that was loaded is a repository.
        return ModelRecord(shorten(name), shorten(str(weights)), find_usual_licence(str(weights)))
    if name in OWN_MODELS:
        return ModelRecord(name, None, LICENCE)
    if name in PUBLISHED_BY_AUTHORS:
        return PUBLISHED_BY_AUTHORS[name]
    published = PUBLISHED.get(name)
    if published is None:
        return ModelRecord(shorten(name))
    licence = published.weights_licence
    return ModelRecord(name, published.name, None if licence == UNSTATED else shorten(licence))

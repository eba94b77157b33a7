"""What earlier commands invented in a splat, as the record beside its file says."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.apps.inputs.task import CompletionTask, InputSplatFile
from gscompleter.parts import NOT_INVENTED, OBSERVED
from gscompleter.splats.formats import detect_splat_format
from gscompleter.splats.row_kinds import find_rows_of_kinds, has_recolored, tells_kinds
from gscompleter.system.errors import quote_value
from gscompleter.system.files.writing import EDITS_FILE
from gscompleter.types import Gaussians


def mark_invented(task: CompletionTask) -> tuple[CompletionTask, tuple[str, ...]]:
    """Mark what earlier commands invented in the splat of a task; lines tell about it."""
    assert task.scene is not None
    assert task.splat_file is not None
    invented = read_invented_rows(task.splat_file, task.scene)
    is_unknown = invented is None and bool(has_target(task.scene).any())
    notes = (describe_unknown(task.splat_file),) if is_unknown else ()
    return replace(task, invented=invented), notes


def read_invented_rows(splat_file: InputSplatFile, scene: Gaussians) -> Bool[Tensor, "n"] | None:
    """Find the Gaussians of a splat that earlier commands invented; None if nothing tells.

    A label alone does not: Gaussians of a user that were recoloured for a target have its number.
    """
    edits = splat_file.edits
    if not tells_kinds(edits):
        return None
    path = splat_file.path
    if edits.is_unchanged and detect_splat_format(path) == "ply":
        # The rows of the file, then those of the context, which may be fewer and sorted.
        kept = splat_file.context_mask
        total = len(scene) if kept is None else len(kept)
        rows = torch.from_numpy(find_rows_of_kinds(path, edits, total, ("target", "gap")))
        rows = rows if kept is None else rows[kept]
        order = splat_file.file_order
        return rows.to(scene.means.device) if order is None else rows[order].to(scene.means.device)
    # Of a file whose rows are not known, labels tell as much if nothing was ever recoloured.
    if has_recolored(edits) or edits.edits[0].had_labels is not None:
        return None
    return has_target(scene)


def has_target(scene: Gaussians) -> Bool[Tensor, "n"]:
    """Find the Gaussians whose label is the number of a target."""
    return (scene.generated != OBSERVED) & (scene.generated != NOT_INVENTED)


def describe_unknown(splat_file: InputSplatFile) -> str:
    """Write the line on a completed splat of which nothing tells what was invented."""
    return (
        f"{quote_value(splat_file.path)} was completed before, and no {EDITS_FILE} beside it tells "
        "what was invented: that stays, also where photographs show something else."
    )

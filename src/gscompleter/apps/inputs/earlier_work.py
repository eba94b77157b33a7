"""The rows of a splat that earlier commands made, as the record beside its file says."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.apps.inputs.task import CompletionTask, InputSplatFile
from gscompleter.parts import INVENTED_KINDS, NOT_INVENTED, OBSERVED, EarlierWork
from gscompleter.splats.edits import Edits
from gscompleter.splats.formats import detect_splat_format
from gscompleter.splats.row_kinds import (
    find_rows_of_kinds,
    has_recolored,
    tells_kinds,
    tells_rows,
)
from gscompleter.system.errors import quote_value
from gscompleter.system.files.result_names import EDITS_FILE
from gscompleter.types import Gaussians

REMAKING = (
    "The splat was reconstructed from photographs of this folder: it is reconstructed anew from "
    "those and the photographs of this command (--forget-edits adds to it as it is)."
)


def mark_earlier_work(task: CompletionTask) -> tuple[CompletionTask, tuple[str, ...]]:
    """Mark what earlier commands made of the splat of a task; lines tell about it.

    Φ invented a part, and Ψ lifted a part from further photographs. The rest stays.
    """
    assert task.scene is not None
    assert task.splat_file is not None
    edits = task.splat_file.edits
    invented = read_rows(task.splat_file, task.scene, INVENTED_KINDS)
    if task.is_remade:
        # The record tells all rows, or nothing would be made anew.
        assert invented is not None
        return replace(task, earlier=EarlierWork(invented, remade=~invented)), (REMAKING,)
    # What a first command lifted stays: its own photographs would lose (decision 113).
    lifted = read_rows(task.splat_file, task.scene, ("photographs",))

    # Of a file whose rows are not known, labels tell as much if nothing was ever recoloured: those
    # of a user that were recoloured for a target have its number, too. Without a label nothing is
    # told if anything was invented once, since many programs keep no labels.
    labelled = has_target(task.scene)
    has_labels = bool(labelled.any())
    was_invented = has_invented(edits)
    tells_labels = tells_kinds(edits) and not has_other_labels(edits)
    if invented is None and tells_labels and (has_labels or not was_invented):
        invented = labelled
    is_unknown = invented is None and (has_labels or was_invented)
    notes = (describe_unknown(task.splat_file),) if is_unknown else ()
    return replace(task, earlier=EarlierWork(invented, lifted)), notes


def read_rows(
    splat_file: InputSplatFile, scene: Gaussians, kinds: Collection[str]
) -> Bool[Tensor, "n"] | None:
    """Find the Gaussians of a splat whose rows are of some kinds; None if nothing tells."""
    edits = splat_file.edits
    path = splat_file.path
    if not tells_rows(edits) or detect_splat_format(path) != "ply":
        return None
    # The rows of the file, then those of the context, which may be fewer and sorted.
    kept = splat_file.context_mask
    total = len(scene) if kept is None else len(kept)
    rows = torch.from_numpy(find_rows_of_kinds(path, edits, total, kinds))
    rows = rows if kept is None else rows[kept]
    order = splat_file.file_order
    return rows.to(scene.means.device) if order is None else rows[order].to(scene.means.device)


def has_invented(edits: Edits) -> bool:
    """Return True if edits invented Gaussians, of which later ones may have removed all."""
    return any(rows.kind in INVENTED_KINDS for edit in edits.edits for rows in edit.appended)


def has_other_labels(edits: Edits) -> bool:
    """Return True if Gaussians of a user may have the label of a target."""
    return has_recolored(edits) or edits.edits[0].had_labels is not None


def has_target(scene: Gaussians) -> Bool[Tensor, "n"]:
    """Find the Gaussians whose label is the number of a target."""
    return (scene.generated != OBSERVED) & (scene.generated != NOT_INVENTED)


def describe_unknown(splat_file: InputSplatFile) -> str:
    """Write the line on a completed splat of which nothing tells what was invented."""
    return (
        f"{quote_value(splat_file.path)} was completed before, and no {EDITS_FILE} beside it tells "
        "what was invented: that stays, also where photographs show something else."
    )

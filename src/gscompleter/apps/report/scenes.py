"""The splats of a completion: the scene before and after, what was added, and what went."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from gscompleter.apps.inputs.task import InputSplatFile
from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.splats.alignment.trainer_files import keep_trainer_files
from gscompleter.splats.edits import AppendedRows, EditDraft, Edits, record_edit
from gscompleter.splats.layout import save_like, save_removed
from gscompleter.splats.ply import save_parts, save_ply
from gscompleter.splats.provenance import NOTHING_KNOWN, Provenance, RunRecord
from gscompleter.state import Completion
from gscompleter.system.files.result_names import COMPLETED_FILE, CONTEXT_FILE, REMOVED_FILE
from gscompleter.types import Gaussians, merge

GENERATED_FILE = "generated.ply"
"""Gaussians that were added, without the recoloured ones."""


def write_scenes(
    folder: Path,
    completion: Completion,
    input_splat: InputSplatFile | None,
    run: RunRecord | None,
    edit: EditDraft,
) -> None:
    """Write the three scenes, the originals of changed Gaussians, and `edits.json`.

    Of an input splat, what its trainer left beside it goes with it.

    `run` is what the completed scene and the additions say about who made them.
    """
    made_by = NOTHING_KNOWN if run is None else Provenance((run,))
    # What is added lies in the frame of the context, and is written in that of its file.
    added = replace(completion.added, origin=completion.context.origin)
    changed = completion.recolored_mask | completion.source.gone_mask
    generated = merge([completion.recolored, added])
    if input_splat is None:
        order = torch.arange(len(completion.context))
        parts = [(part, torch.arange(len(part))) for part in (completion.kept_context, added)]
        write_completed = partial(
            save_parts, folder / COMPLETED_FILE, parts, provenance=True, made_by=made_by
        )
    else:
        # In the layout and the order of the user's file, so that what was kept is kept bit by bit.
        order = find_file_order(completion.context, input_splat)
        write_completed = partial(
            save_completed_splat, folder, completion.context, changed, generated, input_splat, run
        )
    # The context has labels if it was completed before.
    has_labels = bool((completion.context.generated > 0).any())
    # Beside an input splat, `save_completed_splat` writes what went.
    if input_splat is None and completion.source.gone_mask.any():
        rows = completion.source.gone_mask.nonzero()[:, 0].cpu()
        save_removed(
            folder / REMOVED_FILE, completion.context[completion.source.gone_mask].to("cpu"), rows
        )
    writing = [
        write_completed,
        partial(save_parts, folder / CONTEXT_FILE, [(completion.context, order)], has_labels),
        partial(save_ply, folder / GENERATED_FILE, added, provenance=True, made_by=made_by),
    ]
    map_in_parallel(lambda write: write(), writing)
    if input_splat is not None:
        keep_trainer_files(input_splat.path, folder)
    record_edit(
        folder,
        replace(edit, seed=completion.seed),
        len(completion.context),
        list_appended(completion, input_splat is not None),
        None if input_splat is None else input_splat.path,
        Edits(folder) if input_splat is None else input_splat.edits,
        run,
        replace(completion.source.removed, origin=completion.context.origin),
        # Without the file of the given scene, recoloured rows stand where their originals were.
        can_be_undone=input_splat is not None or not completion.recolored_mask.any().item(),
    )


def list_appended(completion: Completion, appends_recolored: bool) -> list[AppendedRows]:
    """List the kinds of the rows of `completed.ply` after those of the context, in their order.

    `appends_recolored` is False if recoloured Gaussians stand in the rows of their originals.
    """
    num_recolored = len(completion.recolored) if appends_recolored else 0
    rows = [AppendedRows("recolored", num_recolored)]
    rows += [AppendedRows(part.origin.kind, len(part)) for part in completion.added_parts]
    return [row for row in rows if row.count]


def find_file_order(context: Gaussians, input_splat: InputSplatFile) -> Int64[Tensor, "n"]:
    """Find the Gaussians of the context in the order of the input file."""
    if input_splat.file_order is None:
        return torch.arange(len(context))
    # `file_order[i]` is the place in the file of Gaussian i; this inverts it.
    order = torch.empty_like(input_splat.file_order)
    order[input_splat.file_order] = torch.arange(len(order))
    return order


def save_completed_splat(
    folder: Path,
    context: Gaussians,
    changed: Bool[Tensor, "n"],
    generated: Gaussians,
    input_splat: InputSplatFile,
    run: RunRecord | None = None,
) -> None:
    """Write `completed.ply` in the layout of the input splat, and the originals of the changed.

    `changed` marks the Gaussians of the context that were recoloured or removed. Recoloured ones
    stand among the generated ones, after all that kept its bits.
    """
    kept = input_splat.context_mask
    order = find_file_order(context, input_splat)
    if not changed.any():
        save_like(folder / COMPLETED_FILE, context, generated, input_splat.path, kept, order, run)
        return
    save_changed(folder, context, changed, input_splat)
    # The mask in the order of the file, over the Gaussians of the context and over all of the file.
    stays = ~changed.cpu()[order]
    order = order[stays]
    if kept is not None:
        stays = torch.zeros_like(kept).masked_scatter(kept, stays)
    save_like(folder / COMPLETED_FILE, context, generated, input_splat.path, stays, order, run)


def save_changed(
    folder: Path, context: Gaussians, changed: Bool[Tensor, "n"], input_splat: InputSplatFile
) -> None:
    """Write `removed.ply`, the originals of the changed Gaussians."""
    order = find_file_order(context, input_splat)
    rows = changed.cpu()[order].nonzero()[:, 0]
    removed = context[order[rows].to(context.means.device)].to("cpu")
    kept = input_splat.context_mask
    save_removed(folder / REMOVED_FILE, removed, rows, input_splat.path, kept)

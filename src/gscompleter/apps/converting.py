"""Conversion of splats: read, joined, cut, turned, reduced, and written in another format."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path

import torch

from gscompleter.apps.requests.conversion import ConversionRequest
from gscompleter.numerics.value_checks import check_gaussians
from gscompleter.parts import MAX_TARGET_ID, NOT_INVENTED, find_last_target_id
from gscompleter.splats.alignment.trainer_frames import list_model_folders
from gscompleter.splats.conversion import (
    Conversion,
    convert_rows,
    is_ply_to_ply,
    measure_rounding,
    write_converted,
)
from gscompleter.splats.formats import (
    describe_oddities,
    detect_splat_format,
    find_origin,
    load_splat,
    read_provenance,
)
from gscompleter.splats.operations import Operations
from gscompleter.splats.packing import DegreeError
from gscompleter.splats.provenance import NOTHING_KNOWN, Provenance, RunRecord
from gscompleter.splats.streamed import is_streamed, load_level
from gscompleter.splats.transform import merge_placed
from gscompleter.splats.upward import USUAL, read_upward
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.result_names import REMOVED_FILE
from gscompleter.system.progress import stage
from gscompleter.types import Gaussians

MIN_LOGGED_BYTES = 50_000_000
"""Size of the files, in bytes, from which on a log says that they are converted."""
CAMERAS_FILE = "cameras.json"
"""File of a trainer with the cameras of its splat, in a folder of its model."""
UP_TOLERANCE = 1e-3
"""Difference of a component of two upward directions that count as one."""


def convert(request: ConversionRequest) -> Conversion:
    """Convert one splat or several, and say what the result does not keep."""
    sources = request.sources
    operations = make_operations(request)
    for source in sources:
        if request.level is None and is_streamed(source):
            raise InputError(
                f"{quote_value(source)} is a streamed scene in several levels of detail; choose "
                "one, of which 0 is the finest.",
                "level",
            )
        # What is no splat is refused before anything is said to be done.
        if not is_streamed(source):
            detect_splat_format(source)
    try:
        with show_conversion(sources):
            return convert_sources(sources, request, operations)
    except DegreeError as error:
        raise InputError(
            "A splat has harmonics of SH degree 4, and degrees 0 to 3 are read; say that the "
            "fourth band is to be left out: 3.",
            "bands",
        ) from error


def show_conversion(sources: Sequence[Path]) -> AbstractContextManager[object]:
    """Show the conversion of large files, which takes seconds; a small one is done at once."""
    size = sum(source.stat().st_size for source in sources if source.is_file())
    return stage("converting") if size >= MIN_LOGGED_BYTES else nullcontext()


def convert_sources(
    sources: Sequence[Path], request: ConversionRequest, operations: Operations
) -> Conversion:
    """Convert splats that `convert` has checked, row by row if that is possible."""
    plain = [source for source in sources if not is_streamed(source)]
    oddities = [line for source in plain for line in describe_oddities(source)]
    notes = (*oddities, *describe_left_behind(sources, request.out, operations))
    keep_labels = not request.plain
    if can_convert_rows(sources, request, operations):

        def edit(rows: Gaussians) -> Gaussians:
            edited = operations.apply_to_rows(rows)
            check_gaussians(edited, "The scene to write")
            return edited

        done = convert_rows(
            sources[0],
            request.out,
            request.drop_nonfinite,
            keep_labels,
            request.ignore_properties,
            edit if operations.changes else None,
            leaves_out_band_4=request.bands is not None,
        )
        return replace(done, notes=notes)

    gaussians, made_by = read_all(sources, request)
    gaussians = operations.apply(gaussians)
    if len(gaussians) == 0:
        raise InputError("No Gaussian is left; change what is cut off.")
    done = write_converted(request.out, gaussians, made_by, keep_labels)
    done = replace(done, notes=(*done.notes, *notes))
    # Of a splat with an origin, the notes say the rounding.
    if gaussians.origin is not None:
        return done
    means = gaussians.means
    scales = gaussians.scales
    # Harmonics are most of the memory, and those of the file are read now.
    del gaussians
    return replace(done, rounding=measure_rounding(request.out, means, scales))


def make_operations(request: ConversionRequest) -> Operations:
    """Make the operations that are asked for."""
    return Operations(
        bands=request.bands,
        box=request.crop_box,
        sphere=request.crop_sphere,
        scale=request.scale,
        rotate=request.rotate,
        translate=request.translate,
        decimate=request.decimate,
    )


def can_convert_rows(
    sources: Sequence[Path], request: ConversionRequest, operations: Operations
) -> bool:
    """Check whether some Gaussians can be in memory at a time: from one .ply to another."""
    if len(sources) > 1 or request.level is not None or not operations.is_by_rows:
        return False
    if operations.similarity is not None:
        # The sizes of all Gaussians decide whether a shifted splat gets an origin, and so whether
        # its positions are written as double. What stays about zero has none.
        if any(operations.translate):
            return False
        if find_origin(sources[0], leaves_out_band_4=request.bands is not None) is not None:
            return False
    return is_ply_to_ply(sources[0], request.out)


def read_all(sources: Sequence[Path], request: ConversionRequest) -> tuple[Gaussians, Provenance]:
    """Read all splats as one, with the record of who made them."""
    if request.level is not None and not any(is_streamed(source) for source in sources):
        raise InputError(
            f"{quote_value(sources[0])} has no levels of detail; leave --level out.", "level"
        )
    parts = []
    runs: list[RunRecord] = []
    labels_used = 0
    for source in sources:
        if request.level is not None and is_streamed(source):
            part = load_level(source, request.level, request.drop_nonfinite)
            made_by = NOTHING_KNOWN
        else:
            part = load_splat(
                source,
                request.drop_nonfinite,
                request.ignore_properties,
                leaves_out_band_4=request.bands is not None,
            )
            made_by = read_provenance(source) if not request.plain else NOTHING_KNOWN
        if not request.plain:
            part, made_by = move_labels(part, made_by, labels_used, source)
            # A target whose Gaussians are all gone keeps its number in the record.
            recorded = [run.labels[1] for run in made_by.runs if run.labels is not None]
            labels_used = max(labels_used, find_last_target_id(part), *recorded)
        parts.append(part)
        runs += made_by.runs
    return merge_placed(parts) if len(parts) > 1 else parts[0], Provenance(tuple(runs))


def move_labels(
    part: Gaussians, made_by: Provenance, labels_used: int, source: Path
) -> tuple[Gaussians, Provenance]:
    """Move the numbers of the targets of a splat behind those of the splats before it.

    `labels_used` is the last number of these. Raises InputError where a number of a Gaussian
    becomes larger than `MAX_TARGET_ID`.
    """
    if labels_used == 0:
        return part, made_by
    is_target = (part.generated > 0) & (part.generated < NOT_INVENTED)
    moved = part.generated.int() + labels_used * is_target
    if is_target.any() and moved[is_target].max() > MAX_TARGET_ID:
        raise InputError(
            f"With {quote_value(source)} there are more than {MAX_TARGET_ID} targets; leave the "
            "labels out (--plain)."
        )
    runs = tuple(
        run
        if run.labels is None
        else replace(run, labels=(run.labels[0] + labels_used, run.labels[1] + labels_used))
        for run in made_by.runs
    )
    return replace(part, generated=moved.to(torch.uint8)), Provenance(runs)


def describe_left_behind(
    sources: Sequence[Path], out: Path, operations: Operations
) -> Iterator[str]:
    """Describe what belongs to the splats or is said in them, and does not hold for the result."""
    similarity = operations.similarity
    turn = torch.eye(3, dtype=torch.float64)
    if similarity is not None:
        turn = similarity[:3, :3] / operations.scale
    for source in sources:
        if is_streamed(source):
            continue
        up = read_upward(source)
        if up is not None:
            turned = turn @ torch.tensor(up, dtype=torch.float64)
            if (turned - torch.tensor(USUAL, dtype=torch.float64)).abs().max() > UP_TOLERANCE:
                # A sum with zero is never -0.
                words = " ".join(f"{x:.4g}" for x in (turned + 0.0).tolist())
                yield (
                    f"{quote_value(source.name)} says which way is up, which "
                    f"{quote_value(out.name)} does not keep: name it with --up {words}."
                )
        folders = list_model_folders(source)
        if similarity is not None and any((home / CAMERAS_FILE).is_file() for home in folders):
            yield (
                f"The {CAMERAS_FILE} of {quote_value(source.name)} is for the splat as it was, and "
                f"does not fit {quote_value(out.name)}."
            )
        changes = operations.changes or len(sources) > 1
        if changes and (source.parent / REMOVED_FILE).is_file():
            yield (
                f"`strip` cannot take back what was done to {quote_value(source.name)} from "
                f"{quote_value(out.name)}, whose Gaussians are others; strip first to undo it."
            )

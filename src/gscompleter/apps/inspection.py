"""Inspect a splat: its Gaussians, and the part of them that is invented."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from rich.table import Table
from torch import Tensor

from gscompleter.apps.report.schema import find_completed, holds_completion, read_summary
from gscompleter.apps.requests.viewing import InspectionRequest
from gscompleter.apps.viewer.exhibit import (
    ViewerContent,
    load_known_cameras,
    load_scene_cameras,
    place_content,
)
from gscompleter.apps.warmup import compile_kernels
from gscompleter.config.settings import Device
from gscompleter.evaluation.verdict.numbers import format_percent
from gscompleter.numerics.value_checks import find_finite
from gscompleter.parts import NOT_INVENTED
from gscompleter.render.device import choose_device
from gscompleter.render.loading import load_renderer
from gscompleter.render.protocols import Renderer
from gscompleter.splats.edits import read_edits
from gscompleter.splats.foreign import resolve_splat
from gscompleter.splats.formats import (
    decode_splat,
    describe_oddities,
    describe_other_name,
    detect_splat_format,
    read_provenance,
)
from gscompleter.splats.origin import count_digits
from gscompleter.splats.ply import MIDDLE_QUANTILES, check_finite
from gscompleter.splats.provenance import ModelRecord, RunRecord
from gscompleter.splats.row_kinds import count_row_kinds
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.result_names import SUMMARY_FILE
from gscompleter.types import Camera, Gaussians, Origin, sh_from_rgb

ORIGINS = {
    "given": "as they were",
    "recolored": "recoloured",
    "photographs": "added from photographs",
    "piece": "pieces of what was cut",
    "target": "invented for targets",
    "gap": "invented in thin gaps",
}
"""Words for a person about each kind of rows."""

Bounds = tuple[tuple[float, float], ...]
"""Smallest and largest x, y and z of centres, in the frame and unit of the file."""


@dataclass(frozen=True)
class MadeRow:
    """Gaussians that one run added, or whose run the file does not name."""

    gaussians: int
    """Gaussians with its labels."""
    labels: tuple[int, int] | None
    made_by: RunRecord | None
    """None if the file does not say who added them."""


@dataclass(frozen=True)
class PictureRow:
    """Shares of the area of a picture by the origin of the Gaussians; they add up to 1."""

    camera: str
    invented: float
    from_photographs: float
    """Added or recoloured as photographs show."""
    given: float
    """Share of the scene before the completion."""
    empty: float


@dataclass(frozen=True)
class Inspection:
    """Contents and origin of a splat."""

    file: str
    format: str
    bytes: int | None
    """Size of the file; None for a folder."""
    gaussians: int
    nonfinite: int
    """Gaussians with NaN, infinity or no rotation, which nothing below counts."""
    sh_degree: int
    antialiased: bool
    extent: Bounds
    extent_of_98_percent: Bounds
    """Without the hundredth at either end."""
    invented: int
    from_photographs: int
    origins: Mapping[str, int] | None
    """Gaussians by their kind, as the record of edits beside the file tells; None if none does."""
    runs: tuple[MadeRow, ...]
    record_defect: str | None
    """Why the record of the runs cannot be read; None if it can, or if there is none."""
    pictures: tuple[PictureRow, ...]
    notes: tuple[str, ...] = ()


def inspect_splat(request: InspectionRequest) -> Inspection:
    """Inspect a file, and the pictures of it at the cameras that are known.

    Raises InputError for a file that is no splat or holds nothing finite, and for cameras that
    cannot be read.
    """
    path, folder = locate_inspected(request.file)
    # Other readers refuse a file with NaN; here those Gaussians are counted, and left out.
    decoded = decode_splat(path)
    finite = find_finite(decoded)
    check_finite(int(finite.sum()), len(decoded), path, drop_nonfinite=True)
    gaussians = decoded[finite]
    # A damaged record is told beside the Gaussians, which can be read without it.
    defect = None
    runs: tuple[RunRecord, ...] = ()
    try:
        runs = read_provenance(path).runs
    except InputError as error:
        defect = str(error)
    labels = gaussians.generated
    cameras, notes = list_cameras(request, folder, gaussians)
    origins = None
    try:
        origins = count_row_kinds(path, read_edits(path), len(decoded))
    except InputError as error:
        notes = (str(error), *notes)
    other_name = describe_other_name(path)
    if other_name is not None:
        notes = (other_name, *notes)
    low, high = gaussians.means.amin(0), gaussians.means.amax(0)
    return Inspection(
        file=str(path),
        format=detect_splat_format(path),
        bytes=None if path.is_dir() else path.stat().st_size,
        gaussians=len(decoded),
        nonfinite=len(decoded) - len(gaussians),
        sh_degree=gaussians.sh_degree,
        antialiased=gaussians.is_antialiased,
        extent=make_bounds(low, high, gaussians.origin),
        extent_of_98_percent=make_bounds(*compute_middle(gaussians.means), gaussians.origin),
        invented=int(find_invented(labels).sum()),
        from_photographs=int((labels == NOT_INVENTED).sum()),
        origins=origins,
        runs=tuple(list_runs(labels, runs)),
        record_defect=defect,
        pictures=measure_pictures(gaussians, cameras, request.device) if cameras else (),
        notes=(*describe_oddities(path), *notes),
    )


def locate_inspected(file: Path) -> tuple[Path, Path | None]:
    """Find the splat, and the folder of the completion that it lies in, or None."""
    path = resolve_splat(file)
    # The folder of `demo` holds that of its completion.
    for folder in (file, file / "completion"):
        if (folder / SUMMARY_FILE).is_file() and find_completed(folder).is_file():
            path = find_completed(folder)
            break
    return path, path.parent if holds_completion(path.parent) else None


def make_bounds(
    low: Float[Tensor, "3"], high: Float[Tensor, "3"], origin: Origin | None = None
) -> Bounds:
    """Pair the smallest and the largest coordinate of each axis, in the frame of the file."""
    place = torch.tensor(origin or (0, 0, 0), dtype=torch.float64)
    lowest, highest = low.double() + place, high.double() + place
    return tuple(zip(lowest.tolist(), highest.tolist(), strict=True))


def compute_middle(means: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Compute the `MIDDLE_QUANTILES` of the coordinates of the Gaussians that exist."""
    # numpy sorts any number of them, and torch no more than 16 million.
    low, high = np.quantile(means.numpy(), MIDDLE_QUANTILES, axis=0, method="nearest")
    return torch.from_numpy(low), torch.from_numpy(high)


def find_invented(labels: UInt8[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Mark the Gaussians that were added or recoloured for a target, by their labels."""
    return (labels > 0) & (labels != NOT_INVENTED)


def list_runs(labels: UInt8[Tensor, "n"], runs: Sequence[RunRecord]) -> Iterator[MadeRow]:
    """List what each run invented, and at last what no run claims."""
    # A label that two runs name counts for the first of them, so that the counts add up.
    rest = find_invented(labels)
    for run in runs:
        mine = torch.zeros_like(rest)
        if run.labels is not None:
            first, last = run.labels
            mine = rest & (labels >= first) & (labels <= last)
        rest = rest & ~mine
        yield MadeRow(int(mine.sum()), run.labels, run)
    if rest.any():
        unknown = labels[rest]
        yield MadeRow(int(rest.sum()), (int(unknown.min()), int(unknown.max())), None)


def list_cameras(
    request: InspectionRequest, folder: Path | None, gaussians: Gaussians
) -> tuple[list[tuple[str, Camera]], tuple[str, ...]]:
    """List the cameras of pictures with their names, and notes on those that are missing.

    They are in the frame of `gaussians`: the coordinates of the file less its local origin.
    """
    # Files of cameras are in the frame of the photographs of a completion, which its transform
    # leads from, or else in that of the file.
    summary = None if folder is None else read_summary(folder)
    content = place_content(
        ViewerContent("", gaussians, None), None if summary is None else summary.frame
    )
    if request.cameras is not None:
        cameras = load_scene_cameras(
            request.cameras, content.transform, content.origin, request.resolution
        )
        return [(f"Camera {number}", camera) for number, camera in enumerate(cameras, 1)], ()
    if folder is None or summary is None:
        return [], ()
    known, notes = load_known_cameras(folder, summary, content)
    return [(one.title, one.camera) for one in known], notes


def measure_pictures(
    gaussians: Gaussians, cameras: Sequence[tuple[str, Camera]], device: Device
) -> tuple[PictureRow, ...]:
    """Measure what pictures show of a splat whose labels are known."""
    chosen = choose_device(device)
    compile_kernels([chosen])
    renderer = load_renderer(chosen)
    painted = paint_labels(gaussians).to(chosen)
    return tuple(
        measure_picture(painted, name, camera.to(chosen), renderer) for name, camera in cameras
    )


def paint_labels(gaussians: Gaussians) -> Gaussians:
    """Paint what is invented red, what photographs show green, and the rest blue."""
    labels = gaussians.generated
    from_photographs = labels == NOT_INVENTED
    colors = torch.stack([find_invented(labels), from_photographs, labels == 0], dim=1)
    return replace(gaussians, sh=sh_from_rgb(colors.float()))


def measure_picture(
    painted: Gaussians, name: str, camera: Camera, renderer: Renderer
) -> PictureRow:
    """Measure a picture of painted Gaussians: each channel of a pixel is the weight of its kind."""
    # Colours are over black, so that the channels and 1 - alpha add up to 1.
    render = renderer.render(painted, camera)
    invented, from_photographs, given = render.image.mean(dim=(0, 1)).tolist()
    return PictureRow(name, invented, from_photographs, given, 1 - render.alpha.mean().item())


def print_inspection(found: Inspection, as_json: bool) -> None:
    """Print the result as JSON, or as lines and a table."""
    if as_json:
        print(json.dumps(asdict(found), indent=2))
        return
    console = make_console()
    console.print(found.file, soft_wrap=True)
    for title, text in describe_splat(found):
        console.print(f"  {title:12} {text}", soft_wrap=True)
    if found.pictures:
        console.print(make_picture_table(found.pictures))
    for note in found.notes:
        console.print(note, soft_wrap=True)


def describe_splat(found: Inspection) -> Iterator[tuple[str, str]]:
    """Describe a splat in lines of a title and a text."""
    size = "" if found.bytes is None else f", {found.bytes / 1e6:,.1f} MB"
    yield "format", f"{found.format}{size}"
    yield "Gaussians", f"{found.gaussians:,}, harmonics of degree {found.sh_degree}"
    yield "not finite", f"{found.nonfinite:,}"
    yield "antialiased", "yes" if found.antialiased else "no"
    yield "extent", describe_bounds(found.extent)
    yield "98 % of it", describe_bounds(found.extent_of_98_percent)
    count = found.gaussians - found.nonfinite
    yield "invented", f"{found.invented:,} ({format_percent(found.invented / count)})"
    shown = format_percent(found.from_photographs / count)
    yield "photographs", f"{found.from_photographs:,} ({shown}) added or recoloured as they show"
    if found.origins is not None:
        kinds = [f"{count:,} {ORIGINS[kind]}" for kind, count in found.origins.items()]
        yield "origins", ", ".join(kinds)
    for row in found.runs:
        yield "made by", describe_run_row(row)
    if found.record_defect is not None:
        yield "made by", found.record_defect
    elif not found.runs:
        yield "made by", "the file does not say"


def describe_bounds(bounds: Bounds) -> str:
    """Describe an extent in scene units."""
    axes = zip("xyz", bounds, strict=True)
    return ", ".join(f"{axis} {describe_interval(low, high)}" for axis, (low, high) in axes)


def describe_interval(low: float, high: float) -> str:
    """Describe a range with as many digits as tell its ends apart to a thousandth of it."""
    digits = count_digits(low, high)
    return f"{low:.{digits}g} to {high:.{digits}g}"


def describe_run_row(row: MadeRow) -> str:
    """Describe who made what, on one line."""
    if row.labels is None:
        part = "nothing invented"
    else:
        first, last = row.labels
        labels = f"label {first}" if first == last else f"labels {first} to {last}"
        part = f"{row.gaussians:,} of {labels}"
    run = row.made_by
    if run is None:
        return f"{part}: the file does not say"
    models = [describe_model(model) for model in (run.reconstructor, run.depth, run.generator)]
    used = [model for model in models if model]
    used += [f"painted by {quote_value(run.painter)}"] if run.painter else []
    used += [] if run.seed is None else [f"seed {run.seed}"]
    used += [] if run.given is None else [f"given SHA-256 {run.given}"]
    tool = f"{quote_value(run.tool)} {quote_value(run.version)}"
    return f"{tool} ({'; '.join([part, *used])})"


def describe_model(model: ModelRecord | None) -> str:
    """Describe a model with its weights and licence; empty for none."""
    if model is None:
        return ""
    weights = "" if model.weights in (None, model.name) else f" with {quote_value(model.weights)}"
    licence = "licence not known" if model.licence is None else quote_value(model.licence)
    return f"{quote_value(model.name)}{weights} ({licence})"


def make_picture_table(rows: Sequence[PictureRow]) -> Table:
    """Make the table of what pictures show."""
    table = Table("picture", "invented", "from photographs", "given", "empty", box=None)
    for row in rows:
        shares = (row.invented, row.from_photographs, row.given, row.empty)
        table.add_row(row.camera, *(format_percent(share) for share in shares))
    return table

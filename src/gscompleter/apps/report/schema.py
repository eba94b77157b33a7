"""Rows of `summary.json` and `report.json`, which a completion writes, and their readers.

Shares and fractions are in [0, 1], PSNR is in dB, and frames are the numbers of photographs.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, TypeVar

import numpy as np

from gscompleter.data.photograph_names import name_photograph, name_target
from gscompleter.evaluation.metrics.coverage import Coverage
from gscompleter.evaluation.verdict.kept import KeptRow
from gscompleter.evaluation.verdict.rows import HeldOutRow, OutcomeRow, ScoreRow
from gscompleter.numerics.given_geometry import GeometryPlacement
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_folder import read_command, refuse_later_results
from gscompleter.system.files.result_names import COMPLETED_FILES, SUMMARY_FILE
from gscompleter.system.files.typed_json import read_typed_json

RECORD_FILE = "report.json"
SUMMARY_ADVICE = "complete the scene again"
"""Advice about a damaged file, for errors."""
COMPLETION_COMMANDS = (None, "complete")
"""Commands that write completions, as `summary.json` names them. None is a folder of unknown
origin, which is refused by what its files lack."""
MAX_FRAME_NUMBER = 1e12
"""Largest absolute number of the transform and the origin of a `ResultFrame`: the determinant and
what is computed in float32 stay finite."""

EARLY_ENTRIES: Mapping[str, Any] = MappingProxyType(
    {
        "outcome": {
            "status": "completed",
            "headline": "An early version completed this scene, and gave no verdict.",
        }
    }
)
"""Entries of `summary.json` that versions before the first number of a format did not all write."""

SCORES = ("psnr_before", "psnr_after", "ssim_before", "ssim_after")
"""Names of the scores of a `ScoreRow`."""

T = TypeVar("T")
Vector = tuple[float, float, float]
MatrixRow = tuple[float, float, float, float]


@dataclass(frozen=True)
class AlignmentRow:
    """Depth alignment of a target, as in `DepthAffine`: `scale * depth + shift`."""

    scale: float
    shift: float
    """In scene units."""
    inliers: float
    """Fraction of the compared pixels that agree with the fit."""
    method: str
    """Estimator: ransac, median or identity."""
    agreement: float | None = None
    """Fraction of the context visible at the target that agrees with it; None if not checked."""


@dataclass(frozen=True)
class ContextRow(ScoreRow):
    """A photograph of the context, or one that checks an input splat."""

    exposure_gain: Vector | None = None
    """Exposure of the original photograph over that of the scene, by channel: its colours are
    divided by this for use. None if not estimated."""
    dynamic_fraction: float = 0.0
    """Share of the pixels that show what moved."""
    given_depth: float = 0.0
    """Share of the pixels whose depth was given."""
    ignored: float = 0.0
    """Share of the pixels that are ignored, by masks for example."""
    pose_error: float | None = None
    """Median distance, in pixels of the photographs at their working size, of features that it
    shares with other photographs from where the poses put them; None for fewer than three
    photographs, or few features."""


@dataclass(frozen=True)
class UnfilledRow:
    """The part of the dilated hole mask, at the padded target, that stays empty."""

    share: float = 0.0
    """Share of the pixels of the mask."""
    lost_by: Mapping[str, float] = field(default_factory=dict)
    """The same by the step or guard that lost them; empty if there is little."""
    regions: tuple[tuple[int, int, int, int], ...] = ()
    """Boxes (left, top, right, bottom) of the largest regions, in pixels of the target image; its
    padding has coordinates below 0 and beyond its size."""


@dataclass(frozen=True)
class FittedRow:
    """Scores after a pose and a gain of the target's camera were fitted to its photograph.

    `evaluation.metrics.fitted_camera` has the formula.
    """

    psnr: float
    """PSNR of the whole image."""
    observed_psnr: float
    """PSNR outside of holes."""
    moved: float
    """Length of the fitted rotation and shift, in pixels of an image whose longer side is at most
    320."""
    gain: float
    """Mean of the fitted exposure gains of the channels."""


@dataclass(frozen=True)
class GeometryRow:
    """What geometry from elsewhere (`settings.geometry`) gives at a target."""

    share: float = 0.0
    """Share of the pixels of the hole, at the padded target, whose depth it gives."""
    contradicted: float = 0.0
    """Share of these pixels at which it disagrees with the scene around, and is not used."""
    added: int = 0
    """Number of added Gaussians that stand where it says; their colours are generated."""


@dataclass(frozen=True)
class TargetRow(ScoreRow):
    """Result at a target. Its `frame` is None for a camera without a photograph."""

    anchor: int | None
    """Frame of the anchor."""
    anchor_fallback: bool
    """True if all views exceed the rotation limit, so that the least turned one is the anchor."""
    hole_fraction: float
    """Fraction of the target image in holes before its completion."""
    affine: AlignmentRow
    added: int
    """Number of added Gaussians."""
    recolored: int = 0
    """Number of Gaussians of the context that got new colours."""
    derived_from: int | None = None
    """Frame that a planned camera was derived from; None if the user gave the camera."""
    target_id: int | None = None
    """Value of `generated` of its Gaussians in completed.ply; None if nothing was changed."""
    unfilled: UnfilledRow = UnfilledRow()
    notes: tuple[str, ...] = ()
    """Sentences about how the target was completed."""
    warnings: tuple[str, ...] = ()
    """Those of the notes that ask for a look at the result."""
    refused: str | None = None
    """Sentence why the target cannot be completed, or None if it can."""
    derived_file: str | None = None
    """File of the photograph that a planned camera was derived from."""
    offset: str | None = None
    """Move and turn from that photograph, in words."""
    reason: str | None = None
    """Sentence why a planned camera was chosen."""
    anchor_file: str | None = None
    """File of the anchor's photograph."""
    thin_gaps: float = 0.0
    """Share of the image of the completed scene that is cracks thinner than 5 pixels, or
    than 3 along its border."""
    flight_thin_gaps: float = 0.0
    """The same at four cameras between the nearest photograph and the target, on average."""
    painter: str | None = None
    """Who painted the image from which Gaussians were added; None if a generator made it."""
    geometry: GeometryRow | None = None
    """Use of geometry from elsewhere; None without it."""
    fitted: FittedRow | None = None
    """Scores without the errors of the target's own camera; None without a photograph, or if too
    little of it lies outside of holes."""

    @property
    def name(self) -> str:
        """Name of the target beside its number."""
        file = self.file if self.derived_from is None else self.derived_file
        return name_target(self.frame, file, self.derived_from, self.offset)

    @property
    def anchor_name(self) -> str:
        """Number and file of the anchor's photograph."""
        return name_photograph(self.anchor, self.anchor_file)


@dataclass(frozen=True)
class RemovalRow:
    """Signs that a removal left parts of an object, in the context photograph it is largest in."""

    frame: int | None
    file: str | None
    shown: float
    """Share of the image that showed the object."""
    continued: float
    """Share of the object's outline beyond which its surface goes on in the same colour."""

    @property
    def photograph(self) -> str:
        """Number and file of the photograph."""
        return name_photograph(self.frame, self.file)


@dataclass(frozen=True)
class ResultFrame:
    """Frame of the written Gaussians."""

    method: str
    """How it was found; `given` for the frame of the photographs, perhaps shifted."""
    transform: tuple[MatrixRow, MatrixRow, MatrixRow, MatrixRow]
    """Similarity from the frame of the photographs to that of the .ply."""
    origin: Vector
    """Local origin of the photographs in their own coordinates; zero unless those are large. Files
    are relative to it, except those of a splat with positions of double."""


@dataclass(frozen=True)
class PosesRow:
    """A refinement of poses, as in `PoseRefinement`.

    Errors are median distances of matches that were kept back from their epipolar lines, in pixels
    of an image whose shorter side is 256, and not of the working size as `pose_error`.
    """

    photographs: int
    """Number of photographs that were refined together."""
    given_error: float
    refined_error: float
    moved: float
    """Median move of a camera centre, in steps between neighbouring cameras."""
    splat_given: float | None = None
    """Mean PSNR of an input splat at the given poses; None without one."""
    splat_refined: float | None = None
    """The same at the refined poses."""


@dataclass(frozen=True)
class OpenedSceneRow:
    """The opened scene."""

    format: str
    """Name of the format in `data.formats`."""
    photographs: int
    """Number of photographs in the scene."""
    used: int
    """Number of photographs of the context."""
    fitted: int = 0
    """Number of further photographs to which a reconstructed scene was fitted."""
    splat: str | None = None
    """Path of the input splat; None if the scene was reconstructed."""
    context: str | None = None
    """Path of the input splat that `context.ply` would repeat; None if that file is there."""
    renders_from: str | None = None
    """Source of the cameras of renders that took the place of photographs: `cameras` of a
    file, around the `targets` or the `place` of a removal, the `pixels` of the splat, or
    `standpoints`; None if there are photographs."""
    refined_poses: PosesRow | None = None
    """What a refinement of the given poses did; None without one."""
    notes: tuple[str, ...] = ()
    """Sentences about the opening: photographs and cameras that are left out, for example."""

    @property
    def images(self) -> str:
        """What the scene is compared with, in the plural."""
        return "photographs" if self.renders_from is None else "renders"


@dataclass(frozen=True)
class CompletionSummary:
    """The entries of `summary.json` that pages show."""

    version: str
    settings: Mapping[str, Any]
    """Options of the command by name, and below `config` all of `CompleterConfig`; shown as they
    are."""
    seed: int
    device: str
    scene: OpenedSceneRow
    outcome: OutcomeRow
    frame: ResultFrame
    depth_range: Mapping[str, Any]
    """Planes `near` and `far` in scene units, and `from`: what told each of them."""
    coverage: Coverage
    context: tuple[ContextRow, ...]
    targets: tuple[TargetRow, ...]
    gaussians: Mapping[str, int]
    """Numbers of Gaussians: `context` and `added` always, others where they apply
    (`count_changes`)."""
    seconds: Mapping[str, float]
    """Time by stage, and `total`."""
    held_out: tuple[HeldOutRow, ...] = ()
    checks: tuple[ContextRow, ...] = ()
    """Further photographs that guarded an input splat, in low resolution; empty with targets."""
    removal: RemovalRow | None = None
    """None if nothing was removed that a photograph shows."""
    kept: KeptRow | None = None
    """Scores of a splat without photographs at cameras that decided nothing; None for any other
    scene, or if these see nothing opaque."""
    new_photographs: int | None = None
    """Number of photographs that an input splat does not reproduce, as it was not trained on them;
    None under full trust, as of a reconstructed scene."""
    placed_geometry: GeometryPlacement | None = None
    """How geometry from elsewhere was moved to the scene; None if it stood there, or without it."""
    context_notes: tuple[str, ...] = ()
    """Sentences of the reconstructor about the context."""
    reopened: int = 0
    """Number of targets of earlier commands at which an update opened holes, and left them."""


@dataclass(frozen=True)
class PairsRow:
    """Depth pairs of the alignment at a target."""

    seen_from: Literal["anchor", "target"]
    points: tuple[tuple[float, float, bool], ...]
    """Lifted depth and scene depth, in scene units, and True for an inlier."""


@dataclass(frozen=True)
class CompletionRecord:
    """All of `report.json`: a drawing of the cameras, and depth pairs by target.

    Each text is a line that draws one camera, as x y z of its corners in the frame of the drawing
    (`DrawingFrame`): right, up and back from its centre, in units of its radius.
    """

    photographs: tuple[str, ...]
    """All photographs, thinned evenly if they are many."""
    context: tuple[str, ...]
    targets: tuple[str, ...]
    pairs: tuple[PairsRow, ...]


def find_completed(folder: Path) -> Path:
    """Find the file of the completed scene in an output folder; its usual path if there is none."""
    paths = [folder / name for name in COMPLETED_FILES]
    return next((path for path in paths if os.path.lexists(path)), paths[0])


def holds_completion(folder: Path) -> bool:
    """Return True for an output folder with a completed scene, but not for one of `clean`."""
    if not ((folder / SUMMARY_FILE).is_file() and find_completed(folder).is_file()):
        return False
    return read_command(folder) in COMPLETION_COMMANDS


def refuse_completed(out: Path) -> None:
    """Refuse the output folder of a dry run if it holds a completed scene."""
    if os.path.lexists(find_completed(out)):
        raise InputError(f"{quote_value(out)} holds a result; name another folder.", "out")


def read_summary(folder: Path) -> CompletionSummary:
    """Read `summary.json`, also of an early version.

    Raises:
        InputError: It is missing, damaged, of a later version, or not of a completion.
    """
    refuse_later_results(folder)
    command = read_command(folder)
    if command not in COMPLETION_COMMANDS:
        raise InputError(
            f"{quote_value(folder)} holds a result of `{quote_value(command)}`, which is no "
            "completion; name the output folder of a completion."
        )
    if command and not os.path.lexists(find_completed(folder)):
        raise InputError(
            f"{quote_value(folder)} holds no completed scene, but perhaps the plan of a dry run; "
            "complete the scene first."
        )
    path = folder / SUMMARY_FILE
    summary = read_result(CompletionSummary, path, EARLY_ENTRIES)

    transform = np.array(summary.frame.transform)
    numbers = np.concatenate([transform.ravel(), np.array(summary.frame.origin)])
    is_bounded = bool((np.abs(numbers) <= MAX_FRAME_NUMBER).all())  # False for NaN
    # A determinant of 0 has no inverse, and a negative one is a mirror.
    if not is_bounded or not np.linalg.det(transform[:3, :3]) > 0:
        raise InputError(
            f"{quote_value(path)} is damaged (frame: no similarity of photographs); "
            f"{SUMMARY_ADVICE}."
        )
    return summary


def read_record(folder: Path, summary: CompletionSummary) -> CompletionRecord:
    """Read `report.json`; raise an InputError if it does not fit the summary."""
    path = folder / RECORD_FILE
    record = read_result(CompletionRecord, path)
    # Each part of the page belongs to a row of the summary.
    sizes = len(record.pairs), len(record.targets), len(record.context)
    if sizes != (len(summary.targets), len(summary.targets), len(summary.context)):
        raise InputError(
            f"{quote_value(path)} does not fit {SUMMARY_FILE} beside it; {SUMMARY_ADVICE}."
        )
    return record


def read_result(kind: type[T], path: Path, early: Mapping[str, Any] = MappingProxyType({})) -> T:
    """Read and validate a JSON file of a completion.

    `early` are entries that a version before formats had numbers may not have written.
    """
    if not os.path.isfile(path):
        raise InputError(
            f"{quote_value(path.parent)} has no {path.name}; name the output folder of a "
            "completion."
        )
    return read_typed_json(kind, path, SUMMARY_ADVICE, early)

"""Rows of `summary.json` and `report.json`, which a completion writes and pages read."""

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
from gscompleter.system.files.typed_json import read_typed_json
from gscompleter.system.files.writing import COMPLETED_FILES, SUMMARY_FILE

RECORD_FILE = "report.json"
SUMMARY_ADVICE = "complete the scene again"
MAX_FRAME_NUMBER = 1e12
"""Largest number of the transform and the origin, in scene units: its square is finite."""

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

T = TypeVar("T")
Vector = tuple[float, float, float]
MatrixRow = tuple[float, float, float, float]


@dataclass(frozen=True)
class AlignmentRow:
    """Depth alignment of a target."""

    scale: float
    shift: float
    inliers: float
    method: str
    agreement: float | None = None


@dataclass(frozen=True)
class ContextRow(ScoreRow):
    """A photograph of the context."""

    exposure_gain: Vector | None = None
    dynamic_fraction: float = 0.0
    given_depth: float = 0.0
    """Share of the pixels whose depth was given."""
    ignored: float = 0.0
    pose_error: float | None = None
    """Median distance, in pixels, of features that it shares with other photographs from where the
    poses put them; None for fewer than three photographs, or few features."""


@dataclass(frozen=True)
class UnfilledRow:
    """The part of the dilated hole mask, at the padded target, that stays empty."""

    share: float = 0.0
    lost_by: Mapping[str, float] = field(default_factory=dict)
    """Share by the step or guard that lost it; empty if there is little."""
    regions: tuple[tuple[int, int, int, int], ...] = ()
    """Boxes (left, top, right, bottom) of the largest regions, in pixels of the target image."""


@dataclass(frozen=True)
class FittedRow:
    """Scores in dB after one pose and one gain of the target camera were fitted to its photograph.

    The formula is that of `evaluation.metrics.fitted_camera`.
    """

    psnr: float
    observed_psnr: float
    """Outside of holes."""
    moved: float
    """Length of the rotation and shift, in pixels of an image of at most 320."""
    gain: float
    """Mean over the channels."""


@dataclass(frozen=True)
class GeometryRow:
    """What geometry from elsewhere (`settings.geometry`) gives at a target."""

    share: float = 0.0
    """Share of the pixels of the hole, at the padded target, whose depth it gives."""
    contradicted: float = 0.0
    """Share of them at which it disagrees with the scene around, and is not used."""
    added: int = 0
    """Number of added Gaussians that stand where it says; their colours are generated."""


@dataclass(frozen=True)
class TargetRow(ScoreRow):
    """Result at a target."""

    anchor: int | None
    anchor_fallback: bool
    hole_fraction: float
    affine: AlignmentRow
    added: int
    recolored: int = 0
    derived_from: int | None = None
    target_id: int | None = None
    """Value of `generated` of its Gaussians in completed.ply; None if nothing was changed."""
    unfilled: UnfilledRow = UnfilledRow()
    notes: tuple[str, ...] = ()
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
    """Share of the image that is cracks thinner than 5 pixels, afterwards."""
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
    """Possible remainder of a removed object, in the photograph that shows the object largest."""

    frame: int | None
    file: str | None
    shown: float
    """Share of the image that showed it."""
    continued: float
    """Share of its outline beyond which the surface goes on in the same colour."""

    @property
    def photograph(self) -> str:
        """Number and file of the photograph."""
        return name_photograph(self.frame, self.file)


@dataclass(frozen=True)
class ResultFrame:
    """Transform from the photographs to the .ply."""

    method: str
    transform: tuple[MatrixRow, MatrixRow, MatrixRow, MatrixRow]
    origin: Vector


@dataclass(frozen=True)
class PosesRow:
    """A refinement of poses; errors are median distances of kept-back matches, in pixels of 256."""

    photographs: int
    given_error: float
    refined_error: float
    moved: float
    splat_given: float | None = None
    """Mean PSNR in dB of a given splat at the given poses; None without one."""
    splat_refined: float | None = None


@dataclass(frozen=True)
class OpenedSceneRow:
    """The opened scene."""

    format: str
    photographs: int
    used: int
    splat: str | None = None
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
    """The parts of `summary.json` that pages show."""

    version: str
    settings: Mapping[str, Any]
    seed: int
    device: str
    scene: OpenedSceneRow
    outcome: OutcomeRow
    frame: ResultFrame
    depth_range: Mapping[str, Any]
    coverage: Coverage
    context: tuple[ContextRow, ...]
    targets: tuple[TargetRow, ...]
    gaussians: Mapping[str, int]
    seconds: Mapping[str, float]
    held_out: tuple[HeldOutRow, ...] = ()
    checks: tuple[ContextRow, ...] = ()
    """Small copies of further photographs that guarded a given scene; empty with targets."""
    removal: RemovalRow | None = None
    """None if nothing was removed that a photograph shows."""
    kept: KeptRow | None = None
    """What cameras that decided nothing still see of a splat without photographs."""
    new_photographs: int | None = None
    """Photographs that a splat was not trained on; None if the scene was reconstructed."""
    placed_geometry: GeometryPlacement | None = None
    """How geometry from elsewhere was moved to the scene; None if it stood there, or without it."""
    context_notes: tuple[str, ...] = ()
    """Sentences of the reconstructor about the context."""


@dataclass(frozen=True)
class PairsRow:
    """Depth pairs of the alignment at a target."""

    seen_from: Literal["anchor", "target"]
    points: tuple[tuple[float, float, bool], ...]
    """Lifted depth and scene depth, in scene units, and True for an inlier."""


@dataclass(frozen=True)
class CompletionRecord:
    """All of `report.json`: cameras as lines, and depth pairs by target.

    Each text has the coordinates x y z of its points: right, up and back from the middle, in units
    of the radius.
    """

    photographs: tuple[str, ...]
    context: tuple[str, ...]
    targets: tuple[str, ...]
    pairs: tuple[PairsRow, ...]


def find_completed(folder: Path) -> Path:
    """Find the completed scene of a completion; the usual path if there is none."""
    paths = [folder / name for name in COMPLETED_FILES]
    return next((path for path in paths if os.path.lexists(path)), paths[0])


def read_summary(folder: Path) -> CompletionSummary:
    """Read `summary.json`, also of an early version; raise an InputError if it is of a later one.

    Likewise if it is missing, damaged or not of a completion.
    """
    refuse_later_results(folder)
    command = read_command(folder)
    if command not in (None, "complete"):
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

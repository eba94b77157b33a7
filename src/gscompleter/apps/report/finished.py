"""The output folder of a finished completion, validated as it is read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from gscompleter import __version__
from gscompleter.apps.report.record import RECORD_FILE, ReportRecord
from gscompleter.errors import InputError, quote_value
from gscompleter.io.files import SUMMARY_FILE
from gscompleter.io.json_file import read_json

COMPLETION_ADVICE = "complete the scene again"

RENAMED = {
    "context": {"gain": "exposure_gain", "contradicted": "dynamic_fraction"},
    "targets": {"near": "derived_from", "generated": "target_id"},
}
"""Keys of the last release in lists of `summary.json`, with the new ones; read for one release."""

T = TypeVar("T")


@dataclass(frozen=True)
class AlignmentRow:
    """Depth alignment of a target."""

    scale: float
    shift: float
    inliers: float
    method: str
    agreement: float | None = None


@dataclass(frozen=True)
class ScoreRow:
    """Scores of a camera against its photograph; None without one."""

    frame: int | None
    psnr_before: float | None
    psnr_after: float | None
    ssim_before: float | None
    ssim_after: float | None


@dataclass(frozen=True)
class ContextRow(ScoreRow):
    """A photograph of the context."""

    exposure_gain: tuple[float, ...] | None = None
    """Exposure gain per channel; None if exposures were not normalized."""
    dynamic_fraction: float = 0.0
    """Fraction of the image in the dynamic mask."""
    ignored: float = 0.0
    """Fraction of ignored pixels, which stay the same while the camera moves."""


@dataclass(frozen=True)
class HeldOutRow(ScoreRow):
    """A photograph that only scores the result."""

    is_check: bool = False


@dataclass(frozen=True)
class TargetRow(ScoreRow):
    """Result at a target."""

    anchor: int | None
    anchor_fallback: bool
    hole_fraction: float
    affine: AlignmentRow
    added: int
    derived_from: int | None = None
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the target beside its number."""
        if self.derived_from is not None:
            return f"near photograph {self.derived_from}"
        return "a given camera" if self.frame is None else f"photograph {self.frame}"


@dataclass(frozen=True)
class CoverageRow:
    """Covered fractions of the surrounding views."""

    before: float
    after: float
    cameras: int


@dataclass(frozen=True)
class ResultFrame:
    """Transform from the photographs to the .ply."""

    method: str
    transform: tuple[tuple[float, ...], ...]
    origin: tuple[float, ...]


@dataclass(frozen=True)
class SceneRow:
    """The opened scene."""

    format: str
    photographs: int
    used: int
    splat: str | None = None


@dataclass(frozen=True)
class DepthRangeRow:
    """Near and far plane in scene units."""

    near: float | None = None
    far: float | None = None


@dataclass(frozen=True)
class CompletionSummary:
    """The parts of `summary.json` that a report shows."""

    version: str
    settings: Mapping[str, Any]
    seed: int
    device: str
    scene: SceneRow
    frame: ResultFrame
    depth_range: DepthRangeRow
    coverage: CoverageRow
    context: tuple[ContextRow, ...]
    targets: tuple[TargetRow, ...]
    gaussians: Mapping[str, int]
    seconds: Mapping[str, float] = field(default_factory=dict)
    held_out: tuple[HeldOutRow, ...] = ()


@dataclass(frozen=True)
class FinishedCompletion:
    """All data of a completion report."""

    folder: Path
    summary: CompletionSummary
    record: ReportRecord


def read_completion_folder(folder: Path) -> FinishedCompletion:
    """Read an output folder.

    Raises:
        InputError: if it has no completion, a damaged one, or one of another version.
    """
    check_results(folder, SUMMARY_FILE)
    content = read_json(folder / SUMMARY_FILE, COMPLETION_ADVICE)
    check_version(folder, content)
    summary = parse_content(CompletionSummary, with_new_keys(content), folder / SUMMARY_FILE)
    if not os.path.isfile(folder / RECORD_FILE):
        raise InputError(
            f"{quote_value(folder)} has no {RECORD_FILE}, which the report needs; "
            f"{COMPLETION_ADVICE}."
        )
    record = parse_content(
        ReportRecord, read_json(folder / RECORD_FILE, COMPLETION_ADVICE), folder / RECORD_FILE
    )
    sizes = (len(summary.targets), len(summary.context))
    if sizes != (len(record.targets), len(record.context)):
        raise InputError(
            f"{SUMMARY_FILE} and {RECORD_FILE} in {quote_value(folder)} list different numbers of "
            f"cameras; {COMPLETION_ADVICE}."
        )
    return FinishedCompletion(folder, summary, record)


def with_new_keys(content: Any) -> Any:
    """Return the content of a summary with today's keys for those of the last release."""
    if not isinstance(content, Mapping):
        return content
    changed = dict(content)
    for group, names in RENAMED.items():
        if isinstance(rows := content.get(group), list):
            changed[group] = [
                {names.get(k, k): v for k, v in row.items()} if isinstance(row, Mapping) else row
                for row in rows
            ]
    return changed


def check_results(folder: Path, name: str) -> None:
    """Raise an InputError unless `folder` holds the file `name`."""
    if not os.path.isdir(folder):
        raise InputError(f"There is no folder {quote_value(folder)}; name one with results.")
    if not os.path.isfile(folder / name):
        raise InputError(
            f"{quote_value(folder)} has no {name}; name the output folder of a completion or an "
            "evaluation."
        )


def check_version(folder: Path, content: Any) -> None:
    """Raise an InputError unless this version wrote the summary."""
    version = content.get("version") if isinstance(content, Mapping) else None
    if isinstance(version, str) and version != __version__:
        raise InputError(
            f"{quote_value(folder / SUMMARY_FILE)} was written by version {quote_value(version)}, "
            "and this is "
            f"{__version__}; use that version, or {COMPLETION_ADVICE}."
        )


def parse_content(kind: type[T], content: Any, path: Path, advice: str = COMPLETION_ADVICE) -> T:
    """Validate the content of a JSON file; raise an InputError with `advice` if it does not fit."""
    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(kind).validate_python(content)
    except ValidationError as error:
        wrong = error.errors(include_url=False)[0]
        place = ".".join(map(str, wrong["loc"])) or "its content"
        raise InputError(
            f"{quote_value(path)} is damaged ({quote_value(place)}: {quote_value(wrong['msg'])}); "
            f"{advice}."
        ) from None

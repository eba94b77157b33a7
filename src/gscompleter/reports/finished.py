"""A finished completion as its folder has it: checked on the way in, like any other file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from gscompleter import __version__
from gscompleter.errors import InputError, quoted
from gscompleter.io.files import SUMMARY
from gscompleter.io.json_file import read_json
from gscompleter.reports.record import NAME, Record

ADVICE = "complete the scene again"
"""What to do about a damaged file."""

RENAMED = {
    "context": {"gain": "exposure_gain", "contradicted": "dynamic_fraction"},
    "targets": {"near": "derived_from", "generated": "target_id"},
}
"""Keys of the last release in lists of `summary.json`, with the new ones; read for one release."""

T = TypeVar("T")


@dataclass(frozen=True)
class Affine:
    """How the depths of a target were brought to the scene's."""

    scale: float
    shift: float
    """In scene units."""
    inliers: float
    method: str
    agreement: float | None = None


@dataclass(frozen=True)
class Scores:
    """A camera against its photograph; None where there is none."""

    frame: int | None
    psnr_before: float | None
    psnr_after: float | None
    ssim_before: float | None
    ssim_after: float | None


@dataclass(frozen=True)
class ContextRow(Scores):
    """A photograph of the context."""

    exposure_gain: tuple[float, ...] | None = None
    """By how much it is brighter than it is compared, by channel; None where it is not."""
    dynamic_fraction: float = 0.0
    """Share of it that the others contradict, because something moved."""
    ignored: float = 0.0
    """Share of it that is ignored, because it stays the same while the camera moves."""


@dataclass(frozen=True)
class HeldOutRow(Scores):
    """A photograph that was not used."""

    is_check: bool = False
    """True if a small copy of it checked the input splat."""


@dataclass(frozen=True)
class TargetRow(Scores):
    """What came of a target."""

    anchor: int | None
    anchor_fallback: bool
    hole_fraction: float
    affine: Affine
    added: int
    derived_from: int | None = None
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """What the report calls it besides its number."""
        if self.derived_from is not None:
            return f"near photograph {self.derived_from}"
        return "a given camera" if self.frame is None else f"photograph {self.frame}"


@dataclass(frozen=True)
class Covered:
    """Shares of what cameras around the photographs see."""

    before: float
    after: float
    cameras: int


@dataclass(frozen=True)
class Placing:
    """Where the .ply lies relative to the photographs."""

    method: str
    transform: tuple[tuple[float, ...], ...]
    origin: tuple[float, ...]


@dataclass(frozen=True)
class Scene:
    """What was opened."""

    format: str
    photographs: int
    used: int
    splat: str | None = None


@dataclass(frozen=True)
class DepthRange:
    """What was worked in, in scene units."""

    near: float | None = None
    far: float | None = None


@dataclass(frozen=True)
class Summary:
    """`summary.json`, as far as a report needs it."""

    version: str
    settings: Mapping[str, Any]
    seed: int
    device: str
    scene: Scene
    frame: Placing
    depth_range: DepthRange
    coverage: Covered
    context: tuple[ContextRow, ...]
    targets: tuple[TargetRow, ...]
    gaussians: Mapping[str, int]
    seconds: Mapping[str, float] = field(default_factory=dict)
    held_out: tuple[HeldOutRow, ...] = ()


@dataclass(frozen=True)
class Finished:
    """All that a report of a completion is made of."""

    folder: Path
    """Where `images/` lie."""
    summary: Summary
    record: Record


def read_finished(folder: Path) -> Finished:
    """What an output folder holds.

    Raises:
        InputError: where it is none, of another version, or damaged.
    """
    check_results(folder, SUMMARY)
    content = read_json(folder / SUMMARY, ADVICE)
    check_version(folder, content)
    summary = as_written(Summary, with_new_keys(content), folder / SUMMARY)
    if not os.path.isfile(folder / NAME):
        raise InputError(f"{quoted(folder)} has no {NAME}, of which a report is made; {ADVICE}.")
    record = as_written(Record, read_json(folder / NAME, ADVICE), folder / NAME)
    sizes = (len(summary.targets), len(summary.context))
    if sizes != (len(record.targets), len(record.context)):
        raise InputError(f"{SUMMARY} and {NAME} in {quoted(folder)} differ in cameras; {ADVICE}.")
    return Finished(folder, summary, record)


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
    """Make sure that `folder` is one, and holds a file called `name`.

    Raises:
        InputError: where it is or does not.
    """
    if not os.path.isdir(folder):
        raise InputError(f"There is no folder {quoted(folder)}; name one that has results.")
    if not os.path.isfile(folder / name):
        raise InputError(
            f"{quoted(folder)} has no {name}; name the folder that a completion or an evaluation "
            "wrote."
        )


def check_version(folder: Path, content: Any) -> None:
    """Make sure that a summary is of this version.

    Raises:
        InputError: where it is of another.
    """
    version = content.get("version") if isinstance(content, Mapping) else None
    if isinstance(version, str) and version != __version__:
        raise InputError(
            f"{quoted(folder / SUMMARY)} was written by version {quoted(version)}, and this is "
            f"{__version__}; use that version, or {ADVICE}."
        )


def as_written(kind: type[T], content: Any, path: Path, advice: str = ADVICE) -> T:
    """The content of the file at `path` as a value of `kind`; an error gives `advice`.

    Raises:
        InputError: where it is not one.
    """
    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(kind).validate_python(content)
    except ValidationError as error:
        wrong = error.errors(include_url=False)[0]
        place = ".".join(map(str, wrong["loc"])) or "its content"
        raise InputError(
            f"{quoted(path)} does not hold what a report needs ({quoted(place)}: "
            f"{quoted(wrong['msg'])}); {advice}."
        ) from None

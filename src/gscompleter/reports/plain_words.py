"""Notes on what differs from a usual completion, as sentences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence

from gscompleter.reports.finished import Summary, TargetRow

PLACED = {
    "given": None,
    "cameras": "The splat lies in the frame of its cameras.json, not in that of the photographs.",
    "dataparser": "The splat lies in the frame that its trainer's dataparser made.",
    "normalised": "The splat lies in a frame that its trainer normalised.",
    "similarity": "The splat lay in a frame of its own; it was found by matching features.",
}
NO_TARGET = "No camera was found that has much to gain; nothing was completed."


def moved(shares: Mapping[int | None, float]) -> str | None:
    """Describe the dynamic fractions of photographs by frame, or return None if all are 0."""
    told = [f"{percent(share)} of frame {frame}" for frame, share in shares.items() if share > 0]
    if not told:
        return None
    return (
        f"Photographs contradict each other in {', '.join(told)}, as where something moves: what "
        "is completed takes nothing from there."
    )


def left_out(shares: Iterable[float]) -> str | None:
    """Describe the ignored fractions of photographs, or return None if all are 0."""
    most = max(shares, default=0.0)
    if most == 0:
        return None
    return (
        f"Up to {percent(most)} of a photograph stays the same while the camera moves, as the "
        "bonnet of a vehicle does: it is ignored, in scores too (images/context*_ignored.png)."
    )


def exposures(gains: Iterable[Sequence[float] | None]) -> str | None:
    """Describe the exposure gains of photographs, or return None without any."""
    factors = [factor for gain in gains for factor in gain or ()]
    if not factors or min(factors) <= 0:
        return None
    return (
        "The photographs of the context differ in exposure, by a factor of up to "
        f"{max(factors) / min(factors):.2f}; the scene has their mean, in which they are compared. "
        "Those of targets are compared as they were taken."
    )


def about_target(row: TargetRow) -> list[str]:
    """List the notes of a target, with fallbacks that no note mentions."""
    said = " ".join(row.notes)
    found = list(row.notes)
    if row.anchor_fallback and "least-turned" not in said:
        found.append("Every photograph is turned too far; the least-turned one is the anchor.")
    if row.affine.method == "median" and "median" not in said:
        found.append("RANSAC found no trustworthy fit; the median depth ratio took its place.")
    if row.added == 0 and "nothing" not in said.lower():
        found.append("Nothing was added here.")
    return found


def about_scene(summary: Summary) -> list[str]:
    """List the notes on the whole completion."""
    return [*opened(summary), *compared(summary), *came_of_it(summary)]


def opened(summary: Summary) -> Iterator[str]:
    """Describe the photographs and the frame of the result."""
    placed = PLACED.get(summary.frame.method, "The splat lies in a frame of its own.")
    if placed is not None:
        yield f"{placed} summary.json has the transform from the photographs to the result."
    if any(summary.frame.origin):
        yield (
            "The coordinates are large against the distances between the cameras, so the result is "
            "relative to a local origin; summary.json has it."
        )
    seen_to_move = moved({row.frame: row.contradicted for row in summary.context})
    if seen_to_move is not None:
        yield seen_to_move
    carried = left_out(row.ignored for row in summary.context)
    if carried is not None:
        yield carried
    if summary.settings.get("context") is None:
        yield (
            f"Nobody named the photographs to work with: {summary.scene.used} of "
            f"{summary.scene.photographs} were chosen."
        )


def compared(summary: Summary) -> Iterator[str]:
    """Describe how the images are scored."""
    evened = exposures([row.gain for row in summary.context])
    if evened is not None:
        yield evened
    if summary.settings.get("uses_target_photographs"):
        yield (
            "The generator was shown the photographs of the targets, so the scores measure where "
            "things were put and not what was synthesized."
        )
    if summary.targets and all(row.psnr_after is None for row in summary.targets):
        yield "No photograph of a target exists, so nothing is scored there."


def came_of_it(summary: Summary) -> Iterator[str]:
    """Describe the completed scene."""
    removed = summary.gaussians.get("removed")
    if removed is not None:
        yield (
            "The scene was brought, and counts as a hole where no photograph supports it. "
            f"{removed:,} of its Gaussians stood in the way and were set aside."
        )
    if not summary.targets:
        yield NO_TARGET


def shown(value: float | None, digits: int = 2) -> str:
    """Format a number, with a dash for None or an infinite one."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def percent(share: float | None, digits: int = 1) -> str:
    """Format a fraction as a percentage."""
    return "–" if share is None or not math.isfinite(share) else f"{100 * share:.{digits}f} %"


def gain(before: float | None, after: float | None, digits: int = 2) -> str:
    """Format the change of a score with its sign."""
    if before is None or after is None or not math.isfinite(after - before):
        return "–"
    rise = round(after - before, digits)
    return f"{rise:+.{digits}f}".replace("-", "−") if rise else f"{0:.{digits}f}"

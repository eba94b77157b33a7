"""Notes on what differs from a usual completion, as sentences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from gscompleter.apps.report.schema import AlignmentRow, CompletionSummary

FRAME_NOTES = {
    "given": None,
    "cameras": "The splat is in the frame of its cameras.json, not in that of the photographs.",
    "dataparser": "The splat is in the frame of its trainer's dataparser.",
    "normalised": "The splat is in a frame that its trainer normalised.",
    "similarity": "The splat is in a frame of its own, aligned by matching features.",
}
ALIGNMENTS = {
    "ransac": "RANSAC fits scene depth = {scale} × lifted depth {shift}; {inliers} of the pixels "
    "agree",
    "median": "The median depth ratio is used: scene depth = {scale} × lifted depth; "
    "{inliers} of the pixels agree",
    "identity": "The lifted depths are used unchanged",
}
ORIGIN_NOTE = (
    "The coordinates are much larger than the distances between the cameras, so the result is "
    "relative to a local origin, which summary.json lists."
)
ORACLE_NOTE = (
    "The generator uses the photographs of the targets, so the scores measure the geometry and not "
    "the synthesized images."
)
RECOLORED_NOTE = (
    "Gaussians of the input splat got new colours, because no photograph confirms theirs; "
    "removed.ply has them as they were."
)
NO_SCORES_NOTE = "No target has a photograph, so there are no scores at targets."
NO_TARGET_NOTE = "No large hole was found around the photographs; nothing was completed."


def describe_motion(shares: Mapping[int | None, float]) -> str | None:
    """Describe the dynamic fractions of photographs by frame, or return None if all are 0."""
    parts = [
        f"{format_percent(share)} of frame {frame}" for frame, share in shares.items() if share > 0
    ]
    if not parts:
        return None
    return (
        f"{', '.join(parts)} show something that moves; the completion does not use these regions."
    )


def describe_ignored(shares: Iterable[float]) -> str | None:
    """Describe the ignored fractions of photographs, or return None if all are 0."""
    most = max(shares, default=0.0)
    if most == 0:
        return None
    return (
        f"Up to {format_percent(most)} of a photograph stays the same while the camera moves, "
        "like the bonnet of a vehicle; it is ignored, also in scores "
        "(images/context*_ignored.png)."
    )


def describe_exposures(gains: Iterable[Sequence[float] | None]) -> str | None:
    """Describe the exposure gains of photographs, or return None without any."""
    factors = [factor for gain in gains for factor in gain or ()]
    if not factors or min(factors) <= 0:
        return None
    return (
        "The exposures of the context photographs differ by a factor of up to "
        f"{max(factors) / min(factors):.2f}; the scene has the mean exposure, at which these "
        "photographs are scored. Target photographs are scored as they are."
    )


def describe_new_photographs(count: int | None) -> str | None:
    """Describe what photographs beyond those of the training bring to a splat."""
    if count is None:
        return None
    if count == 0:
        return (
            "The splat reproduces all photographs. Where it is wrong from elsewhere, only smooth "
            "colours are known: little is to be gained without new photographs of the place or a "
            "learned generator."
        )
    return (
        f"The splat was not trained on {count} of the photographs; it is recoloured to them, which "
        "helps most."
    )


def describe_alignment(affine: AlignmentRow, unit: str) -> str:
    """Describe the depth alignment of a target."""
    sign = "−" if affine.shift < 0 else "+"
    text = ALIGNMENTS.get(affine.method, "The depths are aligned by an unknown method").format(
        scale=format_number(affine.scale, 3),
        shift=f"{sign} {format_number(abs(affine.shift), 3)} {unit}",
        inliers=format_percent(affine.inliers, 0),
    )
    if affine.agreement is None:
        return f"{text}."
    share = format_percent(affine.agreement, 0)
    return f"{text}. At the target, {share} of the visible scene agree."


def list_scene_notes(summary: CompletionSummary) -> list[str]:
    """List the notes on the whole completion."""
    context, targets, scene = summary.context, summary.targets, summary.scene
    placed = FRAME_NOTES.get(summary.frame.method, "The splat is in a frame of its own.")
    recolored = summary.gaussians.get("recolored")
    notes = [
        placed and f"{placed} summary.json lists the transform from the photographs to the result.",
        ORIGIN_NOTE if any(summary.frame.origin) else None,
        describe_motion({row.frame: row.dynamic_fraction for row in context}),
        describe_ignored(row.ignored for row in context),
        f"{scene.used} of {scene.photographs} photographs were chosen as the context; --context "
        "chooses others."
        if summary.settings.get("context") is None
        else None,
        describe_exposures(row.exposure_gain for row in context),
        ORACLE_NOTE if summary.settings.get("uses_target_photographs") else None,
        NO_SCORES_NOTE if targets and all(row.psnr_after is None for row in targets) else None,
        describe_new_photographs(summary.new_photographs),
        f"{recolored:,} {RECOLORED_NOTE}" if recolored else None,
        None if targets else NO_TARGET_NOTE,
    ]
    return [note for note in notes if note is not None]


def format_number(value: float | None, digits: int = 2) -> str:
    """Format a number, with a dash for None or an infinite one."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def format_percent(share: float | None, digits: int = 1) -> str:
    """Format a fraction as a percentage."""
    return "–" if share is None or not math.isfinite(share) else f"{100 * share:.{digits}f} %"


def format_change(before: float | None, after: float | None, digits: int = 2) -> str:
    """Format the change of a score with its sign."""
    if before is None or after is None or not math.isfinite(after - before):
        return "–"
    rise = round(after - before, digits)
    return f"{rise:+.{digits}f}".replace("-", "−") if rise else f"{0:.{digits}f}"

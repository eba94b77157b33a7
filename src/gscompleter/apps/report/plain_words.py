"""Notes on a completion, as sentences: what a person has to act on, and facts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gscompleter.apps.report.schema import (
    AlignmentRow,
    CompletionSummary,
    ContextRow,
    RemovalRow,
    TargetRow,
    UnfilledRow,
)
from gscompleter.data.depth_beside_colmap import DEPTH_KINDS
from gscompleter.evaluation.verdict.kept import INVISIBLE_PSNR, KeptRow
from gscompleter.evaluation.verdict.numbers import format_number, format_percent
from gscompleter.system.errors import quote_value

FRAME_NOTES = {
    "cameras": "in the frame of its cameras.json, not in that of the photographs",
    "dataparser": "in the frame of its trainer's dataparser",
    "normalised": "in a frame that its trainer normalised",
    "similarity": "in a frame of its own, aligned by matching features",
}
"""Words about the frame of a splat, by the method that found it (`ResultFrame`)."""
ALIGNMENTS = {
    "ransac": "RANSAC fits scene depth = {scale:.3f} × lifted depth {shift:+.3f} {unit}; "
    "{inliers} of the pixels agree.",
    "median": "The median depth ratio is used: scene depth = {scale:.3f} × lifted depth; "
    "{inliers} of the pixels agree.",
    "identity": "The lifted depths are used unchanged.",
}
"""Sentences about the depth alignment of a target, by its method (`AlignmentRow`)."""
ORIGIN_NOTE = (
    "The coordinates are much larger than the distances between the cameras, so the result is "
    "relative to a local origin, which summary.json lists."
)
MIN_POSE_ERROR = 1.0
"""Error of a pose in pixels from which it is said; that of features alone is 0.1 to 0.3."""
MIN_CONTINUED = 0.005
"""Share of the outline of what was removed from which it is said that a surface goes on."""
POINT_FORMATS = ("colmap", "photographs")
"""Formats whose only depth is that of points which COLMAP triangulated."""
ORACLE_NOTE = (
    "The generator uses the photographs of the targets, so the scores measure the geometry and not "
    "the synthesized images."
)
RECOLORED_NOTE = (
    "Gaussians of the input splat got new colours, because no photograph confirms theirs; "
    "removed.ply has them as they were."
)
REMOVED_NOTE = (
    "Gaussians were removed: those selected, and those behind them that no photograph shows; "
    "removed.ply has them, and strip puts them back."
)
BARE_NOTE = (
    "No photograph checked this: renders of the splat took the place of photographs, and their "
    "scores only say how much the completion changed them. What was given stays bit for bit, and "
    "strip takes the rest away."
)
NOTHING_NEW_NOTE = (
    "The splat shows all photographs about equally well, so that none is new to it. Where it is "
    "wrong from elsewhere, only smooth colours are known: little is to be gained without new "
    "photographs of the place or a learned generator."
)


@dataclass(frozen=True)
class Note:
    """A sentence about a completion."""

    topic: str
    """What it is about, in a word or two."""
    text: str
    is_warning: bool = False
    """True if a person has to act on it, or has to look at the result; else it is a fact."""


def list_warnings(summary: CompletionSummary) -> Iterator[str]:
    """List the warnings: first those of several targets, then those of the whole completion."""
    yield from list_shared_warnings(summary)
    yield from (note.text for note in list_notes(summary) if note.is_warning)


def list_facts(summary: CompletionSummary) -> list[tuple[str, str]]:
    """List what else is known of a completion, as topics and sentences.

    What the headline says of all targets is left out.
    """
    notes = list_notes(summary)
    facts = [("opening", text) for text in summary.scene.notes]
    facts += [(note.topic, note.text) for note in notes if not note.is_warning]
    if summary.outcome.status != "nothing-gained":
        for number, row in enumerate(summary.targets, start=1):
            own = [text for text in row.notes if text not in row.warnings]
            own += describe_empty_part(row.unfilled)
            facts += [(f"target {number}", text) for text in own]
    return facts


def describe_empty_part(unfilled: UnfilledRow) -> list[str]:
    """Describe what stays empty of the hole of a target, and the steps that left it so."""
    if not unfilled.lost_by:
        return []
    steps = ", ".join(f"{step} {format_percent(part)}" for step, part in unfilled.lost_by.items())
    boxes = "; ".join(
        f"x {left} to {right}, y {top} to {bottom}" for left, top, right, bottom in unfilled.regions
    )
    return [
        f"Empty of the hole with its seam and padding: {format_percent(unfilled.share)}; by the "
        f"step after which it was open: {steps}; the largest parts: {boxes} (pixels)."
    ]


def list_notes(summary: CompletionSummary) -> Iterator[Note]:
    """List the notes on the whole completion."""
    frame = summary.frame
    scene = summary.scene
    targets = summary.targets
    if frame.method in FRAME_NOTES:
        text = f"The splat is {FRAME_NOTES[frame.method]}; summary.json lists the transform."
        yield Note("frame", text)
    # The local origin of the photographs in the coordinates of the written files: near zero if
    # these are relative to it. A splat with positions of double is written where it was.
    place = np.array(frame.transform) @ [*frame.origin, 1.0]
    if any(frame.origin) and np.abs(place[:3]).max() < 0.5 * np.abs(frame.origin).max():
        # Whoever joins the result with other data has to shift it.
        yield Note("coordinates", ORIGIN_NOTE, is_warning=True)
    if scene.renders_from is not None:
        yield Note("check", BARE_NOTE)
        is_seen = summary.kept is not None and not summary.kept.is_visibly_unchanged
        yield Note("other cameras", describe_kept(summary.kept), is_seen)
    else:
        yield from list_photograph_notes(summary)
    for text in summary.context_notes:
        yield Note("depth", text)
    if summary.placed_geometry is not None:
        yield Note("depth", summary.placed_geometry.describe())
    if scene.renders_from is None and summary.settings.get("context") is None:
        text = f"{scene.used} of {scene.photographs} photographs were chosen as the context"
        text += f", and the scene was fitted to {scene.fitted} more." if scene.fitted else "."
        yield Note("context", text)
    if summary.settings.get("uses_target_photographs"):
        yield Note("generator", ORACLE_NOTE, is_warning=True)
    if scene.renders_from is None and targets and all(row.psnr_after is None for row in targets):
        yield Note("scores", "No target has a photograph, so there are no scores at targets.")
    yield from list_splat_notes(summary)


def describe_kept(kept: KeptRow | None) -> str:
    """Describe what cameras that decided nothing still see of a splat without photographs."""
    if kept is None:
        return (
            "No further camera could tell what the additions hide: photographs of the scene that "
            "were not given may get worse."
        )
    seen = f"Seen from {kept.cameras} cameras that decided nothing"
    worst = f"{format_number(kept.worst_psnr, 1)} dB at worst"
    unseen = f"{INVISIBLE_PSNR:.0f} dB is not seen"
    if kept.is_visibly_unchanged:
        return f"{seen}, what the splat showed stays as it was: {worst}, and {unseen}."
    return (
        f"{seen}, additions hide a part of what the splat showed: {worst}, where {unseen}. Look at "
        "it from aside (`gscompleter view`); strip takes the additions away."
    )


def group_target_warnings(targets: Sequence[TargetRow]) -> dict[tuple[str, ...], list[int]]:
    """Group targets, numbered from 1, that have the same warnings; those without are left out.

    What holds for several targets is then said once.
    """
    groups: dict[tuple[str, ...], list[int]] = {}
    for number, row in enumerate(targets, start=1):
        if row.warnings:
            groups.setdefault(row.warnings, []).append(number)
    return groups


def list_shared_warnings(summary: CompletionSummary) -> Iterator[str]:
    """List the warnings of targets that several have, unless the headline says them."""
    if summary.outcome.status == "nothing-gained":
        return
    for warnings, numbers in group_target_warnings(summary.targets).items():
        if len(numbers) > 1:
            yield f"{name_targets(numbers, len(summary.targets))}: {' '.join(warnings)}"


def name_targets(numbers: Sequence[int], total: int) -> str:
    """Name two or more of `total` targets by their numbers, which begin with 1."""
    if len(numbers) == total:
        return f"All {total} targets"
    first = ", ".join(str(number) for number in numbers[:-1])
    return f"Targets {first} and {numbers[-1]}"


def list_photograph_notes(summary: CompletionSummary) -> Iterator[Note]:
    """List the notes on what moves, on what is ignored, on poses and on exposures."""
    context = summary.context
    moving = [row for row in context if row.dynamic_fraction > 0]
    if moving:
        shares = (
            f"{format_percent(row.dynamic_fraction)} of photograph {row.photograph}"
            for row in moving
        )
        text = f"{', '.join(shares)} show something that moves; these regions are not used."
        yield Note("moving things", text)

    given_share = max((row.given_depth for row in context), default=0.0)
    if given_share > 0:
        yield Note("given depth", describe_given_depth(given_share, summary))

    ignored_share = max((row.ignored for row in context), default=0.0)
    if ignored_share > 0:
        yield Note(
            "ignored",
            f"Up to {format_percent(ignored_share)} of a photograph {describe_ignored(summary)}; "
            "it is ignored, also in scores (images/context*_ignored.png).",
        )

    displaced = [row for row in context if (row.pose_error or 0) >= MIN_POSE_ERROR]
    if displaced:
        yield Note("poses", describe_displaced(displaced), is_warning=True)

    gains = [row.exposure_gain for row in context if row.exposure_gain is not None]
    if gains:
        yield Note("exposure", describe_exposures(gains))


def describe_exposures(gains: Sequence[tuple[float, float, float]]) -> str:
    """Describe the exposure gains (R, G, B) of photographs relative to the scene."""
    # By channel: a scene that was made anew in the exposure of what stays of an earlier one has
    # gains that all photographs share, and which differ between channels.
    factor = max(max(channel) / min(channel) for channel in zip(*gains, strict=True))
    scored = "these photographs are scored. Target photographs are scored as they are."
    if f"{factor:.2f}" == "1.00":
        return f"The scene has another exposure than the context photographs, at which {scored}"
    return (
        "The exposures of the context photographs differ by a factor of up to "
        f"{factor:.2f}; the scene has one exposure, at which {scored}"
    )


def describe_displaced(rows: Sequence[ContextRow]) -> str:
    """Describe photographs whose poses the others contradict, and what to do about them."""
    named = ", ".join(str(row.photograph) for row in rows)
    worst = max(row.pose_error or 0 for row in rows)
    if len(rows) == 1:
        subject = f"The pose of photograph {named} contradicts"
        whom = "it"
    else:
        subject = f"The poses of photographs {named} contradict"
        whom = "them"
    return (
        f"{subject} the other photographs by up to {format_number(worst, 1)} pixels, which blurs "
        f"what they show together; leave {whom} out (--context names the others), or find all "
        "cameras anew (gscompleter poses)."
    )


def describe_given_depth(share: float, summary: CompletionSummary) -> str:
    """Describe the largest share of a photograph whose depth is known without stereo."""
    if summary.settings.get("geometry"):
        name = quote_value(Path(str(summary.settings["geometry"])).name)
        return (
            f"Up to {format_percent(share)} of a photograph's pixels have the depth of {name}, or "
            "one that was measured or predicted, which decides their surfaces."
        )
    has_maps = any(kind in note for kind in DEPTH_KINDS for note in summary.scene.notes)
    has_only_points = summary.scene.format in POINT_FORMATS and not has_maps
    is_predicted = len(summary.context) == 1 and summary.settings.get("depth") != "none"
    if has_only_points and not is_predicted:
        return (
            f"Up to {format_percent(share)} of a photograph's pixels have the depth of COLMAP's "
            "points, which decides their surfaces (--no-given-depth leaves it out)."
        )
    return (
        f"Up to {format_percent(share)} of a photograph's pixels have a measured or predicted "
        "depth, which decides their surfaces (--no-given-depth ignores what SCENE holds)."
    )


def describe_ignored(summary: CompletionSummary) -> str:
    """Describe in a clause what may hide a part of a photograph."""
    if summary.gaussians.get("removed"):
        return "shows what was removed, or is hidden by a mask"
    return "is hidden by a mask, or stays the same while the camera moves, like a vehicle's bonnet"


def describe_replaced(count: int) -> str:
    """Describe Gaussians of earlier commands that an update or a further completion replaced."""
    gaussians = "1 Gaussian" if count == 1 else f"{count:,} Gaussians"
    return (
        f"{gaussians} of earlier commands gave way to what photographs show; removed.ply has them, "
        "and strip puts them back."
    )


def describe_reopened(count: int) -> str:
    """Write the sentence on targets of earlier commands at which an update opened holes."""
    cameras = "1 camera" if count == 1 else f"{count} cameras"
    return (
        f"Holes opened at {cameras} where an earlier command had filled them: photographs show "
        "that what was invented is wrong, and not what is there. Complete the result: that fills "
        "them again."
    )


def list_splat_notes(summary: CompletionSummary) -> Iterator[Note]:
    """List the notes on what photographs bring to a splat."""
    from_photographs = summary.gaussians.get("from_photographs")
    num_recolored = summary.gaussians.get("recolored")
    if from_photographs:
        pieces = summary.gaussians.get("pieces", 0)
        invented = summary.gaussians["added"] - from_photographs - pieces
        painters = {row.painter for row in summary.targets if row.painter}
        maker = " and ".join(sorted(painters)) or "the generator"
        yield Note(
            "sources",
            f"{from_photographs:,} of the added Gaussians come from photographs, which show what "
            f"the splat lacked; {maker} invented {invented:,}.",
        )
    if summary.new_photographs == 0 and not from_photographs:
        wanted = describe_wanted_photographs(summary.targets)
        yield Note("new photographs", f"{NOTHING_NEW_NOTE} {wanted}", is_warning=True)
    elif summary.new_photographs and num_recolored:
        yield Note(
            "new photographs",
            f"The splat does not reproduce {summary.new_photographs} of the photographs; it is "
            "recoloured to them, which helps most.",
        )
    num_replaced = summary.gaussians.get("replaced")
    if num_replaced:
        yield Note("replaced", describe_replaced(num_replaced))
    if summary.reopened:
        yield Note("earlier targets", describe_reopened(summary.reopened), is_warning=True)
    num_removed = summary.gaussians.get("removed")
    if num_removed:
        yield Note("removed", f"{num_removed:,} {REMOVED_NOTE}")
    if summary.removal is not None:
        is_left = summary.removal.continued >= MIN_CONTINUED
        text = describe_removal(summary.removal, summary.scene.renders_from is not None)
        yield Note("outline", text, is_left)
    margin = summary.settings.get("margin")
    if isinstance(margin, float) and margin > 0:
        yield Note(
            "region",
            f"The region of the removal reaches {margin:.3g} farther than given on every side, "
            "which is the size of one Gaussian, so that faces go as a whole.",
        )
    if num_recolored:
        yield Note("recoloured", f"{num_recolored:,} {RECOLORED_NOTE}")


def describe_removal(row: RemovalRow, is_render: bool) -> str:
    """Describe what may be left of what was removed."""
    image = f"{'render' if is_render else 'photograph'} {row.photograph}"
    if row.continued < MIN_CONTINUED:
        return (
            f"Nothing goes on beyond the outline of what was removed, in {image} "
            "(images/removal_outline.png)."
        )
    return (
        f"Along {format_percent(row.continued, 0)} of the outline of what was removed, in {image}, "
        "the surface goes on in the same colour: a part of the object is left, or what it touches "
        "looks the same (images/removal_outline.png, magenta)."
    )


def describe_wanted_photographs(targets: Sequence[TargetRow]) -> str:
    """Describe where new photographs would help most: at the planned targets."""
    planned = [row.name.removeprefix("near ") for row in targets if row.derived_from is not None]
    if not planned:
        return "Without --target, `complete` finds the cameras where they would help most."
    places = " and ".join(planned[:2])
    return f"They would help most at the first cameras of targets.json, beside {places}."


def describe_alignment(affine: AlignmentRow, unit: str) -> str:
    """Describe the depth alignment of a target; `unit` is the name of the unit of depths."""
    text = ALIGNMENTS.get(affine.method, "The depths are aligned by an unknown method.")
    inliers = format_percent(affine.inliers, 0)
    fit = text.format(scale=affine.scale, shift=affine.shift, unit=unit, inliers=inliers)
    if affine.agreement is None:
        return fit
    return f"{fit} At the target, {format_percent(affine.agreement, 0)} of the visible scene agree."

"""The result of one target, with the sentences about it; conventions are in `types`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.system.files.display import Displayed
from gscompleter.types import Camera, DepthAffine, Gaussians, Render, View

MANY_TIMES = 4
"""Gaussians outside of the image of a target, against those in it, beyond which they are many."""
AFFINE_NOTES = {
    "ransac": "",
    "median": "RANSAC finds no reliable depth correction; the median depth ratio replaces it.",
    "identity": "There is nothing to fit a depth correction to; the predicted depths are used.",
}
"""Sentence about each estimator of the depth correction; empty for the usual one."""
NOTHING_ADDED = "Nothing of it was added."


@dataclass(frozen=True)
class Rejection:
    """The guard that removed everything that was generated for a target, if one did."""

    guard: str = ""
    """Name of the guard; empty if none did."""
    reason: str = ""
    """Sentence for the report; empty if the notes of Φ say it."""


@dataclass(frozen=True)
class Unfilled:
    """The part of the dilated hole mask, at the padded target, that is still a hole afterwards."""

    MAX_SHARE: ClassVar[float] = 0.005
    """Largest share of the mask that is not worth a word."""
    LARGE_SHARE: ClassVar[float] = 0.1
    """Share of the mask from which on a person should look at what stays empty."""

    share: float = 0.0
    """Share of the pixels of the mask."""
    lost_by: Mapping[str, float] = field(default_factory=dict)
    """Share of the mask that each step emptied for the first time, by the name of the step; none
    if little stays empty."""
    regions: tuple[tuple[int, int, int, int], ...] = ()
    """Bounding boxes (left, top, right, bottom) of the largest regions, in pixels of the target
    image; its padding has coordinates below 0 and beyond its size."""
    reason: str = ""
    """Why the step that emptied most left it out, as a clause for people; empty if none did."""

    def describe(self) -> str:
        """Write the sentence for people; empty if the hole is filled.

        `lost_by` and `regions` have the details, for the report.
        """
        if self.share <= self.MAX_SHARE:
            return ""
        # One reason is enough: the others seldom leave as much.
        mostly = "mostly " if len(self.lost_by) > 1 else ""
        because = f", {mostly}because {self.reason}" if self.reason else ""
        return f"{max(1, round(100 * self.share))} % of the hole stays empty{because}."


@dataclass(frozen=True)
class GeometryUse:
    """What geometry from elsewhere gives at a target."""

    name: str = ""
    """Name of the geometry for sentences; empty if none is given."""
    share: float = 0.0
    """Share of the pixels of the hole, at the padded target, whose depth it gives."""
    contradicted: float = 0.0
    """Share of the pixels of the hole at which it has a depth that is not used, because it
    disagrees with what the scene shows around."""
    added: int = 0
    """Number of added Gaussians that stand where it says."""

    def describe(self) -> str:
        """Write the sentence for people; empty without geometry."""
        if not self.name:
            return ""
        share, contradicted = (f"{100 * part:.0f} %" for part in (self.share, self.contradicted))
        sentence = f"{self.name} gives the depth of {share} of the hole"
        if round(100 * self.contradicted) > 0:
            sentence += f"; at {contradicted} it disagrees with the scene around, and is not used"
        return f"{sentence}."


@dataclass(frozen=True, repr=False)
class TargetResult(Displayed):
    """Result of one target camera. No stage reads it."""

    target: Camera
    before: Render
    """The scene without what this target changed, rendered at the target."""
    after: Render
    """The scene with what this target changed, rendered at it."""
    hole_mask: Bool[Tensor, "h w"]
    """True where the scene had a hole or was not trusted, before dilation."""
    trusted_alpha: Float[Tensor, "h w"]
    """Accumulated opacity weighted by trust, from which `hole_mask` follows."""
    anchor: int
    """Index of the anchor among the context views."""
    anchor_fallback: bool
    """True if every view exceeded the rotation limit, so that the smallest rotation won."""
    added: Gaussians
    """All that this target added, also to close gaps beside its hole."""
    reference: View | None = None
    """The synthesized view, or None if there was nothing to complete."""
    affine: DepthAffine = DepthAffine()
    losses: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Loss per iteration of `register` (Eq. 11) and `refine` (Eq. 13)."""
    registered: Gaussians | None = None
    """All registered Gaussians, hole or not; None without `GSCompleter.keep_registered`."""
    target_id: int = 0
    """Value of `generated` for what this target added or recoloured."""
    num_outside: int = 0
    """Number of added Gaussians outside of the image of the target, if the scene was given."""
    num_recolored: int = 0
    """Number of rendered context Gaussians that got new colours."""
    synthesis_notes: tuple[str, ...] = ()
    """Sentences of the generator about its image."""
    lift_notes: tuple[str, ...] = ()
    """Sentences of Ψ about the depth of that image."""
    geometry: GeometryUse = GeometryUse()
    """Use of geometry from elsewhere; nothing if none is given."""
    painter: str = ""
    """Who painted the image elsewhere; empty if Φ synthesized it."""
    unfilled: Unfilled = Unfilled()
    """The part of the hole that stays empty; nothing for a target that was skipped."""
    rejection: Rejection = Rejection()
    refusal: str | None = None
    """Sentence why the target cannot be completed, or None if it can."""
    skip_reason: str = ""
    """Sentence why there was nothing to complete; empty if there was."""

    def summarize(self) -> str:
        """Describe the hole, and what was done about it."""
        parts = [f"hole {self.hole_fraction:.1%}", f"{len(self.added):,} Gaussians added"]
        if self.num_recolored:
            parts.append(f"{self.num_recolored:,} recoloured")
        return ", ".join([*parts, f"{len(self.notes)} notes"] if self.notes else parts)

    def list_pictures(self) -> dict[str, Tensor]:
        """List the scene at the target before and after."""
        return {"before": self.before.image, "after": self.after.image}

    @property
    def has_changed_scene(self) -> bool:
        """True if Gaussians were added or recoloured."""
        return len(self.added) > 0 or self.num_recolored > 0

    @property
    def hole_fraction(self) -> float:
        """Fraction of the image in holes."""
        return self.hole_mask.float().mean().item()

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about fallbacks and rejections, for a reader of the results."""
        if self.skip_reason:
            return (self.skip_reason,)
        notes = [*self.synthesis_notes, *self.lift_notes, self.geometry.describe()]
        if self.anchor_fallback:
            notes.append("Every view is turned too far; the least-turned one is the anchor.")
        if self.affine.is_refitted_at_target:
            notes.append(
                "The depths that fit the anchor contradict the scene at the target; they are "
                "fitted at the target instead."
            )
        notes.append(AFFINE_NOTES[self.affine.method])
        if self.rejection.guard:
            notes += [self.rejection.reason, NOTHING_ADDED]
        notes.append(self.unfilled.describe())
        notes.append(self.describe_outside())
        return tuple(filter(None, notes))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Those of the notes that ask for a look at the result."""
        if self.skip_reason:
            return ()
        found = []
        if self.rejection.guard:
            # A guard without a reason of its own rejected the image for what Φ says of it.
            reasons = (self.rejection.reason,) if self.rejection.reason else self.synthesis_notes
            found += [*reasons, NOTHING_ADDED]
        if self.unfilled.share >= self.unfilled.LARGE_SHARE:
            found.append(self.unfilled.describe())
        return tuple(filter(None, found))

    def describe_outside(self) -> str:
        """Write a sentence if far more was added outside of the image than in its hole."""
        inside = len(self.added) - self.num_outside
        if self.num_outside <= MANY_TIMES * inside:
            return ""
        return (
            f"{self.num_outside:,} of the {len(self.added):,} added Gaussians lie outside of the "
            f"image of the target, whose hole has {int(self.hole_mask.sum()):,} pixels: they fill "
            "its padding (config.margin 0 leaves them out)."
        )

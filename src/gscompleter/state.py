"""A scene during completion, and the result of each target; conventions are in `types`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import CompleterConfig
from gscompleter.parts import Part, PartKind, find_last_target_id
from gscompleter.system.errors import InputError
from gscompleter.system.files.display import Displayed
from gscompleter.system.plugins import load_function
from gscompleter.system.tensor_checks import describe
from gscompleter.system.timing import add_seconds
from gscompleter.trust import Trust
from gscompleter.types import (
    Camera,
    ContextScene,
    DepthAffine,
    ErrorBudget,
    Gaussians,
    Render,
    View,
    merge,
)

MANY_TIMES = 4
"""Gaussians outside of the image of a target, against those in it, from which on they are many."""
MAX_SHOWN_TARGETS = 4
"""Most targets whose pictures a notebook shows."""
RESULTS = "gscompleter.apps.report.results"
"""Module of the files and scores of a completion, which is above this one."""
AFFINE_NOTES = {
    "ransac": "",
    "median": "RANSAC finds no reliable depth correction; the median depth ratio replaces it.",
    "identity": "There is nothing to fit a depth correction to; the predicted depths are used.",
}
"""Sentence about each estimator of the depth correction; empty for the usual one."""
NOTHING_ADDED = "Nothing of it was added."
LOSSES = {
    "lift": "no depth was found for it",
    "register": "what was made for it did not fit there",
    "filter": "what was made for it lies beside the hole",
    "free-space": "a filling would hide what other cameras see through it",
    "removal": "nothing was removed there",
    "hull": "a filling would lie outside of the object",
    "refine": "the photographs beside it contradict a filling",
    "image-agreement": "the generated image contradicts the photographs",
    "depth-agreement": "its depths contradict the scene",
    "psnr": "a filling would make given photographs worse",
    "contribution": "a filling would hardly be seen",
}
"""Reason why each step leaves a part of a hole empty, as a clause for people."""


@dataclass(frozen=True)
class Photo:
    """A photograph of the scene with its error budgets."""

    view: View
    """With the depth range of the scene, in the exposure of the context."""
    budgets: tuple[ErrorBudget, ...] = ()
    """Largest errors that additions may cause; none if no guard sets them."""


@dataclass(frozen=True)
class Rejection:
    """The guard that removed everything that was generated for a target, if one did."""

    guard: str = ""
    reason: str = ""
    """Sentence for the report; empty if the notes of Φ say it."""


@dataclass(frozen=True)
class Step:
    """The new Gaussians after a step of a target."""

    name: str
    """`lift`, `register`, `filter`, `refine`, or the name of a guard."""
    gaussians: Gaussians


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
    """The same by the step that emptied them for the first time; empty if there is little."""
    regions: tuple[tuple[int, int, int, int], ...] = ()
    """Bounding boxes (left, top, right, bottom) of the largest regions, in pixels of the target
    image; its padding has coordinates below 0 and beyond its size."""

    def describe(self) -> str:
        """Write the sentence for people; empty if the hole is filled.

        `lost_by` and `regions` have the details, for the report.
        """
        if self.share <= self.MAX_SHARE:
            return ""
        # One reason is enough: the others seldom leave as much.
        steps = sorted(self.lost_by, key=lambda step: -self.lost_by[step])
        reason = LOSSES.get(steps[0], f"the step {steps[0]} left it out") if steps else ""
        mostly = "mostly " if len(steps) > 1 else ""
        because = f", {mostly}because {reason}" if reason else ""
        return f"{max(1, round(100 * self.share))} % of the hole stays empty{because}."


@dataclass(frozen=True, repr=False)
class TargetResult(Displayed):
    """Result of one target camera. No stage reads it."""

    target: Camera
    before: Render
    """The scene without what this target changed, rendered at the target."""
    after: Render
    hole_mask: Bool[Tensor, "h w"]
    """True where the scene had a hole or was not trusted, before dilation."""
    trusted_alpha: Float[Tensor, "h w"]
    """Accumulated opacity weighted by trust, from which `hole_mask` follows."""
    anchor: int
    """Index of the anchor among the context views."""
    anchor_fallback: bool
    """True if every view exceeded the rotation limit, so that the smallest rotation won."""
    added: Gaussians
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
    def hole_fraction(self) -> float:
        """Fraction of the image in holes."""
        return self.hole_mask.float().mean().item()

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about fallbacks and rejections, for a reader of the results."""
        if self.skip_reason:
            return (self.skip_reason,)
        notes = [*self.synthesis_notes, *self.lift_notes]
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
        found = [self.rejection.reason or " ".join(self.synthesis_notes), NOTHING_ADDED]
        found = found if self.rejection.guard else []
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


@dataclass(frozen=True, repr=False)
class Completion(Displayed):
    """A scene during completion; steps return a new value, and the old one serves as undo."""

    config: CompleterConfig
    source: ContextScene
    rendered_context: Gaussians
    """The context as stages see it: recoloured in part, and of a large scene a proxy."""
    photos: tuple[Photo, ...]
    """Context photographs, then check photographs."""
    num_context: int
    trust: Trust
    """Trust in `rendered_context`; added Gaussians have full trust."""
    added_parts: tuple[Part, ...] = ()
    """What was added, part by part, in the order of addition."""
    targets: tuple[TargetResult, ...] = ()
    free_space_cameras: tuple[Camera, ...] = ()
    """Further cameras whose free space stays empty, such as the witnesses of a splat; their images
    are not read."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall time of context, generate, lift, register, integrate and total."""
    exposure_gains: Float[Tensor, "v 3"] | None = None
    """Exposure gain of each original photograph relative to `views`, or None if not estimated."""
    num_new_photos: int = 0
    """Number of photographs that a given scene did not reproduce."""
    is_given: bool = False
    """True if the context is a scene that was given, and Ψ did not reconstruct it."""
    seed: int = 0
    """Seed of all random numbers."""
    context_notes: tuple[str, ...] = ()
    """Sentences of Ψ about the context."""
    models: Mapping[str, str] = field(default_factory=dict)
    """Names of the `reconstructor`, its `depth` and the `generator`, for those who read files."""

    def summarize(self) -> str:
        """Describe the targets and the Gaussians."""
        count = len(self.targets)
        holes = ", ".join(f"{result.hole_fraction:.1%}" for result in self.targets)
        targets = f"{count} target{'' if count == 1 else 's'}"
        if holes:
            targets += f" with holes of {holes}"
        return f"{targets}; {len(self.added):,} Gaussians added to {len(self.context):,}"

    def list_pictures(self) -> dict[str, Tensor]:
        """List the scene at its first targets, before and after."""
        shown = enumerate(self.targets[:MAX_SHOWN_TARGETS], start=1)
        return {
            f"target {number}, {when}": image
            for number, result in shown
            for when, image in result.list_pictures().items()
        }

    @cached_property
    def scores(self) -> dict[str, Any]:
        """The verdict, coverage, and scores of photographs and targets, as in `summary.json`.

        Photographs that were not used are missing in them; `score` takes some.
        """
        return self.score()

    def score(self, unused_views: Sequence[View] = ()) -> dict[str, Any]:
        """Score as `scores`, with photographs that were not used, in the frame of the cameras.

        One at the camera of a target scores that target; the others count as held out.
        """
        scores: dict[str, Any] = load_function(RESULTS, "score_result")(self, unused_views)
        return scores

    def save(
        self,
        out: Path | str,
        unused_views: Sequence[View] = (),
        splat: Path | str | None = None,
        overwrite: bool = False,
    ) -> Path:
        """Write what the command `complete` writes to a folder, and return the folder.

        Args:
            out: New or empty folder; with `overwrite`, also one of an earlier run.
            unused_views: As in `score`.
            splat: File that the scene was loaded from, in whose layout and order `completed.ply`
                is then written, so that `strip` takes back recolouring and removal, too.
            overwrite: True to replace the files of an earlier run.

        Raises:
            InputError: The folder is not empty, or the file holds another scene.
        """
        folder: Path = load_function(RESULTS, "save_result")(
            self, out, unused_views, splat, overwrite
        )
        return folder

    def report(self, file: Path | str, unused_views: Sequence[View] = ()) -> Path:
        """Write the page `report.html` of the command alone, under any name; return its path."""
        path: Path = load_function(RESULTS, "write_result_page")(self, file, unused_views)
        return path

    @property
    def views(self) -> tuple[View, ...]:
        """Context photographs."""
        return tuple(photo.view for photo in self.photos[: self.num_context])

    @property
    def parts(self) -> tuple[Gaussians, ...]:
        """Gaussians to render: the context, then the additions, by which frozen scenes grow."""
        return (self.rendered_context, *(part.gaussians for part in self.added_parts))

    @property
    def context(self) -> Gaussians:
        """The scene before its first target, bit for bit."""
        return self.source.gaussians

    @cached_property
    def added(self) -> Gaussians:
        """All Gaussians that were added."""
        return merge([self.rendered_context[:0], *self.parts[1:]])

    def count_added(self, *kinds: PartKind) -> int:
        """Count the additions of these kinds that are in the scene."""
        return sum(len(part) for part in self.added_parts if part.origin.kind in kinds)

    @property
    def num_observed(self) -> int:
        """Number of added Gaussians that photographs show and the given scene lacked."""
        return self.count_added("photographs")

    @property
    def num_invented(self) -> int:
        """Number of added Gaussians that were invented for a target."""
        return self.count_added("target", "gap")

    @cached_property
    def recolored_mask(self) -> Bool[Tensor, "n"]:
        """True for Gaussians of `context` that got new colours."""
        before = self.source.rendered
        after = self.rendered_context
        if after is before:
            return torch.zeros_like(self.source.chosen_mask)
        # Their labels do not tell: a Gaussian may have had this label before.
        return self.source.expand((after.sh != before.sh).flatten(1).any(dim=1))

    @cached_property
    def scene(self) -> Gaussians:
        """The rest of the context, bit for bit unless recoloured, then all added Gaussians."""
        parts = [self.kept_context, *self.parts[1:]]
        return merge(parts) if len(parts) > 1 else parts[0]

    @cached_property
    def recolored(self) -> Gaussians:
        """The Gaussians of `context` that got new colours, with these and their target ids."""
        before = self.source.rendered
        after = self.rendered_context
        if after is before:
            return self.context[:0]
        # What was recoloured may be an LOD proxy: each Gaussian that it stands for takes its change
        # (decision 024).
        is_changed = self.recolored_mask
        rows = self.source.stand_ins[is_changed]
        gaussians = self.context[is_changed]
        change = after.sh[rows] - before.sh[rows]
        return replace(gaussians, sh=gaussians.sh + change, generated=after.generated[rows])

    @cached_property
    def recolored_context(self) -> Gaussians:
        """The context with the new colours and target ids of recoloured Gaussians."""
        if len(self.recolored) == 0:
            return self.context
        # The others keep their bits.
        rows = self.recolored_mask.nonzero()[:, 0]
        return replace(
            self.context,
            sh=self.context.sh.index_copy(0, rows, self.recolored.sh),
            generated=self.context.generated.index_copy(0, rows, self.recolored.generated),
        )

    @cached_property
    def kept_context(self) -> Gaussians:
        """The recoloured context without removed Gaussians."""
        gone = self.source.gone_mask
        return self.recolored_context[~gone] if gone.any() else self.recolored_context

    def iterate_kept(self, count: int) -> Iterator[Gaussians]:
        """Yield `kept_context` from `count` Gaussians of the context at a time, to save memory."""
        is_recolored = self.recolored_mask
        is_gone = self.source.gone_mask
        first = 0
        for start in range(0, max(len(self.context), 1), count):
            block = slice(start, start + count)
            part = self.context[block]
            # Only what was recoloured takes memory of its own.
            rows = is_recolored[block].nonzero()[:, 0]
            if len(rows) > 0:
                new = self.recolored[first : first + len(rows)]
                first += len(rows)
                part = replace(
                    part,
                    sh=part.sh.index_copy(0, rows, new.sh),
                    generated=part.generated.index_copy(0, rows, new.generated),
                )
            yield part[~is_gone[block]] if is_gone[block].any() else part

    @property
    def next_target_id(self) -> int:
        """Value of `generated` for the next target; ids of a given scene are continued."""
        return find_last_target_id(self.context) + len(self.targets) + 1

    def with_depth_range(self, camera: Camera) -> Camera:
        """Return the camera with the depth range of this completion."""
        known = self.photos[0].view.camera  # all photographs share one depth range
        return replace(camera, near=known.near, far=known.far)

    def extended(
        self,
        result: TargetResult,
        seconds: Mapping[str, float],
        added: Sequence[Part] = (),
    ) -> Completion:
        """Append the result of one more target, and what it `added`, in the order of addition."""
        parts = (*self.added_parts, *(part for part in added if len(part)))
        targets = (*self.targets, result)
        return replace(self, added_parts=parts, targets=targets).plus_seconds(seconds)

    def plus_seconds(self, seconds: Mapping[str, float]) -> Completion:
        """Add wall times stage by stage."""
        return replace(self, seconds=add_seconds(self.seconds, seconds))


def check_state(state: object) -> None:
    """Raise InputError for a value in place of a completion."""
    if not isinstance(state, Completion):
        raise InputError(
            "The state has to be a Completion, such as GSCompleter.begin returns, and is "
            f"{describe(state)}."
        )

"""A scene during completion; conventions are in `types`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import CompleterConfig
from gscompleter.numerics.given_geometry import GivenGeometry
from gscompleter.parts import Part, PartKind, check_target_ids, find_last_target_id
from gscompleter.system.files.display import Displayed
from gscompleter.system.files.mapping import change_rows, find_changed_rows, select_rows
from gscompleter.system.plugins import load_function
from gscompleter.target_result import TargetResult
from gscompleter.trust import Trust
from gscompleter.types import Camera, ContextScene, ErrorBudget, Gaussians, View, merge

MAX_SHOWN_TARGETS = 4
"""Most targets whose pictures a notebook shows."""
RESULTS_MODULE = "gscompleter.apps.report.results"
"""Module of the files and scores of a completion, which is above this one."""


@dataclass(frozen=True)
class Photo:
    """A photograph of the scene with its error budgets."""

    view: View
    """With the depth range of the scene. Photographs that Ψ made the scene of have its exposure;
    those of a given scene keep their own."""
    budgets: tuple[ErrorBudget, ...] = ()
    """Largest errors that it may have with additions; none if no guard sets them."""


@dataclass(frozen=True, repr=False)
class Completion(Displayed):
    """A scene during completion; steps return a new value, and the old one serves as undo."""

    config: CompleterConfig
    source: ContextScene
    rendered_context: Gaussians
    """The context as stages see it: without what is gone, recoloured in part, and of a large scene
    a proxy."""
    photos: tuple[Photo, ...]
    """Context photographs, then check photographs."""
    num_context: int
    trust: Trust
    """Trust in `rendered_context`, full after a removal. Additions have full trust, and so have
    Gaussians that returned after a removal: they are the last rows, for which it has no values."""
    added_parts: tuple[Part, ...] = ()
    """What was added, part by part in the order of addition. The end of a removal puts what was not
    invented first."""
    targets: tuple[TargetResult, ...] = ()
    filled_target: Camera | None = None
    """Target whose holes are filled and whose gaps are being closed; None in between targets."""
    free_space_cameras: tuple[Camera, ...] = ()
    """Further cameras whose free space stays empty, such as the witnesses of a splat; they need no
    photographs."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall time of context, generate, lift, register, integrate and total, and of explore where
    targets were searched for."""
    exposure_gains: Float[Tensor, "v 3"] | None = None
    """Exposure gain of each original photograph relative to `views`, or None if not estimated."""
    num_new_photos: int = 0
    """Number of photographs that a given scene did not reproduce."""
    is_given: bool = False
    """True if the context is a scene that was given, and Ψ did not reconstruct it."""
    is_remade: bool = False
    """True if Ψ made the given scene anew, which may have another exposure since."""
    seed: int = 0
    """Seed of the completer: of RANSAC's samples, and of the cameras that measure coverage. Φ has
    its own."""
    context_notes: tuple[str, ...] = ()
    """Sentences of Ψ about the context."""
    geometry: GivenGeometry | None = None
    """Geometry from elsewhere, whose depth is used in holes; None for none."""
    confirmation: Trust | None = None
    """How far photographs confirm what a removal left, although all of it has full trust; None if
    they do not decide what stays (`forces_removed` and `keeps_confirmed`)."""
    trust_elsewhere: Trust | None = None
    """Trust in `rendered_context` from before a removal, for holes where nothing was removed; None
    without a removal."""
    is_restored: bool = False
    """True if photographs look as before around what was removed (`restore_surroundings`); a target
    or removal after it makes it False."""
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
        """Score as `scores`, with photographs that were not used.

        Their cameras are in the coordinates of the scene. A photograph at the camera of a target
        scores that target; the others count as held out.
        """
        scores: dict[str, Any] = load_function(RESULTS_MODULE, "score_result")(self, unused_views)
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
            splat: File or folder that the scene was loaded from (`load_splat`), and that still has
                its values. In its layout and order `completed.ply` is then written, so that `strip`
                takes back recolouring and removal, too.
            overwrite: True to replace the files of an earlier run.

        Raises:
            InputError: `out` is not empty, or `splat` holds another scene.
        """
        folder: Path = load_function(RESULTS_MODULE, "save_result")(
            self, out, unused_views, splat, overwrite
        )
        return folder

    def report(self, file: Path | str, unused_views: Sequence[View] = ()) -> Path:
        """Write the page `report.html` of the command alone, under any name; return its path."""
        path: Path = load_function(RESULTS_MODULE, "write_result_page")(self, file, unused_views)
        return path

    @property
    def views(self) -> tuple[View, ...]:
        """Context photographs."""
        return tuple(photo.view for photo in self.photos[: self.num_context])

    @property
    def completed_cameras(self) -> list[Camera]:
        """Cameras of the targets for which something was added."""
        return [result.target for result in self.targets if len(result.added)]

    @property
    def parts(self) -> tuple[Gaussians, ...]:
        """Gaussians to render: the context, then the additions, by which frozen scenes grow."""
        return (self.rendered_context, *(part.gaussians for part in self.added_parts))

    @property
    def context(self) -> Gaussians:
        """The scene as it was given or reconstructed, bit for bit, with what was removed since."""
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
        """Number of added Gaussians that photographs show.

        The given scene lacked them, or they were made anew.
        """
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
        return self.source.expand(find_changed_rows(before.sh, after.sh))

    @cached_property
    def scene(self) -> Gaussians:
        """The rest of the context, bit for bit unless recoloured, then all added Gaussians."""
        return merge([self.kept_context, *self.parts[1:]])

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
        change = select_rows(after.sh, rows) - select_rows(before.sh, rows)
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
            sh=change_rows(self.context.sh, rows, self.recolored.sh),
            generated=self.context.generated.index_copy(0, rows, self.recolored.generated),
        )

    @cached_property
    def kept_context(self) -> Gaussians:
        """The recoloured context without Gaussians that are gone."""
        gone = self.source.gone_mask
        return self.recolored_context[~gone] if gone.any() else self.recolored_context

    @cached_property
    def next_target_id(self) -> int:
        """Value of `generated` for the next target; ids of a given scene are continued.

        Raises InputError if a .ply has no id left for it.
        """
        last = find_last_target_id(self.context)
        check_target_ids(last, len(self.targets) + 1)
        return last + len(self.targets) + 1

    def with_depth_range(self, camera: Camera) -> Camera:
        """Return the camera with the depth range of this completion."""
        known = self.photos[0].view.camera  # all photographs share one depth range
        return replace(camera, near=known.near, far=known.far)

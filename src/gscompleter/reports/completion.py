"""The output folder of a completion: scenes, images, report.json and summary.json."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gscompleter import __version__
from gscompleter.completer import GSCompleter, contexts_of
from gscompleter.io.files import COMPLETED, CONTEXT
from gscompleter.io.image import write_image
from gscompleter.io.ply import save_ply
from gscompleter.kernels.sharing import side_by_side
from gscompleter.metrics.coverage import Look, coverage_of
from gscompleter.metrics.image import masked_psnr, ssim
from gscompleter.render import Renderer, each_view
from gscompleter.reports.depth_picture import limits_of, write_depth
from gscompleter.reports.record import Limits, most_changed, record_of, write_record
from gscompleter.splats.layout import save_like
from gscompleter.splats.removed import NAME as REMOVED
from gscompleter.splats.removed import save_removed
from gscompleter.types import Camera, Completion, Gaussians, Render, TargetCompletion, View

GENERATED = "generated.ply"

IGNORED = (1.0, 0.0, 1.0)

Scores = dict[str, float | None]


@dataclass(frozen=True)
class Target:
    """A target camera with the photograph that scores it."""

    camera: Camera
    frame: int | None = None
    """Frame number in the scene; None for a camera from elsewhere."""
    photograph: Float[Tensor, "h w 3"] | None = None
    """Photograph at the target, if there is one. Only the generator `oracle` uses it."""
    ignored: Bool[Tensor, "h w"] | None = None
    """True for pixels that are not scored; None if all are."""
    near: int | None = None
    """Frame number that a planned camera was derived from; None if the user gave the camera."""

    @property
    def view(self) -> View | None:
        """The photograph with its camera, or None."""
        if self.photograph is None:
            return None
        return View(self.photograph, self.camera, self.frame, ignored=self.ignored)


@dataclass(frozen=True)
class HeldOut:
    """A photograph that is neither context nor target and only scores the result."""

    view: View
    """View in the frame of the result."""
    is_check: bool = False
    """True if a small copy of it checked the input splat."""


@dataclass(frozen=True)
class Brought:
    """The file of the input splat."""

    path: Path
    kept: Bool[Tensor, "n"] | None = None
    """Mask of the Gaussians in the file that form the context; None for all."""
    order: Int64[Tensor, "n"] | None = None
    """Index among these of each Gaussian of the context; None for the order of the file."""


@dataclass(frozen=True)
class Around:
    """Views around the photographs, for the report."""

    looks: tuple[Look, ...] = ()
    photographs: tuple[Camera, ...] = ()
    """Cameras of all photographs, in the frame of the result."""


@dataclass(frozen=True)
class Images:
    """Renders of one camera before and after the completion."""

    before: Render
    after: Render
    truth: View | None

    def scores(self) -> Scores:
        """Compute PSNR (dB) and SSIM over the valid pixels, or None without a photograph."""
        images, truth = {"before": self.before.image, "after": self.after.image}, self.truth
        if truth is None:
            return {f"{name}_{when}": None for name in ("psnr", "ssim") for when in images}
        return {
            **{f"psnr_{w}": masked_psnr(i, truth.image, truth.counted) for w, i in images.items()},
            **{f"ssim_{w}": ssim(truth.compared(i), truth.image) for w, i in images.items()},
        }


def compare(
    completion: Completion, camera: Camera, truth: View | None, renderer: Renderer
) -> Images:
    """Render the context and the completed scene."""
    with torch.no_grad():
        frozen = renderer.freeze(completion.context, camera)
        if completion.set_aside is None:
            after = frozen.composite(completion.added)
        else:  # some of the context was pruned
            after = renderer.render(completion.scene, camera)
    return Images(frozen.context, after, truth)


def at_photographs(completion: Completion, completer: GSCompleter) -> list[Images]:
    """Render the context views, from the cache of `completer` unless it used an LOD proxy."""
    views = completion.views
    if completion.proxy is not None:
        return [compare(completion, v.camera, v, completer.renderer) for v in views]
    after = contexts_of(completer.at(completion, views))
    seen = zip(completion.begun, after, views, strict=True)
    return [Images(first, last, view) for first, last, view in seen]


def score_held_out(
    completion: Completion, photographs: Sequence[HeldOut], renderer: Renderer
) -> list[dict[str, Any]]:
    """Score the scene before and after at held-out photographs."""

    def score(held_out: HeldOut) -> dict[str, Any]:
        view = held_out.view
        scores = compare(completion, view.camera, view, renderer).scores()
        return {"frame": view.frame, **scores, "is_check": held_out.is_check}

    return list(each_view(completion.added)(score, photographs))


def summarize(
    completion: Completion,
    targets: Sequence[Target],
    scores: Sequence[Scores],
    said: Mapping[str, Any],
) -> dict[str, Any]:
    """Build summary.json from the facts of the run and the scores of context and targets."""
    count = len(completion.views)
    return {
        "version": __version__,
        **said,
        "context": [
            {
                "frame": view.frame,
                **scored,
                "exposure_gain": gain,
                "dynamic_fraction": share_of(view.contradicted),
                "ignored": share_of(view.ignored),
            }
            for view, scored, gain in zip(
                completion.views, scores[:count], gains_of(completion), strict=True
            )
        ],
        "targets": [
            {
                "frame": target.frame,
                "derived_from": target.near,
                "anchor": completion.views[result.anchor].frame,
                "anchor_fallback": result.anchor_fallback,
                "hole_fraction": result.hole_fraction,
                "affine": {
                    key: getattr(result.affine, key)
                    for key in ("scale", "shift", "inliers", "method", "agreement")
                },
                **scored,
                # the property of completed.ply that marks the Gaussians of this target
                "target_id": int(result.added.generated[0]) if len(result.added) else None,
                "added": len(result.added),
                "notes": list(result.notes),
                "refused": result.refused,
            }
            for target, result, scored in zip(
                targets, completion.targets, scores[count:], strict=True
            )
        ],
        "gaussians": counts(completion),
        "seconds": dict(completion.seconds),
    }


def gains_of(completion: Completion) -> list[list[float] | None]:
    """List the exposure gains per photograph and channel; None if they were not normalized."""
    if completion.gains is None:
        return [None] * len(completion.views)
    return completion.gains.tolist()


def covered_by(around: Around) -> dict[str, Any]:
    """Summarize the coverage of the surrounding views, if there are any."""
    return {"coverage": coverage_of(around.looks).as_summary()} if around.looks else {}


def share_of(mask: Bool[Tensor, "h w"] | None) -> float:
    """Compute the fraction of True pixels; 0 without a mask."""
    return 0.0 if mask is None else mask.float().mean().item()


def counts(completion: Completion) -> dict[str, int]:
    """Count the Gaussians of the context, the added and, of an input splat, the pruned ones."""
    found = {"context": len(completion.context), "added": len(completion.added)}
    if completion.evidence is None:
        return found
    removed = completion.removed
    return found | {"removed": 0 if removed is None else int(removed.sum())}


def write_report(
    folder: Path,
    completion: Completion,
    targets: Sequence[Target],
    completer: GSCompleter,
    said: Mapping[str, Any],
    brought: Brought | None = None,
    around: Callable[[], Around] = Around,
    held_out: Sequence[HeldOut] = (),
) -> dict[str, Any]:
    """Write the scenes, `images/`, `report.json` and `summary.json`; return the summary.

    `completed.ply` keeps the layout of an input splat. Surrounding views are rendered last, and
    held-out photographs only score the result.

    Raises:
        InputError: if a file cannot be written.
    """
    context_images = at_photographs(completion, completer)
    target_images = [
        compare(completion, result.target, target.view, completer.renderer)
        for target, result in zip(targets, completion.targets, strict=True)
    ]
    scores = side_by_side(Images.scores, [*context_images, *target_images])
    unused = score_held_out(completion, held_out, completer.renderer)
    write_scenes(folder, completion, brought)
    pictured = folder / "images"
    pictured.mkdir()
    results = zip(completion.targets, target_images, strict=True)
    write_ignored(pictured, completion.views)
    limits = [write_pictures(pictured, n, *pair) for n, pair in enumerate(results, start=1)]
    surroundings = around()
    shown = most_changed(surroundings.looks)
    write_looks(pictured, shown)
    write_record(folder, record_of(completion, limits, shown, surroundings.photographs))
    facts = {**said, **covered_by(surroundings), "held_out": unused}
    summary = summarize(completion, targets, scores, facts)
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    return summary


def write_scenes(folder: Path, completion: Completion, brought: Brought | None) -> None:
    """Write the three scenes, and the pruned Gaussians of an input splat."""
    if brought is None:
        save_own(folder, completion)
        return
    context, aside = as_in_file(completion, brought)
    writing = (
        partial(save_ply, folder / CONTEXT, context),
        partial(save_brought, folder, context, aside, completion.added, brought),
        partial(save_ply, folder / GENERATED, completion.added, provenance=True),
    )
    side_by_side(lambda write: write(), writing)


def write_pictures(
    folder: Path, number: int, result: TargetCompletion, images: Images
) -> Limits | None:
    """Write the images of a target; return the limits of its depth colours."""
    named = pictures(result, images)
    write_images({folder / f"target{number}_{name}.png": named[name] for name in named})
    depths = {"before": images.before.depth_map(), "after": images.after.depth_map()}
    limits = limits_of(list(depths.values()))
    if limits is not None:
        for when, depth in depths.items():
            write_depth(folder / f"target{number}_depth_{when}.png", depth, limits)
    return limits


def write_ignored(folder: Path, views: Sequence[View]) -> None:
    """Write each photograph that has ignored pixels, with these painted over."""
    painted = {}
    for number, view in enumerate(views, start=1):
        if view.ignored is not None:
            colour = view.image.new_tensor(IGNORED)
            image = torch.where(view.ignored[..., None], colour, view.image)
            painted[folder / f"context{number}_ignored.png"] = image
    write_images(painted)


def write_looks(folder: Path, looks: Sequence[Look]) -> None:
    """Write the surrounding views before and after."""
    seen = {}
    for number, look in enumerate(looks, start=1):
        seen[folder / f"around{number}_before.png"] = look.before.image
        seen[folder / f"around{number}_after.png"] = look.after.image
    write_images(seen)


def write_images(images: Mapping[Path, Tensor]) -> None:
    """Write images in parallel: colour [h, w, 3], grey or masks [h, w]."""
    side_by_side(write_image, images.keys(), images.values())


def save_own(folder: Path, completion: Completion) -> None:
    """Write the three scenes of a reconstructed context in parallel; they fit into memory."""
    paths = [folder / name for name in (CONTEXT, COMPLETED, GENERATED)]
    scenes = completion.context, completion.scene, completion.added
    side_by_side(save_ply, paths, scenes, (None, True, True))


def as_in_file(
    completion: Completion, brought: Brought
) -> tuple[Gaussians, Bool[Tensor, "n"] | None]:
    """Sort the context and its pruned mask in the order of the input file."""
    context, aside = completion.context, completion.removed
    if brought.order is None:
        return context, aside
    places = brought.order.argsort().to(context.means.device)
    return context[places], None if aside is None else aside[places]


def save_brought(
    folder: Path,
    context: Gaussians,
    aside: Bool[Tensor, "n"] | None,
    added: Gaussians,
    brought: Brought,
) -> None:
    """Write `completed.ply` in the layout of the input splat, and `removed.ply`."""
    kept = brought.kept
    if aside is None or not aside.any():
        save_like(folder / COMPLETED, context, added, brought.path, kept)
        return
    rows = torch.nonzero(aside.cpu())[:, 0]
    removed = context[aside].to("cpu")
    save_removed(folder / REMOVED, removed, rows, brought.path, kept)
    stays, left = ~aside.cpu(), context[~aside]
    if kept is not None:
        stays = torch.zeros_like(kept).masked_scatter(kept, stays)
    save_like(folder / COMPLETED, left, added, brought.path, stays)


def pictures(result: TargetCompletion, images: Images) -> dict[str, Tensor]:
    """Collect the images of a target by name: colour [h, w, 3] or masks [h, w]."""
    found = {
        "before": images.before.image,
        "after": images.after.image,
        "hole_mask": result.hole_mask.float(),
    }
    if result.support is not None:
        found["support"] = result.support
    if result.reference is not None:
        found["reference"] = result.reference.image
    if images.truth is not None:
        found["truth"] = images.truth.image
    return found


def strip(pictures: Sequence[Float[Tensor, "h _w 3"]], gap: int = 4) -> Float[Tensor, "h wide 3"]:
    """Join images of one height side by side on white."""
    white = torch.ones((pictures[0].shape[0], gap, 3))
    parts = [part for picture in pictures for part in (white, picture.cpu().clamp(0, 1))]
    return torch.cat(parts[1:], dim=1)

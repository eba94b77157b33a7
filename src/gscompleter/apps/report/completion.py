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
from gscompleter.apps.report.depth_picture import compute_depth_limits, write_depth_image
from gscompleter.apps.report.record import Limits, make_record, select_most_changed, write_record
from gscompleter.completer import GSCompleter, get_renders
from gscompleter.evaluation.metrics.coverage import RenderPair, compute_coverage
from gscompleter.evaluation.metrics.image import compute_masked_psnr, ssim
from gscompleter.io.files import COMPLETED_FILE, CONTEXT_FILE
from gscompleter.io.image import write_image
from gscompleter.kernels.parallel import map_in_parallel
from gscompleter.render import Renderer, get_view_map
from gscompleter.splats.layout import save_like
from gscompleter.splats.ply import save_ply
from gscompleter.splats.strip import REMOVED_FILE as REMOVED
from gscompleter.splats.strip import save_removed
from gscompleter.state import Completion, TargetResult
from gscompleter.types import Camera, Gaussians, Render, View

GENERATED_FILE = "generated.ply"

IGNORED_COLOR = (1.0, 0.0, 1.0)

Scores = dict[str, float | None]


@dataclass(frozen=True)
class Target:
    """A target camera with the photograph that scores it."""

    camera: Camera
    frame: int | None = None
    """Frame number in the scene; None for a camera from elsewhere."""
    photograph: Float[Tensor, "h w 3"] | None = None
    """Photograph at the target, if there is one. Only the generator `oracle` uses it."""
    ignore_mask: Bool[Tensor, "h w"] | None = None
    """True for pixels that are not scored; None if all are."""
    derived_from: int | None = None
    """Frame number that a planned camera was derived from; None if the user gave the camera."""

    @property
    def view(self) -> View | None:
        """The photograph with its camera, or None."""
        if self.photograph is None:
            return None
        return View(self.photograph, self.camera, self.frame, ignore_mask=self.ignore_mask)


@dataclass(frozen=True)
class HeldOut:
    """A photograph that is neither context nor target and only scores the result."""

    view: View
    """View in the frame of the result."""
    is_check: bool = False
    """True if a small copy of it checked the input splat."""


@dataclass(frozen=True)
class InputSplatFile:
    """The file of the input splat."""

    path: Path
    context_mask: Bool[Tensor, "n"] | None = None
    """Mask of the Gaussians in the file that form the context; None for all."""
    file_order: Int64[Tensor, "n"] | None = None
    """Index among these of each Gaussian of the context; None for the order of the file."""


@dataclass(frozen=True)
class Surroundings:
    """Views around the photographs, for the report."""

    views: tuple[RenderPair, ...] = ()
    photographs: tuple[Camera, ...] = ()
    """Cameras of all photographs, in the frame of the result."""


@dataclass(frozen=True)
class BeforeAfter:
    """Renders of one camera before and after the completion."""

    before: Render
    after: Render
    photograph: View | None

    def compute_scores(self) -> Scores:
        """Compute PSNR (dB) and SSIM over the valid pixels, or None without a photograph."""
        images, truth = {"before": self.before.image, "after": self.after.image}, self.photograph
        if truth is None:
            return {f"{name}_{when}": None for name in ("psnr", "ssim") for when in images}
        return {
            **{
                f"psnr_{w}": compute_masked_psnr(i, truth.image, truth.valid_mask)
                for w, i in images.items()
            },
            **{f"ssim_{w}": ssim(truth.fill_ignored(i), truth.image) for w, i in images.items()},
        }


def render_before_after(
    completion: Completion, camera: Camera, photograph: View | None, renderer: Renderer
) -> BeforeAfter:
    """Render the context and the completed scene."""
    with torch.no_grad():
        frozen = renderer.freeze(completion.context, camera)
        if completion.pruned is None:
            after = frozen.composite(completion.added)
        else:  # some of the context was pruned
            after = renderer.render(completion.scene, camera)
    return BeforeAfter(frozen.render, after, photograph)


def render_context_views(completion: Completion, completer: GSCompleter) -> list[BeforeAfter]:
    """Render the context views, from the cache of `completer` unless it used an LOD proxy."""
    views = completion.views
    if completion.proxy is not None:
        return [render_before_after(completion, v.camera, v, completer.renderer) for v in views]
    after = get_renders(completer.freeze_at(completion, views))
    seen = zip(completion.context_renders, after, views, strict=True)
    return [BeforeAfter(first, last, view) for first, last, view in seen]


def score_held_out(
    completion: Completion, photographs: Sequence[HeldOut], renderer: Renderer
) -> list[dict[str, Any]]:
    """Score the scene before and after at held-out photographs."""

    def score(held_out: HeldOut) -> dict[str, Any]:
        view = held_out.view
        scores = render_before_after(completion, view.camera, view, renderer).compute_scores()
        return {"frame": view.frame, **scores, "is_check": held_out.is_check}

    return list(get_view_map(completion.added)(score, photographs))


def build_summary(
    completion: Completion,
    targets: Sequence[Target],
    scores: Sequence[Scores],
    run_info: Mapping[str, Any],
) -> dict[str, Any]:
    """Build summary.json from the facts of the run and the scores of context and targets."""
    count = len(completion.views)
    return {
        "version": __version__,
        **run_info,
        "context": [
            {
                "frame": view.frame,
                **scored,
                "exposure_gain": gain,
                "dynamic_fraction": compute_mask_fraction(view.dynamic_mask),
                "ignored": compute_mask_fraction(view.ignore_mask),
            }
            for view, scored, gain in zip(
                completion.views, scores[:count], list_exposure_gains(completion), strict=True
            )
        ],
        "targets": [
            {
                "frame": target.frame,
                "derived_from": target.derived_from,
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
                "refused": result.refusal,
            }
            for target, result, scored in zip(
                targets, completion.targets, scores[count:], strict=True
            )
        ],
        "gaussians": count_gaussians(completion),
        "seconds": dict(completion.seconds),
    }


def list_exposure_gains(completion: Completion) -> list[list[float] | None]:
    """List the exposure gains per photograph and channel; None if they were not normalized."""
    if completion.exposure_gains is None:
        return [None] * len(completion.views)
    return completion.exposure_gains.tolist()


def summarize_coverage(measured: Surroundings) -> dict[str, Any]:
    """Summarize the coverage of the surrounding views, if there are any."""
    return {"coverage": compute_coverage(measured.views).as_summary()} if measured.views else {}


def compute_mask_fraction(mask: Bool[Tensor, "h w"] | None) -> float:
    """Compute the fraction of True pixels; 0 without a mask."""
    return 0.0 if mask is None else mask.float().mean().item()


def count_gaussians(completion: Completion) -> dict[str, int]:
    """Count the Gaussians of the context, the added and, of an input splat, the pruned ones."""
    found = {"context": len(completion.context), "added": len(completion.added)}
    if completion.observations is None:
        return found
    removed = completion.pruned_mask
    return found | {"removed": 0 if removed is None else int(removed.sum())}


def write_report(
    folder: Path,
    completion: Completion,
    targets: Sequence[Target],
    completer: GSCompleter,
    run_info: Mapping[str, Any],
    input_splat: InputSplatFile | None = None,
    render_surroundings: Callable[[], Surroundings] = Surroundings,
    held_out: Sequence[HeldOut] = (),
) -> dict[str, Any]:
    """Write the scenes, `images/`, `report.json` and `summary.json`; return the summary.

    `completed.ply` keeps the layout of an input splat. Surrounding views are rendered last, and
    held-out photographs only score the result.

    Raises:
        InputError: if a file cannot be written.
    """
    context_images = render_context_views(completion, completer)
    target_images = [
        render_before_after(completion, result.target, target.view, completer.renderer)
        for target, result in zip(targets, completion.targets, strict=True)
    ]
    scores = map_in_parallel(BeforeAfter.compute_scores, [*context_images, *target_images])
    unused = score_held_out(completion, held_out, completer.renderer)
    write_scenes(folder, completion, input_splat)
    pictured = folder / "images"
    pictured.mkdir()
    results = zip(completion.targets, target_images, strict=True)
    write_ignored(pictured, completion.views)
    limits = [write_pictures(pictured, n, *pair) for n, pair in enumerate(results, start=1)]
    surroundings = render_surroundings()
    shown = select_most_changed(surroundings.views)
    write_surrounding_views(pictured, shown)
    write_record(folder, make_record(completion, limits, shown, surroundings.photographs))
    facts = {**run_info, **summarize_coverage(surroundings), "held_out": unused}
    summary = build_summary(completion, targets, scores, facts)
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    return summary


def write_scenes(folder: Path, completion: Completion, input_splat: InputSplatFile | None) -> None:
    """Write the three scenes, and the pruned Gaussians of an input splat."""
    if input_splat is None:
        save_reconstructed_scenes(folder, completion)
        return
    context, aside = restore_file_order(completion, input_splat)
    writing = (
        partial(save_ply, folder / CONTEXT_FILE, context),
        partial(save_completed_splat, folder, context, aside, completion.added, input_splat),
        partial(save_ply, folder / GENERATED_FILE, completion.added, provenance=True),
    )
    map_in_parallel(lambda write: write(), writing)


def write_pictures(
    folder: Path, number: int, result: TargetResult, images: BeforeAfter
) -> Limits | None:
    """Write the images of a target; return the limits of its depth colours."""
    named = collect_images(result, images)
    write_images({folder / f"target{number}_{name}.png": named[name] for name in named})
    depths = {"before": images.before.depth_map(), "after": images.after.depth_map()}
    limits = compute_depth_limits(list(depths.values()))
    if limits is not None:
        for when, depth in depths.items():
            write_depth_image(folder / f"target{number}_depth_{when}.png", depth, limits)
    return limits


def write_ignored(folder: Path, views: Sequence[View]) -> None:
    """Write each photograph that has ignored pixels, with these painted over."""
    painted = {}
    for number, view in enumerate(views, start=1):
        if view.ignore_mask is not None:
            colour = view.image.new_tensor(IGNORED_COLOR)
            image = torch.where(view.ignore_mask[..., None], colour, view.image)
            painted[folder / f"context{number}_ignored.png"] = image
    write_images(painted)


def write_surrounding_views(folder: Path, views: Sequence[RenderPair]) -> None:
    """Write the surrounding views before and after."""
    seen = {}
    for number, look in enumerate(views, start=1):
        seen[folder / f"around{number}_before.png"] = look.before.image
        seen[folder / f"around{number}_after.png"] = look.after.image
    write_images(seen)


def write_images(images: Mapping[Path, Tensor]) -> None:
    """Write images in parallel: colour [h, w, 3], grey or masks [h, w]."""
    map_in_parallel(write_image, images.keys(), images.values())


def save_reconstructed_scenes(folder: Path, completion: Completion) -> None:
    """Write the three scenes of a reconstructed context in parallel; they fit into memory."""
    paths = [folder / name for name in (CONTEXT_FILE, COMPLETED_FILE, GENERATED_FILE)]
    scenes = completion.context, completion.scene, completion.added
    map_in_parallel(save_ply, paths, scenes, (None, True, True))


def restore_file_order(
    completion: Completion, input_splat: InputSplatFile
) -> tuple[Gaussians, Bool[Tensor, "n"] | None]:
    """Sort the context and its pruned mask in the order of the input file."""
    context, aside = completion.context, completion.pruned_mask
    if input_splat.file_order is None:
        return context, aside
    places = input_splat.file_order.argsort().to(context.means.device)
    return context[places], None if aside is None else aside[places]


def save_completed_splat(
    folder: Path,
    context: Gaussians,
    pruned: Bool[Tensor, "n"] | None,
    added: Gaussians,
    input_splat: InputSplatFile,
) -> None:
    """Write `completed.ply` in the layout of the input splat, and `pruned_mask.ply`."""
    kept = input_splat.context_mask
    if pruned is None or not pruned.any():
        save_like(folder / COMPLETED_FILE, context, added, input_splat.path, kept)
        return
    rows = torch.nonzero(pruned.cpu())[:, 0]
    removed = context[pruned].to("cpu")
    save_removed(folder / REMOVED, removed, rows, input_splat.path, kept)
    stays, left = ~pruned.cpu(), context[~pruned]
    if kept is not None:
        stays = torch.zeros_like(kept).masked_scatter(kept, stays)
    save_like(folder / COMPLETED_FILE, left, added, input_splat.path, stays)


def collect_images(result: TargetResult, images: BeforeAfter) -> dict[str, Tensor]:
    """Collect the images of a target by name: colour [h, w, 3] or masks [h, w]."""
    found = {
        "before": images.before.image,
        "after": images.after.image,
        "hole_mask": result.hole_mask.float(),
    }
    if result.trusted_alpha is not None:
        found["support"] = result.trusted_alpha
    if result.reference is not None:
        found["reference"] = result.reference.image
    if images.photograph is not None:
        found["truth"] = images.photograph.image
    return found


def join_images(
    pictures: Sequence[Float[Tensor, "h _w 3"]], gap: int = 4
) -> Float[Tensor, "h wide 3"]:
    """Join images of one height side by side on white."""
    white = torch.ones((pictures[0].shape[0], gap, 3))
    parts = [part for picture in pictures for part in (white, picture.cpu().clamp(0, 1))]
    return torch.cat(parts[1:], dim=1)

"""The output folder of a completion: scenes, images, report.json and summary.json."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gscompleter import __version__
from gscompleter.apps.report.charts import compute_depth_limits, write_depth_image
from gscompleter.apps.report.schema import (
    RECORD_FILE,
    SCORES,
    AlignmentRow,
    CompletionRecord,
    ContextRow,
    HeldOutRow,
    Limits,
    PairsRow,
    PoseRow,
    TargetRecord,
    TargetRow,
    Vector,
)
from gscompleter.completer import GSCompleter
from gscompleter.evaluation.metrics.coverage import RenderPair, compute_coverage
from gscompleter.evaluation.metrics.image import compute_masked_psnr, ssim
from gscompleter.io.files import COMPLETED_FILE, CONTEXT_FILE, SUMMARY_FILE
from gscompleter.io.image import write_image
from gscompleter.kernels.parallel import map_in_parallel
from gscompleter.render import Renderer, get_view_map
from gscompleter.splats.layout import save_like
from gscompleter.splats.ply import save_ply
from gscompleter.splats.strip import REMOVED_FILE, save_removed
from gscompleter.state import Completion, TargetResult
from gscompleter.types import Camera, DepthPairs, Gaussians, Render, View, merge

GENERATED_FILE = "generated.ply"
MAX_PHOTOGRAPHS = 200
MAX_POINTS = 600
"""Largest number of points to keep, of the context and of the added Gaussians each."""
MAX_SURROUNDING_VIEWS = 6
MIN_SURFACE_OPACITY = 0.3
MIN_COLOR_CHANGE = 0.002
"""Smallest mean colour difference, in [0, 1], of a changed image."""
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
        scores: Scores = dict.fromkeys(SCORES)
        truth = self.photograph
        if truth is not None:
            for when, render in (("before", self.before), ("after", self.after)):
                image = render.image
                scores[f"psnr_{when}"] = compute_masked_psnr(image, truth.image, truth.valid_mask)
                scores[f"ssim_{when}"] = ssim(truth.fill_ignored(image), truth.image)
        return scores


def render_before_after(
    completion: Completion, camera: Camera, photograph: View | None, renderer: Renderer
) -> BeforeAfter:
    """Render the context and the completed scene."""
    with torch.no_grad():
        frozen = renderer.freeze(completion.context, camera)
        if completion.recolored_context is completion.context:
            after = frozen.composite(completion.added)
        else:
            after = renderer.render(completion.scene, camera)
    return BeforeAfter(frozen.render, after, photograph)


def score_held_out(
    completion: Completion, photographs: Sequence[HeldOut], renderer: Renderer
) -> list[dict[str, Any]]:
    """Score the scene before and after at held-out photographs."""

    def score(held_out: HeldOut) -> dict[str, Any]:
        view = held_out.view
        scores = render_before_after(completion, view.camera, view, renderer).compute_scores()
        return asdict(HeldOutRow(view.frame, **scores, is_check=held_out.is_check))

    return list(get_view_map(completion.added)(score, photographs))


def build_summary(
    completion: Completion, targets: Sequence[Target], scores: Sequence[Scores]
) -> dict[str, Any]:
    """Build the results in summary.json from the scores of context and targets."""
    views, results = completion.views, completion.targets
    gains = completion.exposure_gains
    gain_rows = [None] * len(views) if gains is None else map(tuple, gains.tolist())
    context = map(make_context_row, views, scores[: len(views)], gain_rows)
    anchors = [views[result.anchor].frame for result in results]
    at_targets = map(make_target_row, targets, results, scores[len(views) :], anchors)
    return {
        "context": [asdict(row) for row in context],
        "targets": [asdict(row) for row in at_targets],
        "gaussians": count_gaussians(completion),
        **count_new_photographs(completion),
        "seconds": dict(completion.seconds),
    }


def make_context_row(view: View, scores: Scores, exposure_gain: Vector | None) -> ContextRow:
    """Make the row of a context photograph."""
    return ContextRow(
        view.frame,
        **scores,
        exposure_gain=exposure_gain,
        dynamic_fraction=compute_mask_fraction(view.dynamic_mask),
        ignored=compute_mask_fraction(view.ignore_mask),
    )


def make_target_row(
    target: Target, result: TargetResult, scores: Scores, anchor: int | None
) -> TargetRow:
    """Make the row of a target; `anchor` is a frame."""
    fit, added = result.affine, result.added
    return TargetRow(
        target.frame,
        **scores,
        anchor=anchor,
        anchor_fallback=result.anchor_fallback,
        hole_fraction=result.hole_fraction,
        affine=AlignmentRow(fit.scale, fit.shift, fit.inliers, fit.method, fit.agreement),
        added=len(added),
        derived_from=target.derived_from,
        recolored=result.num_recolored,
        target_id=result.target_id if len(added) or result.num_recolored else None,
        notes=result.notes,
        refused=result.refusal,
    )


def compute_mask_fraction(mask: Bool[Tensor, "h w"] | None) -> float:
    """Compute the fraction of True pixels; 0 without a mask."""
    return 0.0 if mask is None else mask.float().mean().item()


def count_new_photographs(completion: Completion) -> dict[str, int]:
    """Count the photographs that a splat was not trained on; empty under full trust."""
    if completion.config.trust == "full":
        return {}
    return {"new_photographs": completion.num_new_photos}


def count_gaussians(completion: Completion) -> dict[str, int]:
    """Count the Gaussians of the context, the added and, of a splat, the recoloured ones."""
    found = {"context": len(completion.context), "added": len(completion.added)}
    if completion.config.trust == "full":
        return found
    return found | {"recolored": int(completion.recolored_mask.sum())}


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
    renderer, views = completer.renderer, completion.views
    results = list(zip(targets, completion.targets, strict=True))
    seen = [(v.camera, v) for v in views] + [(r.target, t.view) for t, r in results]
    images = [render_before_after(completion, camera, view, renderer) for camera, view in seen]
    scores = map_in_parallel(BeforeAfter.compute_scores, images)
    unused = score_held_out(completion, held_out, renderer)
    write_scenes(folder, completion, input_splat)
    pictured = folder / "images"
    pictured.mkdir()
    write_images(pictured, paint_ignored(views))
    pairs = zip(completion.targets, images[len(views) :], strict=True)
    limits = [write_pictures(pictured, number, *pair) for number, pair in enumerate(pairs, start=1)]
    around = render_surroundings()
    shown = select_most_changed(around.views)
    write_images(pictured, name_surrounding_images(shown))
    record = make_record(completion, limits, shown, around.photographs)
    (folder / RECORD_FILE).write_text(
        json.dumps(record, default=vars, separators=(",", ":")) + "\n"
    )
    coverage = {"coverage": asdict(compute_coverage(around.views))} if around.views else {}
    summary = {"version": __version__, **run_info, **coverage, "held_out": unused}
    summary |= build_summary(completion, targets, scores)
    (folder / SUMMARY_FILE).write_text(json.dumps(summary, indent=2) + "\n")
    return summary


def make_record(
    completion: Completion,
    limits: Sequence[Limits | None],
    around: Sequence[RenderPair],
    photographs: Sequence[Camera],
) -> CompletionRecord:
    """Collect the data of a completion."""
    shown = thin_evenly(photographs, MAX_PHOTOGRAPHS)
    return CompletionRecord(
        context=tuple(make_pose(view.camera) for view in completion.views),
        photographs=tuple(make_pose(camera) for camera in shown),
        num_photographs=len(photographs),
        targets=tuple(map(make_target_record, completion.targets, limits)),
        around=tuple(compute_coverage([look]) for look in around),
        scene_points=sample_points(completion.context),
        added_points=sample_points(completion.added),
    )


def make_target_record(result: TargetResult, limits: Limits | None) -> TargetRecord:
    """Collect the data of a target."""
    losses = {name: round_values(torch.tensor(values)) for name, values in result.losses.items()}
    compared = result.affine.pairs
    pairs = make_pairs(compared) if len(compared.predicted) else None
    return TargetRecord(make_pose(result.target), limits, losses, pairs)


def make_pairs(pairs: DepthPairs) -> PairsRow:
    """Round depth pairs."""
    predicted, context = round_values(pairs.predicted), round_values(pairs.context)
    return PairsRow(pairs.fit_view, predicted, context, tuple(pairs.inlier_mask.tolist()))


def make_pose(camera: Camera) -> PoseRow:
    """Convert a camera to its pose and field of view."""
    a, b, c = camera.c2w[:3]
    wide, high = camera.width / 2 / camera.K[0, 0].item(), camera.height / 2 / camera.K[1, 1].item()
    return PoseRow((round_values(a), round_values(b), round_values(c)), (wide, high))


def sample_points(gaussians: Gaussians) -> tuple[Vector, ...]:
    """Sample means of opaque Gaussians, in the frame of the .ply."""
    opaque = gaussians.means[gaussians.opacities >= MIN_SURFACE_OPACITY]
    order = torch.randperm(len(opaque), generator=torch.Generator().manual_seed(0))
    return tuple(map(round_values, opaque[order[:MAX_POINTS].to(opaque.device)].cpu()))


def select_most_changed(looks: Sequence[RenderPair]) -> list[RenderPair]:
    """Select the views whose images changed most, in descending order."""
    changes = [(look.after.image - look.before.image).abs().mean().item() for look in looks]
    order = sorted(range(len(looks)), key=changes.__getitem__, reverse=True)
    return [looks[i] for i in order[:MAX_SURROUNDING_VIEWS] if changes[i] >= MIN_COLOR_CHANGE]


def thin_evenly(items: Sequence[Camera], most: int) -> Sequence[Camera]:
    """Take every n-th item so that at most `most` are left."""
    return items[:: max(1, -(-len(items) // most))]


def round_values(values: Tensor) -> tuple[Any, ...]:
    """Round numbers [n] to six significant digits."""
    return tuple(float(f"{value:.6g}") for value in values.detach().cpu().double().tolist())


def write_scenes(folder: Path, completion: Completion, input_splat: InputSplatFile | None) -> None:
    """Write the three scenes, and the originals of recoloured Gaussians of an input splat."""
    added, context = completion.added, completion.context
    if input_splat is None:
        completed = partial(save_ply, folder / COMPLETED_FILE, completion.scene, provenance=True)
    else:
        context, changed = restore_file_order(completion, input_splat)
        recolored = completion.recolored_context[completion.recolored_mask]
        generated = merge([recolored, added])
        completed = partial(save_completed_splat, folder, context, changed, generated, input_splat)
    writing = [
        completed,
        partial(save_ply, folder / CONTEXT_FILE, context),
        partial(save_ply, folder / GENERATED_FILE, added, provenance=True),
    ]
    map_in_parallel(lambda write: write(), writing)


def restore_file_order(
    completion: Completion, input_splat: InputSplatFile
) -> tuple[Gaussians, Bool[Tensor, "n"]]:
    """Sort the context and the mask of recoloured Gaussians in the order of the input file."""
    context, changed = completion.context, completion.recolored_mask
    if input_splat.file_order is None:
        return context, changed
    places = input_splat.file_order.argsort().to(context.means.device)
    return context[places], changed[places]


def save_completed_splat(
    folder: Path,
    context: Gaussians,
    changed: Bool[Tensor, "n"],
    generated: Gaussians,
    input_splat: InputSplatFile,
) -> None:
    """Write `completed.ply` in the layout of the input splat, and the originals of the changed.

    Recoloured Gaussians stand among the generated ones, after all that kept its bits. The originals
    of an earlier run are kept with those that it recoloured.
    """
    kept, earlier = input_splat.context_mask, input_splat.path.with_name(REMOVED_FILE)
    if not changed.any():
        if bool((context.generated > 0).any()) and earlier.is_file():
            shutil.copyfile(earlier, folder / REMOVED_FILE)
        save_like(folder / COMPLETED_FILE, context, generated, input_splat.path, kept)
        return
    rows = torch.nonzero(changed.cpu())[:, 0]
    save_removed(folder / REMOVED_FILE, context[changed].to("cpu"), rows, input_splat.path, kept)
    stays = ~changed.cpu()
    if kept is not None:
        stays = torch.zeros_like(kept).masked_scatter(kept, stays)
    save_like(folder / COMPLETED_FILE, context[~changed], generated, input_splat.path, stays)


def write_pictures(
    folder: Path, number: int, result: TargetResult, images: BeforeAfter
) -> Limits | None:
    """Write the images of a target; return the limits of its depth colours."""
    alpha = result.trusted_alpha
    named = {
        "before": images.before.image,
        "after": images.after.image,
        "hole_mask": result.hole_mask.float(),
        "support": None if torch.equal(alpha, result.before.alpha) else alpha,
        "reference": None if result.reference is None else result.reference.image,
        "truth": None if images.photograph is None else images.photograph.image,
    }
    known = {f"target{number}_{name}": i for name, i in named.items() if i is not None}
    write_images(folder, known)
    depths = {"before": images.before.depth_map(), "after": images.after.depth_map()}
    limits = compute_depth_limits(list(depths.values()))
    if limits is not None:
        for when, depth in depths.items():
            write_depth_image(folder / f"target{number}_depth_{when}.png", depth, limits)
    return limits


def paint_ignored(views: Sequence[View]) -> dict[str, Float[Tensor, "h w 3"]]:
    """Paint over the ignored pixels of each photograph that has some."""
    return {
        f"context{number}_ignored": torch.where(
            view.ignore_mask[..., None], view.image.new_tensor(IGNORED_COLOR), view.image
        )
        for number, view in enumerate(views, start=1)
        if view.ignore_mask is not None
    }


def name_surrounding_images(looks: Sequence[RenderPair]) -> dict[str, Float[Tensor, "h w 3"]]:
    """Name the images of surrounding views."""
    named = {}
    for number, look in enumerate(looks, start=1):
        named[f"around{number}_before"] = look.before.image
        named[f"around{number}_after"] = look.after.image
    return named


def write_images(folder: Path, images: Mapping[str, Tensor]) -> None:
    """Write images by name in parallel: colour [h, w, 3], grey or masks [h, w]."""
    paths = [folder / f"{name}.png" for name in images]
    map_in_parallel(write_image, paths, images.values())


def join_images(
    pictures: Sequence[Float[Tensor, "h _w 3"]], gap: int = 4
) -> Float[Tensor, "h wide 3"]:
    """Join images of one height side by side on white."""
    white = torch.ones((pictures[0].shape[0], gap, 3))
    parts = [part for picture in pictures for part in (white, picture.cpu().clamp(0, 1))]
    return torch.cat(parts[1:], dim=1)

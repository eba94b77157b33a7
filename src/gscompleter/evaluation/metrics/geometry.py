"""Geometric agreement of generated Gaussians with the context: AbsRel, Chamfer, F-score.

The paper reports "the alignment error between the generated target primitives and the context
primitives" without formulas or thresholds. Ours can rank methods and ablations but are not
comparable with the numbers of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from gscompleter.numerics.geometry import project, project_mask, sample
from gscompleter.render.protocols import Renderer
from gscompleter.stages.filter_holes import select_in_mask
from gscompleter.types import Camera, DepthMap, Gaussians

MIN_SCORED_OPACITY = 1 / 255
"""Opacity below which renderers drop a Gaussian."""

MATCH_DISTANCE = 0.05
"""Largest distance of a match, and of a Gaussian of the context from the surface that the target
sees, as a share of the median context depth there. Ours: the paper names none."""


@dataclass(frozen=True)
class SurfaceAgreement:
    """Agreement of depths, and of Gaussians with the context, where both overlap.

    A figure is None where there is no overlap, or no Gaussian in it.
    """

    pixels: int
    """Number of the target's pixels in the overlap."""
    abs_rel: float | None = None
    """Mean of |z - D| / D, with z-depths z and those D that they are compared with."""
    chamfer: float | None = None
    """Mean distance to the nearest point of the other cloud, averaged over both directions, as a
    share of the median depth of the context at the target, for averages over scenes."""
    f_score: float | None = None
    """Harmonic mean of precision and recall at `MATCH_DISTANCE`, in [0, 1]."""


def compare_depths(
    depth: Float[Tensor, "h w"], truth: Float[Tensor, "h w"], where: Bool[Tensor, "h w"]
) -> SurfaceAgreement:
    """Compute mean(|depth - truth| / truth) over pixels of `where` with known truth; 0 is best.

    z-depths in scene units; the truth is 0 where it is unknown, and `depth` is known in `where`.
    No scale is fitted, because registration has to remove scale errors.
    """
    known = where & (truth > 0)
    if not known.any():
        return SurfaceAgreement(0)
    d = depth[known].double()
    t = truth[known].double()
    return SurfaceAgreement(int(known.sum()), ((d - t).abs() / t).mean().item())


def compute_f_score(
    a_to_b: Float[np.ndarray, "n"], b_to_a: Float[np.ndarray, "m"], threshold: float
) -> float:
    """Compute 2 P R / (P + R) of two point sets; 1 is best, and 0 if P = R = 0.

    `a_to_b` are distances of points of A to the nearest one of B, `b_to_a` the reverse, in scene
    units as `threshold`. Precision P is the share of A within it, recall R that of B.
    """
    precision = float((a_to_b <= threshold).mean())
    recall = float((b_to_a <= threshold).mean())
    total = precision + recall
    return 2 * precision * recall / total if total > 0 else 0.0


def compute_nearest_distances(
    points: Float[Tensor, "n 3"], others: Float[Tensor, "m 3"]
) -> Float[np.ndarray, "n"]:
    """Compute the Euclidean distance of each point to the nearest of `others`, in float64."""
    queries = points.detach().cpu().double().numpy()
    targets = others.detach().cpu().double().numpy()
    # Without balancing the tree stays fast if many points coincide.
    tree = cKDTree(targets, balanced_tree=False)
    # Cores beyond those of `--threads` belong to other processes.
    return tree.query(queries, workers=torch.get_num_threads())[0]


@torch.no_grad()
def measure_alignment(
    added: Gaussians, context: Gaussians, target: Camera, renderer: Renderer
) -> SurfaceAgreement:
    """Measure AbsRel, Chamfer distance and F-score of the added Gaussians against `context`.

    The overlap is the set of target pixels that both cover when rendered alone, the rim of the
    hole. AbsRel compares the two z-depths there. Cloud A has the means of added Gaussians in the
    overlap, matched with the whole context; cloud B has the means of visible context Gaussians in
    the overlap, matched with everything added. A perfect completion does not reach 0, because
    Gaussians are spaced and depths mix at edges: compare methods on the same cases.
    """
    added = drop_transparent(added)
    context = drop_transparent(context)
    # Each is rendered alone, so that neither hides the other.
    generated = renderer.render(added, target).depth_map()
    reference = renderer.render(context, target).depth_map()
    overlap = generated.valid & reference.valid
    error = compare_depths(generated.depth, reference.depth, overlap).abs_rel
    return compare_clouds(added, context, target, reference, overlap, error)


@torch.no_grad()
def measure_primitive_alignment(
    registered: Gaussians, context: Gaussians, target: Camera, renderer: Renderer
) -> SurfaceAgreement:
    """Measure as `measure_alignment`, but all registered Gaussians, before stage 4 filters them.

    They are not rendered: renders would favour scattered Gaussians, which cover fewer and easier
    pixels. A Gaussian counts if its mean projects to a pixel that the context covers; these pixels
    are the overlap. AbsRel is the mean of |z - D| / D with the z-depth z of the mean and the
    rendered context depth D.
    """
    registered = drop_transparent(registered)
    context = drop_transparent(context)
    reference = renderer.render(context, target).depth_map()

    # All means here are inside the image, so that their pixels can be looked up.
    points = registered[project_mask(reference.valid, registered, target)].means
    pixels, z = project(points, target)
    x, y = pixels.long().unbind(-1)
    overlap = torch.zeros_like(reference.valid)
    overlap[y, x] = True
    expected = reference.depth[y, x].double()
    # Without a Gaussian there is no mean, and no overlap either.
    error = ((z - expected).abs() / expected).mean().item() if len(points) else None
    return compare_clouds(registered, context, target, reference, overlap, error)


def compare_clouds(
    generated: Gaussians,
    context: Gaussians,
    target: Camera,
    reference: DepthMap,
    overlap: Bool[Tensor, "h w"],
    error: float | None,
) -> SurfaceAgreement:
    """Add Chamfer distance and F-score over `overlap` to the AbsRel `error`.

    `reference` is the depth of the context at the target, known in all of `overlap`. Only without
    an overlap is `error` None.
    """
    count = int(overlap.sum())
    if count == 0:
        return SurfaceAgreement(0)
    scale = reference.depth[reference.valid].double().median().item()
    threshold = MATCH_DISTANCE * scale
    points = select_in_mask(generated, None, overlap, target).means

    # Of the context only what the target sees: what lies behind its surface has no counterpart.
    surface = select_in_mask(context, None, overlap, target).means
    pixels, z = project(surface, target)
    at_pixel = sample(reference.depth[..., None], pixels, "nearest")[..., 0]
    surface = surface[(z - at_pixel).abs() <= threshold]
    if len(points) == 0 or len(surface) == 0:
        return SurfaceAgreement(count, error)
    there = compute_nearest_distances(points, context.means)
    back = compute_nearest_distances(surface, generated.means)
    # Distances are not squared, so that floaters do not dominate.
    chamfer = float(there.mean() + back.mean()) / 2 / scale
    return SurfaceAgreement(count, error, chamfer, compute_f_score(there, back, threshold))


def drop_transparent(gaussians: Gaussians) -> Gaussians:
    """Drop Gaussians that no renderer shows, since even their centres are too transparent."""
    return gaussians[gaussians.opacities >= MIN_SCORED_OPACITY]

"""How well generated geometry agrees with the context: AbsRel, Chamfer distance and F-score.

The paper reports the three as "the alignment error between the generated target primitives and
the context primitives" and gives neither formulas nor thresholds. Ours are below, each with its
reason, for two choices of the primitives: those that were added, and all that were lifted. They can
rank methods and ablations scored alike; they are not comparable with the numbers printed in the
paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.geometry import inside, project, sample
from gscompleter.render import Renderer
from gscompleter.stages.integration import falling_on, keep_in_holes
from gscompleter.types import Camera, DepthMap, Gaussians

MIN_OPACITY = 1 / 255
"""Gaussians of less opacity are dropped by every renderer: they are part of no surface."""

MATCHED = 0.05
"""Distance that counts as matched, as a share of the median context depth at the target.
Relative, so that scenes of any unit and size can be averaged; 5 % is wider than the spacing of the
primitives and well below the depth of a room."""


def abs_rel(
    depth: Float[Tensor, "h w"], truth: Float[Tensor, "h w"] | None, where: Bool[Tensor, "h w"]
) -> float | None:
    """Absolute relative error: mean(|depth - truth| / truth), without unit; 0 is best.

    Over the pixels of `where` with known (positive) truth; None where there is none. No scale
    is fitted beforehand: a wrong scale is one of the errors that registration has to remove.
    """
    if truth is None or not (known := where & (truth > 0)).any():
        return None
    d, t = depth[known].double(), truth[known].double()
    return ((d - t).abs() / t).mean().item()


def num_known(truth: Float[Tensor, "h w"] | None, where: Bool[Tensor, "h w"]) -> int | None:
    """Count the pixels of `where` with known (positive) truth; None where there is no truth."""
    return None if truth is None else int((where & (truth > 0)).sum())


@dataclass(frozen=True)
class CloudDistances:
    """Distance of each point of a cloud A to the nearest of a cloud B, and of each of B to A."""

    a_to_b: Float[np.ndarray, "n"]
    b_to_a: Float[np.ndarray, "m"]

    @property
    def chamfer(self) -> float:
        """(mean_a min_b |a - b| + mean_b min_a |a - b|) / 2, in scene units; 0 is best.

        Distances are not squared, so that a few floaters do not decide the number, and the two
        means are averaged rather than added, so that it reads as a length: a cloud moved along
        its normals by x has a Chamfer distance of x.
        """
        return float(self.a_to_b.mean() + self.b_to_a.mean()) / 2

    def f_score(self, threshold: float) -> float:
        """2 P R / (P + R), in [0, 1]; 1 is best, and 0 where P = R = 0.

        The precision P is the share of A within `threshold` (scene units) of B, the recall R
        the share of B within `threshold` of A.
        """
        precision = float((self.a_to_b <= threshold).mean())
        recall = float((self.b_to_a <= threshold).mean())
        total = precision + recall
        return 2 * precision * recall / total if total > 0 else 0.0


def cloud_distances(a: Float[Tensor, "n 3"], b: Float[Tensor, "m 3"]) -> CloudDistances:
    """Exact nearest-neighbour distances between two point sets, both ways, as by `nearest`."""
    return CloudDistances(nearest(a, b), nearest(b, a))


def nearest(points: Float[Tensor, "n 3"], others: Float[Tensor, "m 3"]) -> Float[np.ndarray, "n"]:
    """Euclidean distance of each point to the nearest of `others`, in float64.

    A k-d tree: n log m, which a million points on both sides do not mind. Each query stands for
    itself, so the number of threads cannot change a result. Splitting at the middle of a cell
    instead of at the median keeps the tree fast where many points coincide.

    Raises:
        InputError: where a set is empty or holds a point that is not finite.
    """
    if len(points) == 0 or len(others) == 0:
        raise InputError(
            "Distances between point sets need points on both sides, "
            f"got {len(points)} and {len(others)}."
        )
    queries, targets = (p.detach().cpu().double().numpy() for p in (points, others))
    if not (np.isfinite(queries).all() and np.isfinite(targets).all()):
        raise InputError("Distances between point sets need finite points; some are not.")
    distances, _ = cKDTree(targets, balanced_tree=False).query(queries, workers=-1)
    return np.asarray(distances, dtype=np.float64)


@dataclass(frozen=True)
class Alignment:
    """How generated primitives agree with the context where the two overlap. None: nowhere."""

    overlap: float
    """Share of the target's pixels that belong to both."""
    pixels: int
    """Number of these pixels."""
    scale: float | None
    """Median z-depth of the context at the target, in scene units."""
    abs_rel: float | None
    """Relative error of the generated z-depth against the context's, in the overlap."""
    chamfer: float | None
    """In scene units."""
    f_score: float | None

    @property
    def relative_chamfer(self) -> float | None:
        """The Chamfer distance as a share of `scale`, to average over scenes."""
        return self.chamfer / self.scale if self.chamfer is not None and self.scale else None


@torch.no_grad()
def alignment(
    added: Gaussians, context: Gaussians, target: Camera, renderer: Renderer
) -> Alignment:
    """Measure AbsRel, Chamfer distance and F-score between what one target added and the context.

    Completion adds primitives in the dilated hole only, so the two meet at its rim. The overlap
    is made of the target's pixels that each covers when it is rendered alone.

    - AbsRel compares the two rendered z-depths there; the context's is the reference.
    - A point of the first cloud is the mean of an added Gaussian that projects into the overlap.
      It is matched with all of the context.
    - A point of the second cloud is the mean of a context Gaussian that projects into the
      overlap and lies on the surface seen from the target, within the threshold; what the
      surface hides was never to be reproduced. It is matched with all that was added.

    The overlap thus restricts which points are judged, not what they may be matched with: the
    border of the overlap adds no error of its own, and Gaussians that coincide score 0. A true
    completion made of other Gaussians does not quite: primitives are spaced, and where the hole
    borders on a depth edge each render mixes two depths. Compare methods on the same cases, in
    which this floor is the same.

    Args:
        added: What completion added for one target.
        context: The scene as it was before, usually `Completion.context`.
        target: The camera it was completed for.
        renderer: Draws both.
    """
    added, context = drawable(added), drawable(context)
    generated = renderer.render(added, target).depth_map()
    reference = renderer.render(context, target).depth_map()
    overlap = generated.valid & reference.valid
    error = abs_rel(generated.depth, reference.depth, overlap)
    return compare_clouds(added, context, target, reference, overlap, error)


@torch.no_grad()
def primitive_alignment(
    registered: Gaussians, context: Gaussians, target: Camera, renderer: Renderer
) -> Alignment:
    """Measure the same for all that was registered for one target, primitive by primitive.

    Nothing is filtered by holes, so most primitives lie where the context shows a surface. They
    are not rendered: primitives that are scattered cover fewer pixels than those that are not, and
    would be measured over the easier ones. A primitive counts whose mean projects to a pixel of
    the target that the context covers; the overlap is made of these pixels.

    - AbsRel is the mean over these primitives of |z - D| / D, with z the z-depth of the mean and D
      that of the context, rendered alone, at its pixel.
    - Chamfer distance and F-score are those of `alignment` with this overlap.

    Args:
        registered: All that was lifted for one target, where registration put it.
        context: The scene as it was before.
        target: The camera it was completed for.
        renderer: Draws the context.
    """
    registered, context = drawable(registered), drawable(context)
    reference = renderer.render(context, target).depth_map()
    judged = registered[falling_on(reference.valid, registered, target)].means
    pixels, z = project(judged, target)
    x, y = pixels.long().unbind(-1)
    overlap = torch.zeros_like(reference.valid)
    overlap[y, x] = True
    expected = reference.depth[y, x].double()
    error = ((z - expected).abs() / expected).mean().item() if len(judged) else None
    return compare_clouds(registered, context, target, reference, overlap, error)


def compare_clouds(
    generated: Gaussians,
    context: Gaussians,
    target: Camera,
    reference: DepthMap,
    overlap: Bool[Tensor, "h w"],
    error: float | None,
) -> Alignment:
    """Add Chamfer distance and F-score over `overlap` to the AbsRel `error`.

    Args:
        generated: The first cloud.
        context: The second cloud.
        target: The camera of `reference` and `overlap`.
        reference: The depth of the context, rendered alone.
        overlap: The pixels in which points are judged.
        error: AbsRel over the overlap.
    """
    share, count = overlap.double().mean().item(), int(overlap.sum())
    if count == 0:
        return Alignment(share, count, None, None, None, None)
    scale = reference.depth[reference.valid].double().median().item()
    threshold = MATCHED * scale
    judged = keep_in_holes(generated, None, overlap, target).means
    surface = keep_in_holes(context, None, overlap, target).means
    surface = surface[on_surface(surface, reference.depth, target, threshold)]
    if len(judged) == 0 or len(surface) == 0:
        return Alignment(share, count, scale, error, None, None)
    distances = CloudDistances(nearest(judged, context.means), nearest(surface, generated.means))
    f_score = distances.f_score(threshold)
    return Alignment(share, count, scale, error, distances.chamfer, f_score)


def drawable(gaussians: Gaussians) -> Gaussians:
    """Select the Gaussians that a renderer draws."""
    return gaussians[gaussians.opacities >= MIN_OPACITY]


def on_surface(
    points: Float[Tensor, "n 3"], depth: Float[Tensor, "h w"], camera: Camera, tolerance: float
) -> Bool[Tensor, "n"]:
    """Points whose z-depth is that of their pixel, within `tolerance` in scene units."""
    pixels, z = project(points, camera)
    at_pixel = sample(depth[..., None], pixels, "nearest")[..., 0]
    return inside(pixels, z, camera) & ((z - at_pixel).abs() <= tolerance)

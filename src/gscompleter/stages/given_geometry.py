"""Depth of geometry from elsewhere where photographs measure none (not in the paper).

A scan or a mesh knows what is behind the chair. It is a measurement of others, in a frame that may
be another one, so it is believed only as far as it agrees with what the scene shows: as a whole at
the photographs, and around each hole at the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import CompleterConfig
from gscompleter.numerics.given_geometry import (
    FRAME_ADVICE,
    MAX_DEVIATION,
    MIN_COMPARED,
    GivenGeometry,
)
from gscompleter.numerics.image_ops import fill_smoothly, smooth_masked
from gscompleter.reconstructors.features.depth_factor import (
    compare_with_matches,
    fit_depth_factor,
)
from gscompleter.stages.synthesize import GeneratedView
from gscompleter.stages.target_view import TargetView
from gscompleter.system.errors import InputError
from gscompleter.system.tensor_checks import describe
from gscompleter.target_result import GeometryUse
from gscompleter.types import DepthMap, View

MIN_AGREEING = 0.5
"""Smallest share of the compared pixels around one that has to agree."""
COMPARED_AROUND = 1 / 64
"""Half the side of that neighbourhood, relative to the longer side of the image. At the edges of
surfaces a render mixes the depth of two, and agrees with neither."""


class ContradictedError(InputError):
    """Geometry is not what the photographs show, where it stands."""


def check_geometry(geometry: object, config: CompleterConfig) -> None:
    """Raise InputError for a value that is no geometry, or if the config can use none."""
    if not isinstance(geometry, GivenGeometry):
        raise InputError(
            f"The geometry has to be what gsc.load_geometry returns, and is {describe(geometry)}.",
            "geometry",
        )
    if config.registration_method == "paper":
        raise InputError(
            "The paper's registration takes no geometry from elsewhere; leave the geometry or the "
            "config of the paper out.",
            "geometry",
        )


def give_photographs_depth(
    geometry: GivenGeometry, views: Sequence[View], surfaces: Sequence[DepthMap]
) -> tuple[View, ...]:
    """Give photographs of a scene the depth of geometry, where it agrees with what is around.

    `surfaces` are those of the scene at the photographs, without the sky. Photographs that have a
    measured depth keep that.
    """
    given = []
    for view, surface in zip(views, surfaces, strict=True):
        if view.depth is None and len(view.known_depths) == 0:
            fit = fit_to_surface(geometry.draw_depth(view.camera), surface)
            view = replace(view, given_depth=fit.depth.where(view.valid_mask, 0.0))
        given.append(view)
    return tuple(given)


def give_depth_before_scene(
    geometry: GivenGeometry, views: Sequence[View]
) -> tuple[list[View], tuple[str, ...]]:
    """Give photographs the depth of geometry before a scene is made of them; also return notes.

    Raises ContradictedError if the geometry covers hardly anything that they show, or if the depth
    that they measure by their matches contradicts it.
    """
    drawn = [geometry.draw_depth(view.camera) for view in views]
    num_pixels = sum(depth.numel() for depth in drawn)
    num_drawn = sum(int((depth > 0).sum()) for depth in drawn)
    if num_drawn < MIN_COMPARED * num_pixels:
        raise ContradictedError(
            f"{geometry.name} covers hardly anything that the photographs show ({num_drawn:,} of "
            f"{num_pixels:,} pixels), so that nothing tells whether they belong together; "
            f"{FRAME_ADVICE}.",
            "geometry",
        )
    given = []
    for view, depth in zip(views, drawn, strict=True):
        if view.depth is None and len(view.known_depths) == 0:
            view = replace(view, given_depth=depth.where(view.valid_mask, 0.0))
        given.append(view)

    samples = compare_with_matches(
        [view.to("cpu") for view in views], [depth.cpu() for depth in drawn]
    )
    fit = fit_depth_factor(samples)
    if fit is None:
        note = f"The photographs show too little to compare {geometry.name} with; it is used as "
        return given, (f"{note}it is.",)
    # As every given depth is tested (`fit_depth_factor`): the factor is exactly 1 within the errors
    # of poses.
    if not fit.is_consistent or fit.factor != 1.0:
        scale = f" by a factor of {1 / fit.factor:.3g}" if fit.is_consistent else ""
        raise ContradictedError(
            f"The depth of {geometry.name} differs{scale} from what the photographs measure at "
            f"{len(samples):,} compared pixels ({fit.agreement:.0%} agree"
            f"{' with that factor' if scale else ''}); {FRAME_ADVICE}.",
            "geometry",
        )
    return given, ()


def require_uncontradicted(
    geometry: GivenGeometry,
    views: Sequence[View],
    given: Sequence[View],
    used: Sequence[View],
) -> None:
    """Raise ContradictedError if Ψ left out the depth of geometry in half the photographs, or more.

    `views` are the photographs as they came, some of which have a depth of their own, `given` those
    with the depth of geometry, and `used` those of which the scene was made. In these the depth is
    missing where stereo contradicts it. All are in the same order.
    """
    of_geometry = [
        after
        for before, with_depth, after in zip(views, given, used, strict=True)
        if before.given_depth is None and with_depth.given_depth is not None
    ]
    num_given = len(of_geometry)
    num_dropped = sum(view.given_depth is None for view in of_geometry)
    if num_given and 2 * num_dropped >= num_given:
        raise ContradictedError(
            f"The surfaces of {geometry.name} contradict what stereo measures in {num_dropped} of "
            f"{num_given} photographs; {FRAME_ADVICE}.",
            "geometry",
        )


@dataclass(frozen=True)
class FittedDepth:
    """Depth of geometry at a camera, fitted to the surfaces that the scene shows there."""

    depth: Float[Tensor, "h w"]
    """z-depth in scene units; 0 where there is none, or where it is not believed."""
    contradicted: Bool[Tensor, "h w"]
    """True where geometry is not believed."""


def fit_to_surface(drawn: Float[Tensor, "h w"], surface: DepthMap) -> FittedDepth:
    """Drop the depth of geometry where it disagrees with the scene around, and bend the rest to it.

    So no step is left at the border of a hole by a deviation that counts as the same surface.
    `drawn` is the z-depth of the geometry (`GivenGeometry.draw_depth`), and `surface` that of the
    scene at the same camera.
    """
    is_there = drawn > 0
    compared = is_there & surface.valid
    if not compared.any():
        # Nothing tells here; over all photographs the geometry was found to be what they show.
        return FittedDepth(drawn, torch.zeros_like(is_there))

    # In logarithms, in which a factor and its inverse are as far from none.
    log_ratio = torch.where(compared, surface.depth / drawn, 1.0).clamp_min(1e-6).log()
    agrees = compared & (log_ratio.abs().expm1() <= MAX_DEVIATION)

    # Where nothing is compared, as in a hole, the compared pixels around it decide.
    radius = max(1, round(COMPARED_AROUND * max(drawn.shape)))
    share = smooth_masked(agrees.to(drawn)[..., None], compared, radius)[..., 0]
    agreement = fill_smoothly(share, compared)
    believed = is_there & (agreement >= MIN_AGREEING)

    # The small deviations of the pixels that agree are continued in the same way.
    bent = drawn * fill_smoothly(log_ratio, agrees).exp()
    return FittedDepth(bent.where(believed, 0.0), is_there & ~believed)


def add_geometry_depth(image: GeneratedView, view: TargetView) -> tuple[GeneratedView, GeometryUse]:
    """Give the synthesized image the depth of the geometry where the scene shows nothing."""
    geometry = view.state.geometry
    if geometry is None:
        return image, GeometryUse()
    camera = view.camera.padded
    # A faint surface in a hole is what is to be replaced, and proves nothing.
    seen = replace(view.surfaces, valid=view.surfaces.valid & ~view.holes)
    fit = fit_to_surface(geometry.draw_depth(camera), seen)
    num_holes = int(view.holes.sum().clamp_min(1))
    use = GeometryUse(
        geometry.name,
        share=int((view.holes & (fit.depth > 0)).sum()) / num_holes,
        contradicted=int((view.holes & fit.contradicted).sum()) / num_holes,
    )
    return replace(image, given_depth=fit.depth.where(~seen.valid, 0.0)), use

"""Photographs with the depth that a scene holds, in the unit of its cameras."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from gscompleter.data.given_depth import drop_unsure, give_depth, project_tracks
from gscompleter.data.photographs import Photographs, Resolution
from gscompleter.reconstructors.features.depth_factor import (
    MIN_SAMPLES,
    DepthSamples,
    compare_maps,
    compare_with_matches,
    fit_depth_factor,
    join_samples,
)
from gscompleter.system.errors import InputError
from gscompleter.types import View

WAY_OUT = "--no-given-depth leaves it out"


def read_with_depth(
    photographs: Photographs, frames: Sequence[int], resolution: Resolution = None
) -> tuple[list[View], tuple[str, ...]]:
    """Load photographs with their given depth in scene units, and say how its unit was found.

    Raises InputError if it contradicts what the photographs and the points of the scene measure.
    """
    views = photographs.views(frames, resolution)
    factor = 1.0
    note = ""
    if any(view.depth is not None for view in views):
        factor, note = find_factor(photographs, frames, views, resolution)

    views_with_depth = []
    for view, frame in zip(views, frames, strict=True):
        if view.depth is not None and factor != 1.0:
            view = replace(view, depth=view.depth * factor)
        # Given depth takes the place of stereo in the reconstruction (decision 046).
        view = give_depth(view, photographs.frame(frame), photographs.origin)
        views_with_depth.append(view)
    return views_with_depth, (note,) if note else ()


def find_factor(
    photographs: Photographs,
    frames: Sequence[int],
    views: Sequence[View],
    resolution: Resolution,
) -> tuple[float, str]:
    """Find the factor from the measured depth to scene units, and the sentence about it, or none.

    The photographs after those of the context take part if these alone tell too little: if they are
    far apart, or if there is only one.
    """
    samples = compare_given_depth(photographs, frames, views)
    if len(samples) < MIN_SAMPLES:
        last = len(photographs) - 1
        next_frames = {min(frame + 1, last) for frame in frames} - set(frames)
        more: dict[int, View] = {}
        for frame in sorted(next_frames):
            # One that cannot be read is left out: it is only wanted for this comparison.
            with suppress(InputError):
                (more[frame],) = photographs.views([frame], resolution)
        samples = compare_given_depth(photographs, [*frames, *more], [*views, *more.values()])

    fit = fit_depth_factor(samples)
    # Too few samples prove nothing, so the depth is believed. Many that contradict it are an error:
    # no factor can be right.
    if fit is None:
        return 1.0, (
            "The photographs show too little to compare the depth that the scene holds with; it is "
            f"used as it is, in the unit of the cameras ({WAY_OUT})."
        )
    if not fit.is_consistent:
        raise InputError(describe_contradiction(samples))
    if fit.factor == 1.0:
        return 1.0, ""
    return fit.factor, (
        f"The depth that the scene holds is {1 / fit.factor:.3g} times what its photographs and "
        f"points measure ({fit.agreement:.0%} of {len(samples):,} compared depths agree); it is "
        f"multiplied by {fit.factor:.4g} ({WAY_OUT})."
    )


def compare_given_depth(
    photographs: Photographs, frames: Sequence[int], views: Sequence[View]
) -> DepthSamples:
    """Compare the measured depths of photographs with their tracks or points, and with matches."""
    points = photographs.points()
    samples = []
    depths = []
    for number, view in enumerate(views):
        frame = photographs.frame(frames[number])

        # 0 where nothing is measured, and at edges, where the sensor and the photograph may see
        # two surfaces.
        depth = torch.zeros_like(view.image[..., 0])
        if view.depth is not None:
            depth = drop_unsure(view.depth, frame)
        depths.append(depth)

        # Tracks and points were triangulated with the cameras, and so are in their unit.
        tracks = project_tracks(frame, view, photographs.origin, points)
        samples.append(compare_maps(depth, tracks, number))

    # Matches between the photographs measure the unit, too, if the scene has no points.
    return join_samples([*samples, compare_with_matches(views, depths)])


def describe_contradiction(samples: DepthSamples) -> str:
    """Write the error for depths that no factor explains, with both ranges."""
    held = describe_range(samples.given)
    measured = describe_range(samples.measured)
    return (
        f"The depth that the scene holds ({held} at {len(samples):,} compared pixels) contradicts "
        f"what its photographs and points measure there ({measured}), and no single factor "
        "explains it; give z-depth in one unit for all photographs, or leave it out with "
        "--no-given-depth."
    )


def describe_range(depths: Float[np.ndarray, "n"]) -> str:
    """Write the range of depths without the outermost 2 % on both sides."""
    low, high = np.quantile(depths, [0.02, 0.98])
    return f"{low:.3g} to {high:.3g}"

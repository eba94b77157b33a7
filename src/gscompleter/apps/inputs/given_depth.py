"""Photographs with the depth that a scene holds, in the unit of its cameras."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.data.given_depth import drop_unsure, give_depth, project_tracks
from gscompleter.data.photographs import Photographs, Resolution
from gscompleter.reconstructors.features.depth_factor import (
    MIN_OWN_SAMPLES,
    MIN_SAMPLES,
    DepthSamples,
    compare_maps,
    compare_with_matches,
    fit_depth_factor,
    join_samples,
)
from gscompleter.system.errors import InputError, format_rounded, join_names, quote_value
from gscompleter.types import View

WAY_OUT = "--no-given-depth leaves it out"
"""What a user can do about the depth, for sentences."""
MAX_DEPTH_DEVIATION = 0.03
"""Largest median deviation of predicted depth from triangulated points that counts as measured.
Stereo of photographs is about as exact, so that a worse map only helps where stereo measures
nothing (decision 088)."""
MAX_OFF_PHOTOGRAPHS = 3
"""Photographs that a sentence names."""
RANGE_QUANTILES = (0.02, 0.98)
"""Quantiles of depths that a sentence names as their range: single matches are false."""


@dataclass(frozen=True)
class PredictedDepth:
    """Predicted depth of photographs by frame, sorted by how it agrees with points and matches.

    It is z-depth in scene units as far as its file tells, 0 where unknown.
    """

    agreeing: Mapping[int, Float[Tensor, "h w"]]
    """Depth that is used as if it were measured."""
    others: Mapping[int, Float[Tensor, "h w"]]
    """Depth that only supports stereo."""
    deviations: Mapping[int, float]
    """Median relative deviation; photographs with too few points to tell have none."""

    def describe(self, photographs: Photographs) -> tuple[str, ...]:
        """Say how the depth of which photographs is used."""

        def name(frames: Mapping[int, object]) -> str:
            files = [photographs.frame(frame).file_name for frame in frames]
            return join_names([quote_value(file) for file in files], MAX_OFF_PHOTOGRAPHS)

        def format_worst(frames: Mapping[int, object]) -> str:
            return f"{100 * max(self.deviations.get(frame, 0.0) for frame in frames):.1f} %"

        notes = []
        if self.agreeing:
            notes.append(
                f"The inverse depth of {name(self.agreeing)} agrees with the points of the scene "
                f"to {format_worst(self.agreeing)}, and is used as its depth ({WAY_OUT})."
            )
        far = {frame: None for frame in self.others if frame in self.deviations}
        untold = {frame: None for frame in self.others if frame not in self.deviations}
        for frames, reason in (
            (far, f"deviates by up to {format_worst(far) if far else ''} from the points"),
            (untold, "cannot be compared, because the photographs show too few points"),
        ):
            if frames:
                notes.append(
                    f"The inverse depth of {name(frames)} {reason}, and is used only where stereo "
                    f"measures nothing ({WAY_OUT})."
                )
        return tuple(notes)


@dataclass(frozen=True)
class DepthReading:
    """Photographs with the depth that the scene holds of them."""

    views: Sequence[View]
    """Photographs of the context, whose `given_depth` has the measured depth in scene units."""
    notes: tuple[str, ...] = ()
    """Sentences about the unit of the depth and its use."""
    predicted: Mapping[int, Float[Tensor, "h w"]] = field(default_factory=dict)
    """Predicted z-depth in scene units by frame, 0 where unknown, that only supports stereo."""


def read_with_depth(
    photographs: Photographs,
    frames: Sequence[int],
    resolution: Resolution = None,
    scoring: Collection[int | None] = (),
) -> DepthReading:
    """Load the photographs of `frames` with their given depth, and say how its unit was found.

    Depth that a network predicted counts as measured only in photographs where it agrees with what
    they measure. The frames of `scoring` are never read: their photographs score the result.

    Raises:
        InputError: A photograph cannot be read, or no factor from measured depth to scene units
            explains what the photographs and the points of the scene measure.
    """
    views = photographs.views(frames, resolution)
    factor = 1.0
    note = ""
    if any(view.depth is not None for view in views):
        factor, note = find_factor(photographs, frames, views, resolution, scoring)
    predicted = sort_predicted(photographs, frames, views)

    views_with_depth = []
    for view, frame in zip(views, frames, strict=True):
        if view.depth is not None and factor != 1.0:
            view = replace(view, depth=view.depth * factor)
        # Given depth takes the place of stereo in the reconstruction (decision 046). Predicted
        # depth is there for photographs without a measured one.
        view = replace(view, depth=predicted.agreeing.get(frame, view.depth))
        view = give_depth(view, photographs.frame(frame), photographs.origin)
        views_with_depth.append(view)
    notes = (*((note,) if note else ()), *predicted.describe(photographs))
    return DepthReading(views_with_depth, notes, predicted.others)


def sort_predicted(
    photographs: Photographs, frames: Sequence[int], views: Sequence[View]
) -> PredictedDepth:
    """Load predicted depth of photographs without measured depth, and compare it.

    It is compared with what tracks, points and matches measure in the same photograph.
    """
    maps = {}
    for frame, view in zip(frames, views, strict=True):
        depth = None if view.depth is not None else photographs.load_predicted_depth(view)
        if depth is not None:
            maps[frame] = depth
    if not maps:
        return PredictedDepth({}, {}, {})

    shown = [
        replace(view, depth=maps.get(frame)) for frame, view in zip(frames, views, strict=True)
    ]
    samples = compare_given_depth(photographs, frames, shown)
    deviations = {}
    for number, frame in enumerate(frames):
        own = samples.select(number)
        if frame in maps and len(own) >= MIN_OWN_SAMPLES:
            ratios = np.log(own.measured) - np.log(own.given)
            deviations[frame] = float(np.expm1(np.median(np.abs(ratios))))
    agreeing = {
        frame: depth
        for frame, depth in maps.items()
        if deviations.get(frame, np.inf) <= MAX_DEPTH_DEVIATION
    }
    others = {frame: depth for frame, depth in maps.items() if frame not in agreeing}
    return PredictedDepth(agreeing, others, deviations)


def find_factor(
    photographs: Photographs,
    frames: Sequence[int],
    views: Sequence[View],
    resolution: Resolution,
    scoring: Collection[int | None],
) -> tuple[float, str]:
    """Find the factor from measured depth to scene units, and the sentence about it.

    The sentence is empty if the depth is in scene units already. Photographs beside those of the
    context take part if these alone tell too little: if they are far apart, or if there is only
    one. Raises InputError if no factor explains what is compared.
    """
    samples = compare_given_depth(photographs, frames, views)
    if len(samples) < MIN_SAMPLES:
        more: dict[int, View] = {}
        for frame in list_frames_beside(frames, len(photographs), scoring):
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


def list_frames_beside(
    frames: Sequence[int], count: int, scoring: Collection[int | None]
) -> list[int]:
    """List the nearest other frame of each of `frames` that is not followed by one of them.

    Frames are numbered from 0 to `count` - 1; of two that are equally near it is the later one.
    Those of `scoring` are left out even here: the factor decides where the result stands, so it
    must not depend on the photographs that score it.
    """
    free = [frame for frame in range(count) if frame not in {*frames, *scoring}]
    ends = [frame for frame in frames if frame + 1 not in frames]
    if not free:
        return []
    return sorted({min(free, key=lambda one: (abs(one - end), one < end)) for end in ends})


def compare_given_depth(
    photographs: Photographs, frames: Sequence[int], views: Sequence[View]
) -> DepthSamples:
    """Compare the depths of photographs with their tracks or points, and with their matches.

    Compared is `depth` of each of `views`, which are the photographs of `frames`.
    """
    points = photographs.points()
    samples = []
    depths = []
    for number, (frame_number, view) in enumerate(zip(frames, views, strict=True)):
        frame = photographs.frame(frame_number)

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
    low, high = np.quantile(depths, RANGE_QUANTILES)
    return f"{format_rounded(low)} to {format_rounded(high)}"

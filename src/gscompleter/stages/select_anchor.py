"""Stage 2: synthesize, select the stereo anchor, lift the pair (paper, Sec. III-D)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.config import AnchorConfig
from gscompleter.generators import (
    Generator,
    GeneratorOutput,
    GeneratorRequest,
    ImageFunction,
    as_generator,
)
from gscompleter.geometry import (
    is_inside,
    measure_baseline,
    measure_rotation,
    project,
    sample,
    unproject,
)
from gscompleter.reconstructors import Reconstructor, run_reconstructor
from gscompleter.types import (
    Camera,
    GeneratorInput,
    Lift,
    Render,
    View,
)

SURFACE_TOLERANCE = 0.1
"""Tolerated distance behind the anchor's depth map, relative to depth, for the same surface."""


@dataclass(frozen=True)
class AnchorChoice:
    """The context view that forms the stereo pair with the target."""

    index: int
    fallback: bool
    """True if every view exceeded the rotation limit, so that the smallest rotation won."""


def find_nearest_view(target: Camera, views: Sequence[View]) -> int:
    """Return the index of the view closest to `target`; a tie goes to the smaller rotation."""

    def remoteness(index: int) -> tuple[float, float]:
        camera = views[index].camera
        return measure_baseline(target, camera), measure_rotation(target, camera)

    return min(range(len(views)), key=remoteness)


def select_anchor(
    target: Camera,
    views: Sequence[View],
    config: AnchorConfig = AnchorConfig(),
    overlaps: Sequence[float] | None = None,
) -> AnchorChoice:
    """Choose the context view that makes the best stereo pair with `target` (paper, Fig. 3).

    Among views rotated by less than `max_rotation`, the widest baseline wins, since it triangulates
    best; if none qualifies, the smallest rotation wins. Beyond the paper, a view needs
    `min_baseline` and `min_overlap` (fraction of the target's visible surfaces) unless no view has
    them.
    """
    if not views:
        raise ValueError("select_anchor needs at least one observed view, got none")
    if config.selection == "nearest":
        return AnchorChoice(find_nearest_view(target, views), fallback=False)

    rotations = [measure_rotation(target, view.camera) for view in views]
    baselines = [measure_baseline(target, view.camera) for view in views]
    least = config.min_baseline * max(baselines)
    possible = [i for i in range(len(views)) if baselines[i] >= least]
    overlapping = [i for i in possible if rotations[i] < config.max_rotation]
    if not overlapping:
        return AnchorChoice(min(possible, key=rotations.__getitem__), fallback=True)
    if overlaps is None:
        return AnchorChoice(max(overlapping, key=baselines.__getitem__), fallback=False)
    enough = [i for i in overlapping if overlaps[i] >= config.min_overlap]
    if not enough:
        return AnchorChoice(max(overlapping, key=overlaps.__getitem__), fallback=False)
    return AnchorChoice(max(enough, key=baselines.__getitem__), fallback=False)


@dataclass(frozen=True)
class GeneratedView(View):
    """The image synthesized at the target, with the notes of its generator."""

    notes: tuple[str, ...] = ()
    """One sentence each, for the results."""
    is_inconsistent: bool = False
    """True if the image is photometrically inconsistent with the photographs."""


def synthesize(
    generator: Generator | ImageFunction, target: Camera, context: GeneratorInput
) -> GeneratedView:
    """Synthesize `Ĩ_t = Φ(I_n, P_t)`, conditioned on the nearest view (paper, Eq. 6)."""
    return synthesize_all(generator, [(target, context)])[0]


def synthesize_all(
    generator: Generator | ImageFunction, inputs: Sequence[tuple[Camera, GeneratorInput]]
) -> list[GeneratedView]:
    """Synthesize the images of several targets in one call of Φ."""
    requests = [
        GeneratorRequest(context.views[find_nearest_view(target, context.views)], target, context)
        for target, context in inputs
    ]
    outputs = as_generator(generator).synthesize(requests)
    return [convert_output(output, r.target) for output, r in zip(outputs, requests, strict=True)]


def convert_output(output: GeneratorOutput, target: Camera) -> GeneratedView:
    """Convert the output of a generator to a view, after checking its size and values."""
    expected = (target.height, target.width, 3)
    if tuple(output.image.shape) != expected or not torch.isfinite(output.image).all():
        raise ValueError(
            f"the generator must return a finite image of shape {expected}, "
            f"got {tuple(output.image.shape)}"
        )
    return GeneratedView(
        output.image, target, notes=output.notes, is_inconsistent=output.is_inconsistent
    )


def lift(
    reconstructor: Reconstructor,
    reference: View,
    anchor: View,
    pixel_mask: Bool[Tensor, "h w"] | None = None,
) -> Lift:
    """Lift `Ψ((Ĩ_t, P_t), (I_s, P_s))` and keep the target's Gaussians (paper, Eq. 7).

    These are all that the target sees if Ψ is not pixel-aligned, else those inside `pixel_mask`.
    """
    pair = run_reconstructor(reconstructor, [reference, anchor], pixel_mask)
    reference_depth, anchor_depth = pair.depths
    if pair.view_index is None or pair.pixel_index is None:
        seen = is_inside(*project(pair.gaussians.means, reference.camera), reference.camera)
        return Lift(pair.gaussians[seen], reference_depth, anchor_depth, None)
    own = pair.view_index == 0
    if pixel_mask is not None:
        own &= pixel_mask.flatten()[pair.pixel_index.where(own, 0)]
    return Lift(pair.gaussians[own], reference_depth, anchor_depth, pair.pixel_index[own])


def compute_overlap(camera: Camera, render: Render, anchor: Camera, at_anchor: Render) -> float:
    """Compute the fraction of visible surfaces that the anchor sees, too; 0 if there are none."""
    seen = render.depth_map()
    points = unproject(seen.depth, camera)[seen.valid]
    if len(points) == 0:
        return 0.0
    pixels, z = project(points, anchor)
    surface = sample(at_anchor.depth[..., None], pixels)[:, 0]
    return (
        (is_inside(pixels, z, anchor) & (z < (1 + SURFACE_TOLERANCE) * surface))
        .float()
        .mean()
        .item()
    )

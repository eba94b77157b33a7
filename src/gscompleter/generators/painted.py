"""Φ of any painter: images that another program, model or person painted for the targets.

Only what the painter was asked for counts: the hole with its rim. What lies outside is
compared with the scene, which gives the exposure of the painting and tells whether it shows the
target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from gscompleter.config.generators import PaintedSettings
from gscompleter.generators import GeneratorOutput, GeneratorRequest
from gscompleter.generators.agreement import Agreement, compare_with_observed
from gscompleter.generators.warp import BORDER_WIDTH, complete_warp
from gscompleter.numerics.geometry import is_same_camera
from gscompleter.numerics.image_ops import dilate, find_largest_regions, smooth_masked
from gscompleter.system.errors import InputError
from gscompleter.system.tensor_checks import BOOLS, Form
from gscompleter.types import Camera, View

MAX_ASPECT_DIFFERENCE = 0.01
"""Largest relative difference between the aspect ratios of a painted image and of its target."""
MAX_DIFFERENCE = 0.12
"""Difference of colours in [0, 1] beside the hole, after the fit of the exposure, from which on it
is said where they differ; the same as that of things that moved between photographs."""
DIFFERENCE_RADIUS = 4
"""Radius in pixels over which that difference is averaged, since fine detail may differ."""
MIN_DIFFERING = 0.005
"""Share of the image that differs from which on it is said."""
MIN_UNPAINTED = 0.005
"""Share of the hole without paint from which on it is said."""


@dataclass(frozen=True, repr=False)
class Painting(View):
    """An image that was painted for a target, at the size of its camera.

    Pixels of its `ignore_mask` are not painted.
    """

    name: str = "the painted image"
    """Name of its file, for sentences."""
    asked: Bool[Tensor, "h w"] | None = None
    """True where the painter was asked to paint; None for the hole that the scene has now. An
    earlier target may have filled a part of it since then."""

    owner: ClassVar[str] = "a painting"
    forms: ClassVar[dict[str, Form]] = {**View.forms, "asked": (BOOLS, ("h", "w"))}


@dataclass(frozen=True)
class Painted:
    """Generator Φ that returns what was painted elsewhere."""

    paintings: Sequence[View]
    """One per target, with its camera: paintings, or plain views that are painted completely."""
    painter: str
    """Name of the program, model or person."""
    supports_padding: bool = False
    max_batch_size: int = 1

    def synthesize(self, requests: Sequence[GeneratorRequest]) -> list[GeneratorOutput]:
        """Return the painting of each target, in the exposure of the scene and within it."""
        return [self.use_painting(request) for request in requests]

    def use_painting(self, request: GeneratorRequest) -> GeneratorOutput:
        """Put what counts of a painting into the image of the scene.

        Raise InputError if the target has no painting, or if the painting shows something else.
        """
        target = request.target
        context = request.context
        painting = self.find_painting(target).to(target.K.device)

        # The rim is painted, too: depth is unsure there, and the image that a painter gets is over
        # black, and so darker at the rim than `known_colors`.
        hole = context.holes
        rim = dilate(hole, BORDER_WIDTH)
        asked = rim if painting.asked is None else painting.asked
        counts = rim & asked & painting.valid_mask

        scene = context.known_colors
        comparable = ~rim & ~asked & painting.valid_mask
        agreement = compare_with_observed(painting.image, scene, comparable)
        if not agreement.is_consistent:
            raise InputError(describe_other_image(painting.name, agreement))

        # What is left of the hole continues what is known, as the default Φ does it.
        is_open = hole & ~counts
        base = scene
        if is_open.any():
            warped = complete_warp(request.nearest, target, context)
            base = warped.image.where(is_open[..., None], scene)
        image = agreement.image.where(counts[..., None], base)
        notes = (
            describe_differences(painting.name, agreement.image, scene, comparable),
            describe_open(painting.name, is_open, hole),
        )
        return GeneratorOutput(image, tuple(filter(None, notes)), painter=self.painter)

    def find_painting(self, target: Camera) -> Painting:
        """Find the painting of a target camera."""
        for view in self.paintings:
            if is_same_camera(view.camera, target):
                if isinstance(view, Painting):
                    return view
                return Painting(view.image, view.camera, ignore_mask=view.ignore_mask)
        count = len(self.paintings)
        raise InputError(
            f"The generator 'painted' has {count} image{'' if count == 1 else 's'}, none of them "
            "painted for the target camera; export the holes of this target and paint them, or "
            "choose 'warp-inpaint'."
        )


def load_painted(
    settings: PaintedSettings, seed: int, photographs: Sequence[View], device: str
) -> Painted:
    """Load the generator of images that were painted for the targets.

    As other generators that return given images, it gets these as `photographs`.
    """
    return Painted(tuple(photographs), settings.painter)


def fit_painting(
    image: Float[Tensor, "painted_h painted_w 3"],
    opaque: Bool[Tensor, "painted_h painted_w"],
    camera: Camera,
    name: str,
) -> Painting:
    """Scale a painted image to the size of its camera; `opaque` is False where nothing is painted.

    Raise InputError if its aspect ratio is another one.
    """
    check_aspect(name, image.shape[1], image.shape[0], camera)
    size = (camera.height, camera.width)
    # Colours below transparent pixels are arbitrary, and must not bleed into painted ones.
    layers = torch.cat([image * opaque[..., None], opaque[..., None].to(image)], dim=-1)
    scaled = scale_layers(layers, size)
    weight = scaled[..., 3]
    is_painted = weight >= 0.5
    colors = (scaled[..., :3] / weight.clamp_min(1e-3)[..., None]).clamp(0, 1)
    return Painting(
        colors, camera, ignore_mask=None if bool(is_painted.all()) else ~is_painted, name=name
    )


def fit_mask(
    mask: Bool[Tensor, "painted_h painted_w"], camera: Camera, name: str
) -> Bool[Tensor, "h w"]:
    """Scale a mask to the size of its camera; errors as those of `fit_painting`."""
    check_aspect(name, mask.shape[1], mask.shape[0], camera)
    return scale_layers(mask[..., None].float(), (camera.height, camera.width))[..., 0] >= 0.5


def check_aspect(name: str, width: int, height: int, camera: Camera) -> None:
    """Raise InputError if an image has another aspect ratio than a camera."""
    if abs(width * camera.height / (height * camera.width) - 1) > MAX_ASPECT_DIFFERENCE:
        raise InputError(
            f"{name} has {width} x {height} pixels, and its target {camera.width} x "
            f"{camera.height}; scale it to any size of the same aspect ratio, without cropping."
        )


def scale_layers(
    layers: Float[Tensor, "painted_h painted_w c"], size: tuple[int, int]
) -> Float[Tensor, "h w c"]:
    """Scale an image to height and width, averaging what becomes smaller."""
    if tuple(layers.shape[:2]) == size:
        return layers
    channels_first = layers.movedim(-1, 0)[None]
    scaled = interpolate(channels_first, size, mode="bilinear", antialias=True)
    return scaled[0].movedim(0, -1).contiguous()


def describe_other_image(name: str, agreement: Agreement) -> str:
    """Write the sentence about an image that shows something else than its target."""
    if not agreement.is_finite:
        return f"{name} has colours that are not finite (NaN or infinity); paint or save it again."
    advice = "it may be the image of another camera, or cropped or moved"
    if agreement.residual <= agreement.limit:
        advice = "paint it in the exposure of the scene"
    return (
        f"{name} does not show what its camera sees of the scene: outside of the mask, "
        f"{agreement.describe_difference()}; {advice}."
    )


def describe_differences(
    name: str,
    image: Float[Tensor, "h w 3"],
    scene: Float[Tensor, "h w 3"],
    comparable: Bool[Tensor, "h w"],
) -> str:
    """Describe where an image, in the exposure of the scene, differs from it outside of the mask.

    Empty where it hardly does.
    """
    difference = smooth_masked((image - scene).abs(), comparable, DIFFERENCE_RADIUS).mean(dim=-1)
    differs = comparable & (difference > MAX_DIFFERENCE)
    share = differs.float().mean().item()
    if share < MIN_DIFFERING:
        return ""
    # Right and bottom are the first pixels outside.
    boxes = "; ".join(
        f"x {left} to {right - 1}, y {top} to {bottom - 1}"
        for left, top, right, bottom in find_largest_regions(differs, 0, 0)
    )
    return (
        f"Outside of its mask, {name} differs from the scene in {share:.1%} of the image (largest "
        f"regions, in pixels: {boxes}); only what the mask covers counts."
    )


def describe_open(name: str, is_open: Bool[Tensor, "h w"], hole: Bool[Tensor, "h w"]) -> str:
    """Describe how much of the hole was not painted; empty for next to nothing."""
    share = int(is_open.sum()) / max(int(hole.sum()), 1)
    if share < MIN_UNPAINTED:
        return ""
    return (
        f"{name} leaves {share:.1%} of the hole open, where it is transparent or the mask of the "
        "export is black; tone and lines of the border continue there."
    )

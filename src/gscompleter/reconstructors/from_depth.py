"""A Ψ from any model of depth: splatted and fitted to the photographs as plane-sweep stereo is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool
from torch import Tensor

from gscompleter.matching.stereo_image import (
    StereoImage,
    source_from_reference,
    stereo_images,
)
from gscompleter.reconstructors.plane_sweep.fusion import Layer, Transforms
from gscompleter.reconstructors.plane_sweep.reconstructor import ranged
from gscompleter.reconstructors.plane_sweep.splatter import Splatter
from gscompleter.types import DepthMap, Reconstruction, View


@runtime_checkable
class DepthModel(Protocol):
    """Depths of posed photographs."""

    def __call__(self, views: Sequence[View]) -> list[DepthMap]:
        """z-depth of all pixels of `views`, in scene units; valid where the model tells it."""
        ...


@dataclass(frozen=True, kw_only=True)
class FromDepth(Splatter):
    """Depths of a model, splatted, and fitted to the photographs."""

    model: DepthModel

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Gaussians of what `views` show, as `scene` tells, and the depths of all of their pixels.

        Raises:
            InputError: fewer than two views, no baseline between them, an empty depth range.
        """
        views = ranged(views)
        images, unit = stereo_images(views)
        depths = self.model(views)
        layers = [layer_of(*pair, unit) for pair in zip(images, depths, strict=True)]
        return self.scene(views, depths, layers, transforms_among(images))

    def lift(self, views: Sequence[View], wanted: Bool[Tensor, "h w"]) -> Reconstruction:
        """The Gaussians of the pixels `wanted` of the first view, a synthesized image.

        Raises:
            InputError: as a call.
        """
        views = ranged(views)
        return self.wanted_of(views, self.model(views), wanted)


def layer_of(image: StereoImage, depth: DepthMap, unit: float) -> Layer:
    """What a model says of a view, per widest baseline of `unit` scene units."""
    inverse = (unit / depth.depth.detach().cpu().double()).float().numpy()
    sure = depth.valid.float() if depth.confidence is None else depth.confidence
    return Layer(image, inverse, np.ascontiguousarray(sure.detach().cpu().float().numpy()))


def transforms_among(images: Sequence[StereoImage]) -> Transforms:
    """From the pixels of each image to those of the others."""
    pairs = permutations(range(len(images)), 2)
    return {(i, j): source_from_reference(images[i], images[j]) for i, j in pairs}

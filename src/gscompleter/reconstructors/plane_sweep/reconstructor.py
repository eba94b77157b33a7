"""The plane-sweep reconstructor, from posed photographs to Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.numerics.geometry import compute_sparse_depth, measure_baseline, unproject
from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.numerics.sky import SKY_DEPTH, is_sky
from gscompleter.numerics.value_checks import check_given_views
from gscompleter.reconstructors.depth_predictors import (
    DepthPredictor,
    predict_depth,
    predict_nothing,
)
from gscompleter.reconstructors.features.depth_range import get_depth_range, set_depth_range
from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.reconstructors.plane_sweep.depth_devices import get_depth_device
from gscompleter.reconstructors.plane_sweep.emphasis import Emphasis
from gscompleter.reconstructors.plane_sweep.fusion import DepthLayer
from gscompleter.reconstructors.plane_sweep.gaussians import Splatter
from gscompleter.reconstructors.plane_sweep.given_depth import (
    add_given,
    contradicts_stereo,
    is_dense,
    measure_nothing,
)
from gscompleter.reconstructors.plane_sweep.ground import hold_to_ground
from gscompleter.reconstructors.plane_sweep.near_plane import find_near_plane
from gscompleter.reconstructors.plane_sweep.predicted_depth import (
    Supported,
    add_prediction,
    describe_support,
)
from gscompleter.reconstructors.plane_sweep.rig import Rig, build_rig
from gscompleter.reconstructors.plane_sweep.sky_mask import find_skies, find_sky, transfer_sky
from gscompleter.reconstructors.plane_sweep.surfaces import SMOOTHING_ITERATIONS, fit_surfaces
from gscompleter.reconstructors.plane_sweep.sweep import (
    Mask,
    Measurement,
    compute_inverse_depth,
    measure_depths,
)
from gscompleter.render.loading import load_renderer
from gscompleter.system.errors import join_names
from gscompleter.system.torch_modes import run_in_plain_torch
from gscompleter.types import Camera, ChooseMasks, DepthMap, Reconstruction, View

LIFT_ITERATIONS = SMOOTHING_ITERATIONS // 2
"""Iterations of the surfaces of a synthesized image, which registration corrects."""
MIN_HALVED_LIFT = 320.0
"""Shortest side, in pixels, from which a synthesized image and its anchor are matched at half size,
which takes an eighth of the time. Photographs never are: of five it would cost 0.4 dB."""
MAX_LOSS = 0.05
"""Largest loss of a photograph, in dB, that predicted depth may cause."""
MAX_LINE_PHOTOGRAPHS = 8
"""Most photographs that a line names."""


@dataclass(frozen=True)
class PlaneSweep(Splatter):
    """Reconstructor by plane-sweep stereo, surface completion and splatting."""

    name: ClassVar[str] = "plane-sweep"

    predict_depth: DepthPredictor = predict_nothing
    """Monocular depth, used where stereo measures nothing and confirms it elsewhere."""
    device: str = "cpu"
    """Device that matches photographs and fits surfaces, by the names of torch. Where the
    photographs lie on a GPU and this is one, Gaussians are fitted there as well."""

    def __post_init__(self) -> None:
        """Raise InputError for a device that plane-sweep does not know."""
        get_depth_device(self.device)

    @run_in_plain_torch
    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Reconstruct the scene and the depth of every pixel."""
        return self.fit_at(views).reconstruct(views)

    @run_in_plain_torch
    def reconstruct_part(self, views: Sequence[View], choose_masks: ChooseMasks) -> Reconstruction:
        """Reconstruct the depth of every pixel, and what any view shows in its mask.

        Half of the time is that of the fit to the photographs, which grows with what is fitted.
        """
        return self.fit_at(views).reconstruct(views, choose_masks)

    @run_in_plain_torch
    def reconstruct_and_fit(
        self, views: Sequence[View], check_views: Sequence[View], targets: Sequence[Camera]
    ) -> Reconstruction:
        """Reconstruct the scene of `views`.

        From three of them on it is fitted to `check_views`, too, and to those near `targets` most.
        """
        return self.fit_at(views).reconstruct(views, None, Emphasis(check_views, targets))

    def fit_at(self, views: Sequence[View]) -> PlaneSweep:
        """Fit Gaussians on the GPU of the photographs, if they lie on one and it is to be used.

        They lie there only if its renderer is used.
        """
        check_given_views(views)
        here = views[0].image.device
        is_chosen = self.device.partition(":")[0] == "cuda"
        if here.type != "cuda" or not is_chosen:
            return self
        return replace(self, renderer=load_renderer("cuda"), fit_device=str(here))

    def reconstruct(
        self,
        views: Sequence[View],
        choose_masks: ChooseMasks | None = None,
        emphasis: Emphasis = Emphasis(),
    ) -> Reconstruction:
        """Reconstruct everything, or what any view shows in its mask, and fit it to all views."""
        views = set_depth_range(views, *get_depth_range(views))
        rig = build_rig(views, self.device)
        contradicted = find_contradicted(rig, views)
        rig = rig.drop_given(contradicted)
        name = partial(name_photographs, views)
        measured, skies = measure_views(rig, views)
        parts = self.support(rig, views, measured, skies)
        by_stereo = complete_layers(rig, measured, measured, skies)
        by_prediction = None
        if any(part.share for part in parts):
            observed = [part.measured for part in parts]
            by_prediction = complete_layers(rig, observed, measured, skies)

        # What is needed by either kind of depth is built with both, so that they can be compared.
        masks = None
        if choose_masks is not None:
            kinds = [by_stereo] if by_prediction is None else [by_stereo, by_prediction]
            chosen = [choose_masks(make_depth_maps(kind, rig.unit, views)) for kind in kinds]
            masks = [torch.stack(of_view).any(dim=0) for of_view in zip(*chosen, strict=True)]
        scene = self.build(rig, views, by_stereo, masks, emphasis)
        if by_prediction is not None:
            supported = self.build(rig, views, by_prediction, masks, emphasis)
            # Surfaces that are right do not hide what another photograph shows.
            judged = views if masks is None else ignore_outside(views, masks)
            losses = self.measure_losses(judged, scene, supported)
            worst = max(range(len(views)), key=losses.__getitem__)
            if losses[worst] > MAX_LOSS:
                loss = f"{name([worst])} would be reproduced {losses[worst]:.2f} dB worse with it"
                parts = [part.refuse(loss) for part in parts]
            else:
                scene = supported
        notes = describe_support(parts, name)
        wrong = [number for number, is_wrong in enumerate(contradicted) if is_wrong]
        if wrong:
            notes = (
                f"The given depth is not used in {name(wrong)}, because its surfaces contradict "
                "what stereo measures there; depth that a network predicts belongs to --depth.",
                *notes,
            )
        return replace(scene, contradicted_depths=tuple(wrong), notes=notes)

    def find_near_plane(self, views: Sequence[View], near: float, far: float) -> float:
        """Find a near plane that no surface of the photographs stands before; at most `near`."""
        return near if len(views) == 1 else find_near_plane(views, near, far, self.device)

    @run_in_plain_torch
    def lift(self, views: Sequence[View], pixel_mask: Bool[Tensor, "h w"]) -> Reconstruction:
        """Lift the pixels of `pixel_mask` in the first view, a synthesized image.

        No photograph observes a hole, so its opacities are not fitted; its depth continues the
        surfaces around it. Colours are fitted to the image itself. The sky gets no
        depth. At the place of an anchor with given depth there is no parallax, and the given
        surfaces are continued.
        """
        views = set_depth_range(views, *get_depth_range(views))
        if len(views[1].known_depths) and measure_baseline(*(v.camera for v in views)) == 0:
            return self.fit_at(views).lift_in_place(views[0], views[1], pixel_mask)
        rig = build_rig(views, self.device)
        first, second = match_views(rig, views, MIN_HALVED_LIFT)
        first = add_given(first, rig.images[0])

        # The sky is found in the photograph and carried over by direction; the synthesized image
        # only has to be even there.
        sky_of_second = find_sky(rig.images[1], second)
        sky_of_first = transfer_sky(rig, sky_of_second)
        # What the additions do to the photographs is the business of the guards.
        (part,) = self.support(rig, views[:1], [first], [sky_of_first])
        layers = [
            make_layer(
                rig.images[0], part.measured.exclude(sky_of_first), rig.device, LIFT_ITERATIONS
            ),
            make_layer(rig.images[1], second.exclude(sky_of_second), rig.device, 0),
        ]
        depths = make_depth_maps(layers, rig.unit, views)
        lifted = self.fit_at(views).lift_pixels(views, depths, pixel_mask)
        return replace(lifted, notes=describe_support([part], lambda _: "the synthesized image"))

    def lift_in_place(
        self, image: View, anchor: View, pixel_mask: Bool[Tensor, "h w"]
    ) -> Reconstruction:
        """Lift an image by the given depth of a photograph from the same place."""
        assert anchor.given_depth is not None
        # Both cameras have one centre and may differ in rotation, so that the given depths are
        # carried over as points.
        known = anchor.given_depth > 0
        points = unproject(anchor.given_depth, anchor.camera)[known]
        depths = compute_sparse_depth(points, image.camera)
        if image.given_depth is not None:
            depths = image.given_depth.where(image.given_depth > 0, depths)
        turned = replace(image, given_depth=depths)
        (depth,) = self.estimate_depths([turned])
        return self.lift_pixels([image], [depth, DepthMap(anchor.given_depth, known)], pixel_mask)

    def estimate_depths(self, views: Sequence[View]) -> list[DepthMap]:
        """Estimate z-depth and confidence of every pixel, in scene units."""
        views = set_depth_range(views, *get_depth_range(views))
        rig = build_rig(views, self.device)
        return make_depth_maps(self.compute_layers(rig, views), rig.unit, views)

    def compute_layers(self, rig: Rig, views: Sequence[View]) -> list[DepthLayer]:
        """Compute the completed inverse depth of each view."""
        rig = rig.drop_given(find_contradicted(rig, views))
        measured, skies = measure_views(rig, views)
        parts = self.support(rig, views, measured, skies)
        return complete_layers(rig, [part.measured for part in parts], measured, skies)

    def support(
        self,
        rig: Rig,
        views: Sequence[View],
        measured: Sequence[Measurement],
        skies: Sequence[Mask],
    ) -> list[Supported]:
        """Predict the depth of each view, and add it to what is measured if it stands the test."""
        if self.predict_depth is predict_nothing:
            return [Supported(measurement) for measurement in measured]
        predictions = [predict_depth(self.predict_depth, view) for view in views]
        images = [image.image for image in rig.images[: len(views)]]
        return map_in_parallel(add_prediction, measured, predictions, images, skies)

    def build(
        self,
        rig: Rig,
        views: Sequence[View],
        layers: Sequence[DepthLayer],
        masks: Sequence[Bool[Tensor, "_ _"]] | None,
        emphasis: Emphasis,
    ) -> Reconstruction:
        """Build the Gaussians of completed depths, and fit them to the photographs."""
        depths = make_depth_maps(layers, rig.unit, views)
        return self.build_scene(views, depths, layers, rig.transforms, masks, emphasis)

    def measure_losses(
        self, views: Sequence[View], before: Reconstruction, after: Reconstruction
    ) -> list[float]:
        """Measure by how much a second reconstruction reproduces each photograph worse, in dB."""
        before_errors, after_errors = (
            [self.measure_error(view, scene, number) for number, view in enumerate(views)]
            for scene in (before, after)
        )
        return [
            10 * math.log10(max(after, 1e-12) / max(before, 1e-12))
            for before, after in zip(before_errors, after_errors, strict=True)
        ]

    def measure_error(self, view: View, scene: Reconstruction, number: int) -> float:
        """Measure the mean squared colour error of a photograph, apart from ignored pixels."""
        seen = view.to(self.fit_device)
        image = self.renderer.render(scene.gaussians.to(self.fit_device), seen.camera).image
        if scene.exposure_gains is not None:
            image = image * scene.exposure_gains[number].to(image)
        error = (image - seen.image)[seen.valid_mask].double().square()
        return float(error.mean()) if error.numel() else 0.0


def ignore_outside(views: Sequence[View], masks: Sequence[Bool[Tensor, "_ _"]]) -> list[View]:
    """Ignore the pixels of each view that are not in its mask."""
    return [
        replace(view, ignore_mask=~(mask & view.valid_mask))
        for view, mask in zip(views, masks, strict=True)
    ]


def find_contradicted(rig: Rig, views: Sequence[View]) -> list[bool]:
    """Find the views whose stereo clearly contradicts their given depth."""
    # A single photograph has no stereo.
    if len(views) == 1 or not any(is_dense(image) for image in rig.images):
        return [False] * len(views)
    stereo = match_views(rig.drop_given([True] * len(views)), views)
    return map_in_parallel(contradicts_stereo, rig.images, stereo)


def measure_views(rig: Rig, views: Sequence[View]) -> tuple[list[Measurement], list[Mask]]:
    """Measure the depth of each view, by stereo or as it is given, and find its sky.

    The sky is judged by measurements alone, before the ground and predictions fill its pixels.
    """
    measured = [
        add_given(measurement, image)
        for measurement, image in zip(match_views(rig, views), rig.images, strict=True)
    ]
    skies = find_skies(rig, measured)
    return hold_to_ground(rig, measured, skies), skies


def complete_layers(
    rig: Rig,
    observed: Sequence[Measurement],
    measured: Sequence[Measurement],
    skies: Sequence[Mask],
) -> list[DepthLayer]:
    """Complete the inverse depth of each view by surfaces through what is `observed`.

    They are fitted without the sky, as its matches are arbitrary, and it gets its depth afterwards.
    """
    without_sky = [part.exclude(sky) for part, sky in zip(observed, skies, strict=True)]
    devices = [rig.device] * len(rig.images)
    surfaces = map_in_parallel(make_layer, rig.images, without_sky, devices)
    return [
        add_sky(surface, measurement, sky)
        for surface, measurement, sky in zip(surfaces, measured, skies, strict=True)
    ]


def name_photographs(views: Sequence[View], numbers: Sequence[int]) -> str:
    """Name views by their frames, or by their places if they have none."""
    frames = [views[number].frame for number in numbers]
    named = [
        number if frame is None else frame for number, frame in zip(numbers, frames, strict=True)
    ]
    return f"photograph{'s' if len(named) > 1 else ''} {join_names(named, MAX_LINE_PHOTOGRAPHS)}"


def match_views(
    rig: Rig, views: Sequence[View], min_halved_side: float = math.inf
) -> list[Measurement]:
    """Measure depth outside the ignored pixels, at half size if all images are large enough.

    A single photograph has no stereo, and nothing is measured.
    """
    near, far = get_depth_range(views)
    if len(views) == 1:
        return [measure_nothing(rig.images[0], near / rig.unit, far / rig.unit)]
    is_halved = min(min(image.size) for image in rig.images) >= min_halved_side
    measurements = measure_depths(rig.halve() if is_halved else rig, near, far)
    return [
        measurement if image.ignore_mask is None else measurement.exclude(image.ignore_mask)
        for measurement, image in zip(measurements, rig.images, strict=True)
    ]


def make_layer(
    image: StereoImage,
    measured: Measurement,
    device: str,
    iterations: int = SMOOTHING_ITERATIONS,
) -> DepthLayer:
    """Convert the measured depths of a view to a layer, by surfaces after so many iterations."""
    full = measured.resize_to(image.size)
    choose_fit = get_depth_device(device).choose_fit
    index = fit_surfaces(full.index, full.weight, image.image, iterations, choose_fit)
    return DepthLayer(image, compute_inverse_depth(full.planes, index), full.confidence)


def add_sky(layer: DepthLayer, measured: Measurement, sky: Mask) -> DepthLayer:
    """Set the sky of a layer to the sky depth, with full confidence."""
    # The first plane is the far plane, in inverse depth.
    inverse_sky_depth = np.float32(measured.planes[0] / SKY_DEPTH)
    return DepthLayer(
        layer.image,
        inverse=np.where(sky, inverse_sky_depth, layer.inverse),
        confidence=np.where(sky, np.float32(1), layer.confidence),
    )


def make_depth_maps(
    layers: Sequence[DepthLayer], unit: float, views: Sequence[View]
) -> list[DepthMap]:
    """Convert layers to z-depths in scene units; the sky is not valid."""
    depths = []
    for layer, view in zip(layers, views, strict=True):
        depth = torch.from_numpy(np.float32(unit) / layer.inverse)
        confidence = torch.from_numpy(layer.confidence).to(view.image.device)
        depth = depth.to(confidence.device)
        valid = (confidence > 0) & ~is_sky(depth, view.camera)
        depths.append(DepthMap(depth, valid, confidence.where(valid, 0.0)))
    return depths

"""Gaussians from per-pixel depths: discs oriented like the surface, fitted to the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gscompleter.numerics.geometry import rotations_to_quats
from gscompleter.numerics.sky import extend_sky, is_sky, restore_sky_colors
from gscompleter.reconstructors.plane_sweep.directional_colors import fit_directional_colors
from gscompleter.reconstructors.plane_sweep.fit import fit_jointly, fit_opacities
from gscompleter.reconstructors.plane_sweep.fusion import (
    Layer,
    estimate_gains,
    find_finest_pixels,
    find_free_pixels,
)
from gscompleter.reconstructors.plane_sweep.rig import Transforms
from gscompleter.reconstructors.plane_sweep.sweep import Mask
from gscompleter.render.fit_colors import RELAXATION, fit_colors
from gscompleter.render.loading import load_renderer
from gscompleter.render.protocols import Renderer
from gscompleter.system.threads import use_one_torch_thread
from gscompleter.types import (
    DepthMap,
    Gaussians,
    Reconstruction,
    View,
    make_observed,
    merge,
    sh_from_rgb,
)

MIN_ALPHA = 0.7
"""Alpha below which a removed pixel is restored to close a gap."""
THICKNESS = 0.15
"""Standard deviation along the normal, relative to that across the viewing ray."""
MAX_STRETCH = 6.0
"""Largest elongation of a disc on a slanted surface, relative to a frontal one."""
OPACITY = 0.98
"""Initial opacity of every disc."""
COLOR_ROUNDS = 4
"""Rounds of the colour fit to a synthesized image."""


@dataclass(frozen=True)
class Splatter:
    """Base of reconstructors that splat depth maps and fit the Gaussians."""

    disc_sigma: float = 0.55
    """Standard deviation of a Gaussian across the viewing ray, in pixels."""
    renderer: Renderer = field(default_factory=lambda: load_renderer("cpu"))

    def build_scene(
        self,
        views: Sequence[View],
        depths: Sequence[DepthMap],
        layers: Sequence[Layer],
        transforms: Transforms,
    ) -> Reconstruction:
        """Build the Gaussians of `views` and fit them to the photographs.

        One or two views keep all pixels. With more views each surface is kept once, from the view
        that resolves it best; observed free space stays empty, and clearly different exposures are
        normalized to their mean. `depths` are in scene units, `layers` are the same per widest
        baseline.
        """
        gains = torch.from_numpy(estimate_gains(layers, transforms)).float()
        device = views[0].image.device
        normalized = list(map(View.normalize_exposure, views, gains.to(device)))
        parts = [self.splat(view, depth) for view, depth in zip(normalized, depths, strict=True)]
        every, on_cpu = merge(parts).to("cpu"), [view.to("cpu") for view in views]
        counted = flatten_masks([view.valid_mask for view in on_cpu])
        chosen = self.select_pixels(every, on_cpu, layers, transforms) & counted
        behind = self.extend_skies(normalized, depths)
        made = merge([every[chosen], *(gaussians.to("cpu") for _, gaussians, _ in behind)])
        known = [self.replace_ignored(made, *pair) for pair in zip(on_cpu, gains, strict=True)]
        fitted = restore_sky_colors(made, self.fit_gaussians(made, known, gains), on_cpu[0].camera)
        rows = torch.cat([torch.arange(len(part)) for part in parts])[chosen]
        numbers = torch.cat([torch.full((len(part),), i) for i, part in enumerate(parts)])[chosen]
        more = [torch.full((len(pixels),), i) for i, _, pixels in behind]
        return Reconstruction(
            fitted.to(device),
            tuple(depths),
            torch.cat([numbers, *more]).to(device),
            torch.cat([rows, *(pixels.cpu() for _, _, pixels in behind)]).to(device),
            None if (gains == 1).all() else gains.to(device),
        )

    def lift_pixels(
        self, views: Sequence[View], depths: Sequence[DepthMap], pixel_mask: Bool[Tensor, "h w"]
    ) -> Reconstruction:
        """Lift the pixels of `pixel_mask` in the first view and fit their colours to it."""
        rows = torch.nonzero(pixel_mask.reshape(-1))[:, 0]
        blurred, image = self.splat(views[0], depths[0])[rows].to("cpu"), views[0].to("cpu")
        made = self.fit_to_image(blurred, image).to(rows.device)
        return Reconstruction(made, tuple(depths), torch.zeros_like(rows), rows)

    def fit_to_image(self, gaussians: Gaussians, view: View) -> Gaussians:
        """Fit only the colours, to one image."""
        alone = self.renderer.freeze(gaussians[:0], view.camera)
        return fit_colors(gaussians, [alone], [view], [RELAXATION] * COLOR_ROUNDS)

    def select_pixels(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        layers: Sequence[Layer],
        transforms: Transforms,
    ) -> Bool[Tensor, "n"]:
        """Select the pixels that form the scene, over all views in turn."""
        if len(views) <= 2:
            return torch.ones(len(gaussians), dtype=torch.bool)
        free = find_free_pixels(layers, transforms)
        kept = flatten_masks(find_finest_pixels(layers, free, transforms))
        start = 0
        for view, mask in zip(views, free, strict=True):
            alpha = self.renderer.render(gaussians[kept], view.camera).alpha
            gap = torch.from_numpy(mask) & (alpha < MIN_ALPHA)
            kept[start : start + gap.numel()] |= gap.reshape(-1)
            start += gap.numel()
        return kept

    def replace_ignored(self, made: Gaussians, view: View, gain: Float[Tensor, "3"]) -> View:
        """Replace ignored pixels by the render, so that nothing is fitted to them."""
        if view.ignore_mask is None:
            return view
        image = self.renderer.render(made, view.camera).image * gain
        return replace(view, image=torch.where(view.ignore_mask[..., None], image, view.image))

    @use_one_torch_thread()
    def fit_gaussians(
        self, gaussians: Gaussians, views: Sequence[View], gains: Float[Tensor, "views 3"]
    ) -> Gaussians:
        """Fit the Gaussians to views that are brighter by `gains`."""
        if len(views) == 1:
            return self.fit_to_image(gaussians, views[0])
        if len(views) == 2:
            faded, depths = fit_opacities(gaussians, views, self.renderer)
            return fit_directional_colors(faded, views, depths, self.renderer)
        return fit_jointly(gaussians, views, gains, self.renderer)

    def splat(self, view: View, depth: DepthMap) -> Gaussians:
        """Create one disc per pixel of `view`."""
        return make_discs(view, depth.depth, compute_normals(depth.depth, view), self.disc_sigma)

    def extend_skies(
        self, views: Sequence[View], depths: Sequence[DepthMap]
    ) -> list[tuple[int, Gaussians, Int[Tensor, "n"]]]:
        """List view number, Gaussians and pixels of the sky behind each view's objects."""
        return [
            (i, *extend_sky(view, sky, self.disc_sigma))
            for i, (view, depth) in enumerate(zip(views, depths, strict=True))
            if (sky := is_sky(depth.depth, view.camera)).any()
        ]


def flatten_masks(masks: Sequence[Mask | Tensor]) -> Bool[Tensor, "n"]:
    """Flatten and concatenate the masks of all views."""
    return torch.cat([torch.as_tensor(mask).reshape(-1) for mask in masks])


def make_discs(
    view: View, depth: Float[Tensor, "h w"], normals: Float[Tensor, "h w 3"], sigma: float
) -> Gaussians:
    """Create one Gaussian per pixel of `view`, row by row, at z-depth `depth`.

    `normals` are in camera axes, towards the camera; `sigma` is the standard deviation across the
    viewing ray, in pixels.
    """
    camera = view.camera
    rays = camera.z_rays()
    means = (camera.center + depth[..., None] * rays).reshape(-1, 3)
    pixel = depth.reshape(-1) * 2 / (camera.K[0, 0] + camera.K[1, 1])

    normal = normals.reshape(-1, 3) @ camera.c2w[:3, :3].T
    towards = -torch.nn.functional.normalize(rays, dim=-1).reshape(-1, 3)
    cosine = (normal * towards).sum(-1, keepdim=True).clamp_min(1 / MAX_STRETCH)
    # On a slanted surface the disc is elongated, so that its projection stays round.
    across = torch.linalg.cross(normal, towards)
    flat = across.norm(dim=-1, keepdim=True) < 1e-3
    across = torch.where(flat, camera.c2w[:3, 0].expand_as(across), across)
    across = across - (across * normal).sum(-1, keepdim=True) * normal
    across = torch.nn.functional.normalize(across, dim=-1)
    along = torch.linalg.cross(normal, across)
    axes = torch.stack([across, along, normal], dim=-1)
    sizes = torch.cat(
        [torch.ones_like(cosine), 1 / cosine, torch.full_like(cosine, THICKNESS)], dim=-1
    )
    return make_observed(
        means=means,
        quats=rotations_to_quats(axes),
        scales=sizes * (sigma * pixel)[:, None],
        opacities=torch.full_like(pixel, OPACITY),
        sh=sh_from_rgb(view.image.reshape(-1, 3)),
    )


def compute_normals(depth: Float[Tensor, "h w"], view: View) -> Float[Tensor, "h w 3"]:
    """Compute normals in camera axes, towards the camera, by one-sided differences."""
    camera = view.camera
    rays = camera.z_rays() @ camera.c2w[:3, :3]
    # Scale by a power of two, which is exact, so that squares neither overflow nor vanish.
    unit = 2.0 ** depth.median().log2().round().item()
    points = rays * (depth / unit)[..., None]

    def difference(p: Float[Tensor, "a b 3"]) -> Float[Tensor, "a b 3"]:
        step = p[:, 1:] - p[:, :-1]
        after = torch.cat([step, step[:, -1:]], 1)
        before = torch.cat([step[:, :1], step], 1)
        nearer = before[..., 2:].abs() < after[..., 2:].abs()
        return torch.where(nearer, before, after)

    dx = difference(points)
    dy = difference(points.transpose(0, 1)).transpose(0, 1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(dy, dx), dim=-1)
    facing = (normal * rays).sum(-1, keepdim=True) < 0
    return torch.where(facing, normal, -normal)

"""Gaussians from per-pixel depths: discs oriented like the surface, fitted to the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import (
    compute_sparse_depth,
    find_at_depth,
    look_up,
    rotations_to_quats,
)
from gscompleter.numerics.image_ops import dilate
from gscompleter.numerics.sky import (
    extend_sky,
    find_sky_gaussians,
    is_sky,
    restore_sky_colors,
)
from gscompleter.reconstructors.plane_sweep.directional_colors import fit_directional_colors
from gscompleter.reconstructors.plane_sweep.emphasis import Emphasis
from gscompleter.reconstructors.plane_sweep.fit import fit_jointly, fit_opacities
from gscompleter.reconstructors.plane_sweep.free_space import (
    find_occluders,
    leave_free_space,
)
from gscompleter.reconstructors.plane_sweep.fusion import (
    DepthLayer,
    estimate_gains,
    find_finest_pixels,
    find_free_pixels,
    measure_ratio,
)
from gscompleter.reconstructors.plane_sweep.passages import Passages, find_passages
from gscompleter.reconstructors.plane_sweep.rig import Transforms
from gscompleter.reconstructors.plane_sweep.sky_colors import blend_skies
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

CLOSED_ALPHA = 0.7
"""Alpha below which a removed pixel is restored to close a gap."""
DISC_THICKNESS = 0.15
"""Standard deviation along the normal, relative to that across the viewing ray."""
MAX_DISC_STRETCH = 6.0
"""Largest elongation of a disc on a slanted surface, relative to a frontal one."""
MAX_PLANE_STRETCH = 12.0
"""Largest elongation where normals around a pixel agree: seen from nearer by, a road whose rows of
discs do not reach each other breaks up into stripes (decision 150)."""
FLAT_AGREEMENT = 0.9995
"""Length of the mean normal around a pixel from which normals agree: they differ by 1.8 degrees."""
FLAT_RADIUS = 2
"""Radius in pixels within which normals have to agree."""
EDGE_OVERSHOOT = 0.6
"""By how much colours may exceed black and white beside an edge, which discs that overlap blur."""
DISC_SIGMA = 0.55
"""Standard deviation of a disc across the viewing ray, in pixels."""
OPACITY = 0.98
"""Initial opacity of every disc."""
FIT_MARGIN = 3
"""Pixels around a part that is built alone in which it is built, too, as Gaussians overlap. With 8
a fox is as good, and takes a sixth longer."""
DISC_BYTES = 260
"""Bytes on a GPU for each pixel of photographs of which little is reconstructed: their images, the
discs of all pixels, and copies of these while some are selected and drawn."""
IMAGE_COLOR_ROUNDS = 4
"""Rounds of the colour fit to a synthesized image."""


@dataclass(frozen=True)
class Splatter:
    """Base of reconstructors that splat depth maps and fit the Gaussians."""

    disc_sigma: float = DISC_SIGMA
    """Standard deviation of a Gaussian across the viewing ray, in pixels."""
    renderer: Renderer = field(default_factory=lambda: load_renderer("cpu"))
    """Renderer that Gaussians are fitted with."""
    fit_device: str = "cpu"
    """Device that it draws on."""

    def build_scene(
        self,
        views: Sequence[View],
        depths: Sequence[DepthMap],
        layers: Sequence[DepthLayer],
        transforms: Transforms,
        masks: Sequence[Bool[Tensor, "_ _"]] | None = None,
        emphasis: Emphasis = Emphasis(),
    ) -> Reconstruction:
        """Build the Gaussians of `views` and fit them to the photographs.

        One or two views keep all pixels. With more views each surface is kept once, from the view
        that resolves it best, and observed free space stays empty, because merged views contradict
        each other (decision 031). Clearly different exposures are normalized to their mean.
        `depths` are in scene units. `layers` hold the inverse depths, with the widest baseline as
        unit of length, and `transforms` relate the views of these layers. With `masks`, only what
        any view shows in its mask is built and fitted, and the sky behind surfaces. The scene of
        three views or more is fitted with `emphasis`, to its check views where it covers them.
        """
        device = views[0].image.device
        if masks is not None and not any(bool(mask.any()) for mask in masks):
            empty = self.splat(views[0], depths[0])[:0]
            none = torch.zeros(0, dtype=torch.long, device=device)
            return Reconstruction(empty, tuple(depths), none, none)

        gains = torch.from_numpy(estimate_gains(layers, transforms)).float()
        skies = [
            is_sky(depth.depth, view.camera) for view, depth in zip(views, depths, strict=True)
        ]
        sky_images = blend_skies(views, skies)
        normalized = []
        for view, gain, sky, image in zip(views, gains.to(device), skies, sky_images, strict=True):
            view = view.normalize_exposure(gain)
            if image is not None:
                view = replace(view, image=image.where(sky[..., None], view.image))
            normalized.append(view)
        if all(image is None for image in sky_images):
            skies = []

        fitted_views = [view.to(self.fit_device) for view in views]
        gains = gains.to(self.fit_device)
        passages = find_passages(views, emphasis.check_views, depths[0], layers[0].inverse)
        candidates, kept, depths = self.fuse(
            normalized, depths, layers, skies, transforms, passages
        )
        # Nothing is reconstructed from masked pixels.
        kept &= flatten_masks([view.valid_mask for view in fitted_views])
        if masks is not None:
            of_scene = candidates[kept]
            fitted_views = ignore_elsewhere(of_scene, fitted_views, depths, masks)
            kept = kept.masked_scatter(kept, find_in_valid(of_scene, fitted_views))
        # Those of a part, too, are behind all surfaces: few, and whoever asked for the part selects
        # by its masks once more.
        extensions = [
            (number, gaussians.to(self.fit_device), pixels.to(self.fit_device))
            for number, gaussians, pixels in self.extend_skies(views, skies, sky_images)
        ]
        scene = merge([candidates[kept], *(gaussians for _, gaussians, _ in extensions)])

        # View of each Gaussian, in the order of the scene.
        sizes = [view.valid_mask.numel() for view in views]
        of_pixels = torch.cat([torch.full((size,), i) for i, size in enumerate(sizes)])
        of_skies = [torch.full_like(sky_pixels, i) for i, _, sky_pixels in extensions]
        view_index = torch.cat([of_pixels.to(kept.device)[kept], *of_skies])

        if len(views) > 2:
            fitted = self.fit_before_sky(scene, view_index, fitted_views, gains, skies, emphasis)
        else:
            fitted = self.fit_gaussians(scene, self.replace_all_ignored(scene, fitted_views, gains))
            in_sky = find_sky_gaussians(scene, view_index, [view.camera for view in fitted_views])
            fitted = restore_sky_colors(scene, fitted, in_sky)

        pixels = torch.cat([torch.arange(size) for size in sizes]).to(kept.device)[kept]
        pixel_index = torch.cat([pixels, *(sky_pixels for _, _, sky_pixels in extensions)])
        return Reconstruction(
            fitted.to(device),
            tuple(depths),
            view_index.to(device),
            pixel_index.to(device),
            None if (gains == 1).all() else gains.to(device),
        )

    def lift_pixels(
        self, views: Sequence[View], depths: Sequence[DepthMap], pixel_mask: Bool[Tensor, "h w"]
    ) -> Reconstruction:
        """Lift the pixels of `pixel_mask` in the first view and fit their colours to it."""
        pixels = torch.nonzero(pixel_mask.reshape(-1))[:, 0]
        # Discs overlap, so that colours of the pixels alone would draw a blurred image.
        blurred = self.splat(views[0], depths[0])[pixels].to(self.fit_device)
        lifted = self.fit_to_image(blurred, views[0].to(self.fit_device)).to(pixels.device)
        return Reconstruction(lifted, tuple(depths), torch.zeros_like(pixels), pixels)

    def fit_to_image(self, gaussians: Gaussians, view: View) -> Gaussians:
        """Fit only the colours, to one image."""
        # The Gaussians are drawn alone: the frozen scene that they are added to is empty.
        alone = self.renderer.freeze(gaussians[:0], view.camera)
        rounds = [RELAXATION] * IMAGE_COLOR_ROUNDS
        return fit_colors(gaussians, [alone], [view], rounds, EDGE_OVERSHOOT)

    def select_pixels(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        layers: Sequence[DepthLayer],
        transforms: Transforms,
        passages: Passages,
    ) -> Bool[Tensor, "n"]:
        """Select the pixels that form the scene: a mask over the pixels of all views in turn."""
        if len(views) <= 2:
            return torch.ones_like(gaussians.opacities, dtype=torch.bool)
        # `free` marks pixels without contradiction: other views do not see through their points,
        # and what is not measured blocks no passage.
        free = find_free_pixels(layers, transforms)
        for number, layer in enumerate(layers):
            unsure = free[number] & ~layer.measured_mask
            free[number] &= ~passages.find_blocking(number, layer.inverse, unsure)
        kept = flatten_masks(find_finest_pixels(layers, free, transforms)).to(self.fit_device)
        # Where the finer views do not close a surface, a view gets its own pixels back. Each view
        # sees what those before it restored.
        start = 0
        for view, mask in zip(views, free, strict=True):
            alpha = self.renderer.render(gaussians[kept], view.camera).alpha
            gap = torch.from_numpy(mask).to(alpha.device) & (alpha < CLOSED_ALPHA)
            kept[start : start + gap.numel()] |= gap.reshape(-1)
            start += gap.numel()
        return kept

    def fuse(
        self,
        views: Sequence[View],
        depths: Sequence[DepthMap],
        layers: Sequence[DepthLayer],
        skies: Sequence[Bool[Tensor, "_ _"]],
        transforms: Transforms,
        passages: Passages,
    ) -> tuple[Gaussians, Bool[Tensor, "n"], Sequence[DepthMap]]:
        """Create a disc for every pixel of every view, and mark those that form the scene.

        Return them where they are fitted, with the depths that they stand at: what only one of
        several photographs shows leaves the free space of the others.
        """
        fitted_views = [view.to(self.fit_device) for view in views]
        candidates = self.splat_all(views, depths)
        kept = self.select_pixels(candidates, fitted_views, layers, transforms, passages)
        if len(views) <= 2:
            return candidates, kept, depths
        renders = [self.renderer.render(candidates[kept], view.camera) for view in fitted_views]
        open_pixels = [
            ((render.alpha < CLOSED_ALPHA) & view.valid_mask).cpu().numpy()
            for render, view in zip(renders, fitted_views, strict=True)
        ]
        occluders = [np.zeros(layer.inverse.shape, np.int32) for layer in layers]
        not_surface = [label > 0 for label in occluders]
        if skies:
            occluders = [
                find_occluders(render.image, view)
                for render, view in zip(renders, fitted_views, strict=True)
            ]
            not_surface = [sky.cpu().numpy() for sky in skies]
        moved = leave_free_space(layers, open_pixels, occluders, not_surface, transforms, passages)
        if all(after is before for after, before in zip(moved, layers, strict=True)):
            return candidates, kept, depths
        depths = [
            move_depths(depth, before, after)
            for depth, before, after in zip(depths, layers, moved, strict=True)
        ]
        # Discs take most of the memory, and those before are not needed any more.
        del candidates
        candidates = self.splat_all(views, depths)
        kept = self.select_pixels(candidates, fitted_views, moved, transforms, passages)
        return candidates, kept, depths

    def splat_all(self, views: Sequence[View], depths: Sequence[DepthMap]) -> Gaussians:
        """Create the discs of all pixels of all views in turn, where they are fitted."""
        # From three views on the sizes are fitted, and other photographs see a road from nearer by.
        # Long discs start worse: a drive of sixteen photographs lost 0.1 to 0.4 dB.
        stretch = MAX_PLANE_STRETCH if len(views) <= 2 else MAX_DISC_STRETCH
        parts = [
            self.splat(view, depth, stretch) for view, depth in zip(views, depths, strict=True)
        ]
        return merge(parts).to(self.fit_device)

    def replace_all_ignored(
        self, scene: Gaussians, views: Sequence[View], gains: Float[Tensor, "views 3"]
    ) -> list[View]:
        """Replace the ignored pixels of all views, as `replace_ignored` does."""
        return [
            self.replace_ignored(scene, view, gain) for view, gain in zip(views, gains, strict=True)
        ]

    def replace_ignored(self, scene: Gaussians, view: View, gain: Float[Tensor, "3"]) -> View:
        """Replace ignored pixels by the render, so that nothing is fitted to them."""
        if view.ignore_mask is None:
            return view
        image = self.renderer.render(scene, view.camera).image * gain
        return replace(view, image=torch.where(view.ignore_mask[..., None], image, view.image))

    def prepare_check(self, scene: Gaussians, view: View, gains: Float[Tensor, "views 3"]) -> View:
        """Bring a check view to the exposure of the scene, and fit nothing where that is open."""
        render = self.renderer.render(scene, view.camera)
        is_open = (render.alpha < COVERED) | ~view.valid_mask
        # Exposures that are all alike, or hardly differ, are not told apart (decision 018).
        if (gains != 1).any() and not is_open.all():
            shown = ~is_open
            log, _ = measure_ratio(
                view.image[shown].cpu().numpy(), render.image[shown].cpu().numpy(), is_open.numel()
            )
            view = view.normalize_exposure(torch.from_numpy(log).exp().to(view.image))
        return self.replace_ignored(
            scene, replace(view, ignore_mask=is_open), torch.ones_like(gains[0])
        )

    @use_one_torch_thread()
    def fit_gaussians(self, gaussians: Gaussians, views: Sequence[View]) -> Gaussians:
        """Fit the Gaussians to one or two views.

        Of one view only colours are fitted. Two views get colours by direction: plain ones, fitted
        to both, would cancel other errors there and be wrong elsewhere (decision 043).
        """
        if len(views) == 1:
            return self.fit_to_image(gaussians, views[0])
        faded, depths = fit_opacities(gaussians, views, self.renderer)
        return fit_directional_colors(faded, views, depths, self.renderer)

    @use_one_torch_thread()
    def fit_before_sky(
        self,
        scene: Gaussians,
        view_index: Int[Tensor, "n"],
        views: Sequence[View],
        gains: Float[Tensor, "views 3"],
        skies: Sequence[Bool[Tensor, "_ _"]],
        emphasis: Emphasis,
    ) -> Gaussians:
        """Fit the surfaces to three views or more, before the sky that each of them shows.

        `view_index` is the number of the view that each Gaussian is of. `skies` mark the sky, and
        are empty if no view shows any. It stays as it is: what one photograph shows white and
        another one blue would pull at the surfaces before it.
        """
        if not skies:
            return self.fit_many_views(scene, views, gains, skies, emphasis)
        in_sky = find_sky_gaussians(scene, view_index, [view.camera for view in views])
        surfaces = scene[~in_sky]
        # A part of a scene may be nothing but sky.
        if not len(surfaces):
            return scene
        fitted = self.fit_many_views(surfaces, views, gains, skies, emphasis)
        # In the order of the scene again.
        rows = torch.cat([torch.nonzero(~in_sky), torch.nonzero(in_sky)])[:, 0]
        return merge([fitted, scene[in_sky]])[rows.argsort()]

    def fit_many_views(
        self,
        surfaces: Gaussians,
        views: Sequence[View],
        gains: Float[Tensor, "views 3"],
        skies: Sequence[Bool[Tensor, "_ _"]],
        emphasis: Emphasis,
    ) -> Gaussians:
        """Fit place, size, direction, opacity and colour together (decision 031).

        The colours of `views` are `gains` times those of the scene.
        """
        photographs = self.replace_all_ignored(surfaces, views, gains)
        checks = [
            self.prepare_check(surfaces, view.to(self.fit_device), gains)
            for view in emphasis.check_views
        ]
        emphasis = replace(emphasis, check_views=checks)
        backdrops = [sky.to(self.fit_device) for sky in skies]
        return fit_jointly(surfaces, photographs, gains, self.renderer, emphasis, backdrops)

    def splat(
        self, view: View, depth: DepthMap, plane_stretch: float = MAX_DISC_STRETCH
    ) -> Gaussians:
        """Create one disc per pixel of `view`; `plane_stretch` is that of `make_discs`."""
        normals = compute_normals(depth.depth, view)
        return make_discs(view, depth.depth, normals, self.disc_sigma, plane_stretch)

    def extend_skies(
        self,
        views: Sequence[View],
        skies: Sequence[Bool[Tensor, "_ _"]],
        sky_images: Sequence[Float[Tensor, "_ _ 3"] | None],
    ) -> list[tuple[int, Gaussians, Int[Tensor, "n"]]]:
        """List view number, Gaussians and pixels of the sky behind each view's objects."""
        extended = []
        for number, image in enumerate(sky_images):
            if image is not None:
                gaussians, pixels = extend_sky(views[number], skies[number], image, self.disc_sigma)
                extended.append((number, gaussians, pixels))
        return extended


def move_depths(depth: DepthMap, before: DepthLayer, after: DepthLayer) -> DepthMap:
    """Move the depths of a view, in scene units, as its layer was moved."""
    if after is before:
        return depth
    factor = torch.from_numpy(before.inverse / after.inverse)
    return replace(depth, depth=depth.depth * factor.to(depth.depth))


def ignore_elsewhere(
    gaussians: Gaussians,
    views: Sequence[View],
    depths: Sequence[DepthMap],
    masks: Sequence[Bool[Tensor, "_ _"]],
) -> list[View]:
    """Ignore the pixels of each view that show nothing of what the masks of all views show.

    `gaussians` are those of the pixels, of which a surface has one for all views; the views are on
    their device.
    """
    device = gaussians.means.device
    maps = [depth.depth.to(device) for depth in depths]
    masks = [mask.to(device) for mask in masks]
    visible = [
        find_at_depth(gaussians, depth, view.camera)
        for depth, view in zip(maps, views, strict=True)
    ]
    shown = torch.zeros_like(gaussians.opacities, dtype=torch.bool)
    for is_visible, mask, view in zip(visible, masks, views, strict=True):
        shown |= is_visible & look_up(mask, gaussians, view.camera)

    ignoring = []
    for is_visible, mask, view in zip(visible, masks, views, strict=True):
        pixels = compute_sparse_depth(gaussians.means[shown & is_visible], view.camera) > 0
        near = dilate(mask | pixels, FIT_MARGIN)
        ignoring.append(replace(view, ignore_mask=~(near & view.valid_mask)))
    return ignoring


def find_in_valid(gaussians: Gaussians, views: Sequence[View]) -> Bool[Tensor, "n"]:
    """Find the Gaussians whose means project onto a valid pixel of any view, hidden or not."""
    found = torch.zeros_like(gaussians.opacities, dtype=torch.bool)
    for view in views:
        found |= look_up(view.valid_mask, gaussians, view.camera)
    return found


def flatten_masks(masks: Sequence[Mask | Tensor]) -> Bool[Tensor, "n"]:
    """Flatten and concatenate the masks of all views."""
    return torch.cat([torch.as_tensor(mask).reshape(-1) for mask in masks])


def make_discs(
    view: View,
    depth: Float[Tensor, "h w"],
    normals: Float[Tensor, "h w 3"],
    sigma: float,
    plane_stretch: float = MAX_DISC_STRETCH,
) -> Gaussians:
    """Create one Gaussian per pixel of `view`, row by row, at z-depth `depth`.

    `depth` is in scene units; `normals` are unit vectors in camera axes, towards the camera;
    `sigma` is the standard deviation across the viewing ray, in pixels; `plane_stretch` is the
    largest elongation on a plane. Means are in world axes.
    """
    camera = view.camera
    rays = camera.z_rays()
    means = (camera.center + depth[..., None] * rays).reshape(-1, 3)
    # Width of a pixel at the depth of the surface, in scene units.
    pixel = depth.reshape(-1) * 2 / (camera.K[0, 0] + camera.K[1, 1])

    # Normal and direction towards the camera, both in world axes.
    normal = normals.reshape(-1, 3) @ camera.c2w[:3, :3].T
    towards = -torch.nn.functional.normalize(rays, dim=-1).reshape(-1, 3)
    stretch = torch.where(find_flat_pixels(normals), plane_stretch, MAX_DISC_STRETCH).reshape(-1, 1)
    cosine = (normal * towards).sum(-1, keepdim=True).clamp_min(1 / stretch)

    # On a slanted surface the disc is elongated by 1 / cosine, so that its projection stays round:
    # its short axis is perpendicular to normal and ray. A frontal disc is round, and its axis only
    # has to lie in the surface.
    across = torch.linalg.cross(normal, towards)
    flat = across.norm(dim=-1, keepdim=True) < 1e-3
    across = torch.where(flat, camera.c2w[:3, 0].expand_as(across), across)
    across = across - (across * normal).sum(-1, keepdim=True) * normal
    across = torch.nn.functional.normalize(across, dim=-1)
    along = torch.linalg.cross(normal, across)
    axes = torch.stack([across, along, normal], dim=-1)
    sizes = torch.cat(
        [torch.ones_like(cosine), 1 / cosine, torch.full_like(cosine, DISC_THICKNESS)], dim=-1
    )
    return make_observed(
        means=means,
        quats=rotations_to_quats(axes),
        scales=sizes * (sigma * pixel)[:, None],
        opacities=torch.full_like(pixel, OPACITY),
        sh=sh_from_rgb(view.image.reshape(-1, 3)),
    )


def find_flat_pixels(normals: Float[Tensor, "h w 3"]) -> Bool[Tensor, "h w"]:
    """Find the pixels of one plane each: those around which the normals agree."""
    side = 2 * FLAT_RADIUS + 1
    mean = avg_pool2d(
        normals.movedim(-1, 0), side, stride=1, padding=FLAT_RADIUS, count_include_pad=False
    )
    return mean.norm(dim=0) > FLAT_AGREEMENT


def compute_normals(depth: Float[Tensor, "h w"], view: View) -> Float[Tensor, "h w 3"]:
    """Compute unit normals in camera axes, towards the camera, by one-sided differences.

    Central differences would mix two surfaces at the edge of an object.
    """
    camera = view.camera
    # To camera axes.
    rays = camera.z_rays() @ camera.c2w[:3, :3]
    # Depths are divided by about their median, so that squares neither overflow nor vanish. The
    # unit is a power of two, by which a division is exact.
    unit = 2.0 ** depth.median().log2().round().item()
    points = rays * (depth / unit)[..., None]

    def difference(p: Float[Tensor, "a b 3"]) -> Float[Tensor, "a b 3"]:
        # Of the steps to both neighbours the one with less change of depth stays on the surface.
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

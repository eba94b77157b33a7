"""The picture of a cleaning: the splat before, what goes in red, and the splat after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.apps.report.pictures import join_images
from gscompleter.render.lod import DEFAULT_THINNED, MAX_PREVIEW_GAUSSIANS, thin_gaussians
from gscompleter.render.outside import DISTANCE, list_outside_cameras, measure_extent
from gscompleter.render.protocols import FrozenScene, Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.types import Camera, Gaussians, merge

REMOVED_PICTURE_FILE = "removed.png"
NUM_ROWS = 2
"""Rows of the picture. Each is of one camera, of those that see most of what goes."""
PICTURE_SIDE = 384
"""Width and height of an image from outside, in pixels."""
OUTSIDE_ZOOM = 1.5
"""Factor on the focal length of these images, which then show 1.3 times the extent of what stays
instead of twice."""
PREVIEW_SIDE = 64
"""Width and height of the images in which cameras from outside are compared."""
CUT = 0.25
"""Distance of a section through a splat from its middle, towards the camera, in radii of its
extent."""
GAP = 4
"""Pixels between rows."""
REMOVED_COLOR = (1.0, 0.1, 0.1)
"""Red, green and blue of what goes, in [0, 1]."""
DIMMING = 0.5
"""Brightness of what stays beside what goes."""


@dataclass(frozen=True)
class RemovalVisibility:
    """How much a camera sees of what goes."""

    camera: Camera
    removed: float
    """Sum over the pixels of the weights of what goes."""
    shown: float
    """Sum over the pixels of alpha."""


def measure_removal_visibility(
    frozen: FrozenScene, removed: Bool[Tensor, "n"], camera: Camera
) -> RemovalVisibility:
    """Measure how much a camera sees of the Gaussians that go, for which `removed` is True.

    `frozen` is the whole splat, frozen at that camera.
    """
    weights = frozen.splat(removed.to(frozen.render.image))
    return RemovalVisibility(camera, weights.sum().item(), frozen.render.alpha.sum().item())


def choose_outside_cameras(
    given: Gaussians, removed: Bool[Tensor, "n"], renderer: Renderer
) -> tuple[list[Camera], float]:
    """Choose the cameras outside of a splat that see most of what goes.

    The walls of a room hide what goes in it from outside. So each camera is tried twice, with the
    whole splat and with a section that leaves out what stands in front, and the better one counts.

    Returns:
        The cameras, and the share of what goes in what is seen from outside: in the alpha of all
        cameras, without a section.
    """
    kept, gone = split_thinned(given, removed, MAX_PREVIEW_GAUSSIANS)
    both = merge([kept, gone])
    goes = mark_last(both, len(gone))
    extent = measure_extent(kept)
    cameras = list_outside_cameras(extent, PREVIEW_SIDE)
    # Renderers clip at a hundredth of `near` (`Camera.near_plane`).
    near = 100 * (DISTANCE - CUT) * extent.radius
    cut = [replace(camera, near=near) for camera in cameras]

    def measure(camera: Camera) -> RemovalVisibility:
        return measure_removal_visibility(renderer.freeze(both, camera), goes, camera)

    view_map = get_view_map(given.means)
    whole = list(view_map(measure, cameras))
    pairs = zip(whole, view_map(measure, cut), strict=True)
    better = [max(pair, key=lambda seen: seen.removed) for pair in pairs]
    best = choose_most_removed(better)
    share = sum(seen.removed for seen in whole) / max(sum(seen.shown for seen in whole), 1e-12)
    return [enlarge(camera) for camera in best], share


def split_thinned(
    given: Gaussians, removed: Bool[Tensor, "n"], max_gaussians: int
) -> tuple[Gaussians, Gaussians]:
    """Split a splat into what stays and what goes, each of at most about `max_gaussians`.

    Both are without colours by direction, which are most of the memory of a scene.
    """
    plain = replace(given, sh=given.sh[:, :1], encoded=None)
    kept = thin_gaussians(plain[~removed], max_gaussians)
    gone = thin_gaussians(plain[removed], max_gaussians)
    return kept, gone


def mark_last(gaussians: Gaussians, count: int) -> Bool[Tensor, "n"]:
    """Mark the last `count` Gaussians."""
    rows = torch.arange(len(gaussians), device=gaussians.means.device)
    return rows >= len(gaussians) - count


def choose_most_removed(seen: Sequence[RemovalVisibility]) -> list[Camera]:
    """Choose the cameras that see most of what goes; the first of equals."""
    order = sorted(range(len(seen)), key=lambda number: -seen[number].removed)
    return [seen[number].camera for number in order[:NUM_ROWS]]


def enlarge(camera: Camera) -> Camera:
    """Enlarge the images of an outside camera to `PICTURE_SIDE`, with less of what is around."""
    K = camera.K.clone()
    # Focal lengths and centre grow with the image; a longer focal length shows less around it.
    K[:2] *= PICTURE_SIDE / PREVIEW_SIDE
    K[0, 0] *= OUTSIDE_ZOOM
    K[1, 1] *= OUTSIDE_ZOOM
    return replace(camera, K=K, width=PICTURE_SIDE, height=PICTURE_SIDE)


def draw_removal_rows(
    given: Gaussians, removed: Bool[Tensor, "n"], cameras: Sequence[Camera], renderer: Renderer
) -> Float[Tensor, "h w 3"]:
    """Draw a row for each camera: before, what goes in red over a dim grey, and after."""
    kept, gone = split_thinned(given, removed, DEFAULT_THINNED)
    both = merge([kept, gone])
    goes = mark_last(both, len(gone)).to(both.means)
    rows = []
    for camera in cameras:
        frozen = renderer.freeze(both, camera)
        before = frozen.render.image.clamp(0, 1)
        # Compositing weights of what goes. Their square root makes visible what is faint.
        weights = frozen.splat(goes).clamp(0, 1).sqrt()[..., None]
        grey = DIMMING * before.mean(dim=2, keepdim=True)
        marked = grey * (1 - weights) + weights * torch.tensor(REMOVED_COLOR).to(grey)
        after = renderer.render(kept, camera).image
        rows.append(join_images([before, marked, after]))
    # Photographs may have several sizes.
    width = max(row.shape[1] for row in rows)
    white = torch.ones((GAP, width, 3))
    parts = [part for row in rows for part in (white, pad_to_width(row, width))]
    return torch.cat(parts[1:])


def pad_to_width(row: Float[Tensor, "h w 3"], width: int) -> Float[Tensor, "h wide 3"]:
    """Pad an image on the right with white."""
    return pad(row, (0, 0, 0, width - row.shape[1]), value=1.0)

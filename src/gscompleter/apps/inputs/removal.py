"""Choice of the Gaussians to remove: by boxes, a sphere, masks of photographs, or another file."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.apps.inputs.task import CompletionTask, Opened
from gscompleter.apps.requests.splat import Selection
from gscompleter.data.mask_checks import check_selected_share, check_selecting_masks
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.masks import (
    describe_unnamed_masks,
    find_masks_in,
    load_mask,
    make_no_mask_error,
)
from gscompleter.data.photographs import Photographs, Resolution, resize_mask
from gscompleter.numerics.geometry import quats_to_rotations
from gscompleter.render.mask_sums import sum_in_mask
from gscompleter.render.protocols import Renderer
from gscompleter.splats.formats import load_splat, load_splat_at
from gscompleter.splats.origin import format_corners
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.progress import track
from gscompleter.types import Camera, Gaussians

MAX_MARGIN = 0.05
"""Largest margin of regions, relative to the shortest side of the boxes and the sphere's radius.
What is beside a small region stays, however large its Gaussians are: at 0.05 on either side the
region becomes at most a tenth wider, which is chosen, not measured."""


def check_selection(selection: Selection) -> None:
    """Refuse a selection that is missing or impossible, before the scene is opened."""
    if not (selection.boxes or selection.sphere or selection.masks or selection.file):
        raise InputError(
            "Nothing is named that is to be removed; give --box, --sphere, --mask or --select."
        )

    lows, highs = split_boxes(selection.boxes)
    is_finite = bool(np.isfinite(selection.boxes).all())
    if len(selection.boxes) % 6 != 0 or not is_finite or not bool((lows < highs).all()):
        raise InputError(
            "A box needs six numbers: its smallest x, y and z, then its largest; several boxes "
            "need six each.",
            "box",
        )
    if selection.sphere and not (np.isfinite(selection.sphere).all() and selection.sphere[3] > 0):
        raise InputError(
            "A sphere needs a centre of numbers and a positive radius after it.", "sphere"
        )
    if not (np.isfinite(selection.box_rotation).all() and any(selection.box_rotation)):
        raise InputError(
            "A rotation is a quaternion w x y z of numbers that are not all zero.", "box-rotation"
        )
    if not selection.boxes and tuple(selection.box_rotation) != Selection().box_rotation:
        raise InputError("There is no box to rotate; give --box, or leave it out.", "box-rotation")
    if selection.masks and not os.path.isdir(selection.masks):
        raise InputError(f"There is no folder {quote_value(selection.masks)}.", "mask")
    # Read to refuse a damaged file. Of its Gaussians only the positions count.
    if selection.file:
        load_splat(selection.file, selection.drop_nonfinite, ignore_properties=True)


def select_with_masks(
    selection: Selection,
    task: CompletionTask,
    opened: Opened,
    cameras: Mapping[int, Camera],
    renderer: Renderer,
) -> Bool[Tensor, "n"]:
    """Select the Gaussians of the input splat that are selected in any way, by masks as well.

    `cameras` are those of the photographs by frame, in the frame of the splat.

    Raises:
        InputError: Nothing is selected, no mask has a camera, or masks select most of the splat.
    """
    scene = task.scene
    assert scene is not None
    chosen = find_by_position(selection, scene, task.splat_origin)
    if selection.masks:
        photographs = opened.photographs
        masks = find_masks_of(photographs, selection.masks)
        if not masks.keys() & cameras.keys():
            raise InputError(
                f"All masks in {quote_value(selection.masks)} are of photographs that cannot be "
                "used; mark what goes in one that has a camera.",
                "mask",
            )
        resolution = opened.request.resolution
        is_in_masks = find_in_masks(
            masks, scene, photographs, cameras, resolution, renderer, selection.mask_reading
        )
        # Masks that are the other way round select most of the splat.
        check_selected_share(is_in_masks.float().mean().item(), selection.mask_reading)
        chosen |= is_in_masks
    return require_chosen(chosen, selection, scene, task.splat_origin)


def select_without_masks(
    selection: Selection, scene: Gaussians, origin: Float[np.ndarray, "3"]
) -> Bool[Tensor, "n"]:
    """Select Gaussians of a splat that has no photographs.

    Masks are refused: they are named as photographs. `origin` is that of `compute_file_points`.
    """
    if selection.masks:
        raise InputError(
            "Masks are named as photographs, and there are none; select with --box, --sphere or "
            "--select, or name cameras with --cameras and masks as these.",
            "mask",
        )
    chosen = find_by_position(selection, scene, origin)
    return require_chosen(chosen, selection, scene, origin)


def find_by_position(
    selection: Selection, scene: Gaussians, origin: Float[np.ndarray, "3"]
) -> Bool[Tensor, "n"]:
    """Find the Gaussians that boxes, the sphere or the file of a selection select.

    `origin` is that of `compute_file_points`.
    """
    chosen = contain_points(selection, origin, scene.means)
    if selection.file:
        # Programs that save a selection leave positions as they were, so that exactly equal ones
        # are those of the same Gaussians.
        chosen |= find_equal_positions(scene.means, load_selected_means(selection, scene, origin))
    return chosen


def load_selected_means(
    selection: Selection, scene: Gaussians, origin: Float[np.ndarray, "3"]
) -> Float[Tensor, "_m 3"]:
    """Load the means of the file of a selection, in the frame and to the bit of those of the scene.

    `origin` is that of `compute_file_points`.
    """
    assert selection.file is not None
    means = load_splat_at(selection.file, scene.origin, selection.drop_nonfinite).means
    # The file of a scene may lie at the large coordinates of its photographs without an origin of
    # its own. It was then shifted by their origin, in the arithmetic of `shift_to_origin`.
    if scene.origin is None and origin.any():
        means = (means.double() - torch.from_numpy(origin)).float()
    return means.to(scene.means.device)


def find_equal_positions(
    points: Float[Tensor, "n 3"], others: Float[Tensor, "_m 3"]
) -> Bool[Tensor, "n"]:
    """Find the points that are exactly at the position of one of the others."""
    # Equal positions get equal numbers, which can be compared as single values.
    _, numbers = torch.unique(torch.cat([others, points]), dim=0, return_inverse=True)
    return torch.isin(numbers[len(others) :], numbers[: len(others)])


def compute_file_points(
    points: Float[Tensor, "n 3"], origin: Float[np.ndarray, "3"]
) -> Float[Tensor, "n 3"]:
    """Compute points of the scene in the coordinates of the splat's file, in float64.

    The scene is relative to `origin`, a point in these coordinates. It is not zero if they are too
    large for float32, as those of maps.
    """
    return points.double() + torch.from_numpy(origin).to(points.device)


def require_chosen(
    chosen: Bool[Tensor, "n"],
    selection: Selection,
    scene: Gaussians,
    origin: Float[np.ndarray, "3"],
) -> Bool[Tensor, "n"]:
    """Return the mask of chosen Gaussians, or raise InputError if it is empty."""
    if not chosen.any():
        smallest, largest = compute_file_points(scene.means, origin).aminmax(dim=0)
        low, high = format_corners(smallest.tolist(), largest.tolist())
        raise InputError(
            f"No Gaussian of the splat, which reaches from {low} to {high} in its own frame, is "
            f"selected; {advise_selection(selection)}."
        )
    return chosen


def advise_selection(selection: Selection) -> str:
    """Advise, in clauses, what to name instead of a selection that selects nothing."""
    advice = []
    if selection.boxes or selection.sphere:
        advice.append("name another place")
    if selection.masks:
        advice.append("mark in masks the whole of what photographs show")
    if selection.file:
        advice.append(
            "name selected Gaussians that were neither moved nor rounded (an uncompressed .ply)"
        )
    return ", or ".join(advice)


def widen_regions(
    selection: Selection, scene: Gaussians, origin: Float[np.ndarray, "3"]
) -> Selection:
    """Let boxes and the sphere reach farther by one Gaussian of what they enclose.

    The centres of the Gaussians on a face lie on both sides of it: a region drawn exactly on an
    object would leave half of each face standing. The margin is one for all of them, at most
    `MAX_MARGIN`. `origin` is that of `compute_file_points`.
    """
    inside = contain_points(selection, origin, scene.means)
    lengths = [] if selection.sphere is None else [float(selection.sphere[3])]
    lows, highs = split_boxes(selection.boxes)
    lengths += (highs - lows).flatten().tolist()
    if not lengths or not inside.any():
        return selection
    # The size of a Gaussian is the standard deviation along its longest axis.
    size = scene.scales[inside].amax(dim=1).median().item()
    return replace(selection, margin=min(size, MAX_MARGIN * min(lengths)))


def contain_points(
    selection: Selection, origin: Float[np.ndarray, "3"], points: Float[Tensor, "n 3"]
) -> Bool[Tensor, "n"]:
    """Find points of the scene in the boxes or the sphere of a selection.

    `origin` is that of `compute_file_points`.
    """
    return find_in_region(compute_file_points(points, origin), selection)


def find_in_region(points: Float[Tensor, "n 3"], selection: Selection) -> Bool[Tensor, "n"]:
    """Find points, in the coordinates of the file, in the boxes or the sphere of a selection."""
    margin = selection.margin
    inside = find_in_boxes(points, selection.boxes, selection.box_rotation, margin)
    if selection.sphere:
        center = points.new_tensor(selection.sphere[:3])
        inside |= (points - center).norm(dim=1) <= selection.sphere[3] + margin
    return inside


def split_boxes(numbers: Sequence[float]) -> tuple[Float[Tensor, "b 3"], Float[Tensor, "b 3"]]:
    """Split numbers, six for each box, into the smallest and the largest corners; drop the rest."""
    num_boxes = len(numbers) // 6
    corners = torch.tensor(numbers[: 6 * num_boxes], dtype=torch.float64).reshape(-1, 6)
    return corners[:, :3], corners[:, 3:]


def find_in_boxes(
    points: Float[Tensor, "n 3"],
    boxes: Sequence[float],
    rotation: Sequence[float],
    margin: float = 0.0,
) -> Bool[Tensor, "n"]:
    """Find points inside of boxes that a wxyz quaternion rotates about their centres.

    The boxes reach farther by `margin` on every side.
    """
    # A quaternion of any length is the same rotation. Scaled, its square does not overflow.
    largest = max(abs(part) for part in rotation)
    axes = quats_to_rotations(points.new_tensor([part / largest for part in rotation]))

    lows, highs = split_boxes(boxes)
    inside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for low, high in zip(lows.to(points), highs.to(points), strict=True):
        # Row vectors times the rotation are its inverse: from the world into the box's own axes,
        # in which it is |x| <= half of its size.
        local = (points - (low + high) / 2) @ axes
        inside |= (local.abs() <= (high - low) / 2 + margin).all(dim=1)
    return inside


def check_removal_masks(
    folder: Path, names: Sequence[str], files: Sequence[Path | None], reading: MaskReading
) -> None:
    """Refuse masks of a removal that select nothing, or most of most of their photographs.

    `names` are those of all photographs of the scene, and `files` theirs.
    """
    masks = list(find_masks(folder, names, files).values())
    check_selecting_masks(masks, reading, "the photographs")


def find_masks(folder: Path, names: Sequence[str], files: Sequence[Path | None]) -> dict[int, Path]:
    """Find the masks that are named as photographs, by the index of the name in `names`.

    `files` are those of the photographs, None for one without. Raises InputError if there are no
    masks, or if one may be of several photographs.
    """
    found = find_masks_in(folder, names, files, "mask")
    masks = {number: mask for number, mask in enumerate(found) if mask is not None}
    if not masks:
        raise make_no_mask_error(folder, names, "mask")
    return masks


def find_masks_of(photographs: Photographs, folder: Path) -> dict[int, Path]:
    """Find the masks of photographs by frame; errors as those of `find_masks`."""
    return find_masks(folder, [frame.name for frame in photographs.frames], photographs.files)


def describe_parts_in_vain(
    selection: Selection, scene: Gaussians, origin: Float[np.ndarray, "3"]
) -> list[str]:
    """Describe the boxes, the sphere and the rows of the file of a selection that select nothing.

    None if nothing else is selected either, which is an error (`require_chosen`). `origin` is that
    of `compute_file_points`.
    """
    lines = []
    points = compute_file_points(scene.means, origin)
    num_boxes = len(selection.boxes) // 6
    selects = bool(selection.masks)
    for number in range(num_boxes):
        box = selection.boxes[6 * number : 6 * number + 6]
        if find_in_boxes(points, box, selection.box_rotation, selection.margin).any():
            selects = True
        else:
            lines.append(f"Box {number + 1} of {num_boxes} contains no Gaussian.")
    if selection.sphere:
        if find_in_region(points, replace(selection, boxes=())).any():
            selects = True
        else:
            lines.append("The sphere contains no Gaussian.")
    if selection.file:
        means = load_selected_means(selection, scene, origin)
        num_missing = int((~find_equal_positions(means, scene.means)).sum())
        selects |= num_missing < len(means)
        if num_missing:
            lines.append(
                f"{num_missing:,} of {len(means):,} Gaussians of {quote_value(selection.file)} are "
                "at no position of the splat, and select nothing."
            )
    return lines if selects else []


def describe_masks_in_vain(
    photographs: Photographs, cameras: Mapping[int, Camera], folder: Path
) -> list[str]:
    """Describe the masks of a removal that no photograph with a camera in `cameras` has."""
    masks = find_masks_of(photographs, folder)
    used = [mask for number, mask in masks.items() if number in cameras]
    return describe_unnamed_masks(folder, used, photographs.files)


def find_in_masks(
    masks: Mapping[int, Path],
    scene: Gaussians,
    photographs: Photographs,
    cameras: Mapping[int, Camera],
    resolution: Resolution,
    renderer: Renderer,
    reading: MaskReading = MaskReading(),
) -> Bool[Tensor, "n"]:
    """Find Gaussians of which photographs show more inside of their masks than outside.

    `masks` and `cameras` are by frame; photographs without a mask or a camera do not count. A mask
    is scaled to its photograph; one of another aspect ratio raises an InputError.
    """
    # Columns of `sum_in_mask`: how much of each Gaussian is seen inside of masks, outside, and 0.
    sums = torch.zeros_like(scene.means)
    for number in track([number for number in masks if number in cameras], "masks"):
        frame = photographs.frame(number)
        size = frame.size()
        turn = frame.find_turn()
        # `load_mask` marks black pixels, which masks of a scene hide, or white ones if masks are
        # inverted. Of a removal the others are what goes.
        selected = ~load_mask(masks[number], size, frame.title, turn, reading.is_inverted)
        mask = resize_mask(frame, selected, size, resolution)
        frozen = renderer.freeze(scene, cameras[number])
        sums += sum_in_mask(frozen, torch.from_numpy(mask).to(sums))
    return sums[:, 0] > sums[:, 1]

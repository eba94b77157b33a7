"""Equirectangular panoramas, split into pinhole views that share one centre.

A panorama shows all directions: longitude along its width, latitude along its height. Axes are
those of a camera that faces its middle (x right, y down, z forward). No view looks down, where the
operator or the tripod is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageOps

from gscompleter.data.cameras import remap
from gscompleter.data.limits import require
from gscompleter.system.errors import quote_value
from gscompleter.system.files.image import (
    QUARTER_TURNS,
    read_brightness,
    read_image_size,
    read_orientation,
    reduce_to_rgb,
)
from gscompleter.system.files.image_opening import open_image
from gscompleter.system.files.reading import read_head

VIEWS = (*((yaw, 0) for yaw in range(0, 360, 60)), *((yaw, 50) for yaw in range(0, 360, 120)))
"""Yaw and pitch (upwards) of the views in degrees, each 90° wide; the first faces the middle."""
MAX_VIEW_SIDE = 1600
"""Largest side of a view in pixels."""
REPEATED_COLUMNS = 4
"""Columns of each border that are repeated beyond the other one, in pixels."""
GPANO_MARK = b"equirectangular"
"""Value of `ProjectionType` in Google's metadata of photo spheres (GPano), by which they are known.
"""
METADATA_BYTES = 1 << 18
"""First bytes of a file that hold the metadata."""
SMALL_WIDTH = 1024
"""Width at which borders are compared, in pixels."""
MAX_SEAM = 3.0
"""Largest mean difference of the left and right border of a panorama, relative to the median of
neighbouring columns."""
MAX_POLE = 0.5
"""Largest standard deviation along the upper and lower border of a panorama, relative to the median
of all rows."""
MIN_STRUCTURE = 0.3
"""Smallest standard deviation along the left border of a panorama, relative to the median of all
columns."""


def has_panoramas(files: Sequence[Path]) -> bool:
    """Return True if photographs are panoramas; raise InputError for those of several sizes.

    Only photographs that are upright exactly twice as wide as high may be panoramas. All of them
    count as such if the metadata of one say so, or if the borders of more than half of them meet as
    on a sphere.
    """
    sizes = [read_image_size(path) for path in files]
    wide = [
        path
        for path, (width, height) in zip(files, sizes, strict=True)
        if width == 2 * height and read_orientation(path) not in QUARTER_TURNS
    ]
    marked = any(GPANO_MARK in read_head(path, METADATA_BYTES) for path in wide)
    if not marked:
        num_closed = sum(_is_closed(path) for path in wide)
        if 2 * num_closed <= len(wide):
            return False
    require(
        len(set(sizes)) == 1,
        f"Beside {quote_value(wide[0], 80)} and other panoramas lie photographs of other sizes; "
        "put panoramas of one size into a folder of their own.",
    )
    return True


def _is_closed(path: Path) -> bool:
    """Return True if left and right border continue each other, and each pole is one point."""
    pixels = read_brightness(path, SMALL_WIDTH)
    # Differences from each column to the next; the last one is across the seam.
    steps = np.abs(np.diff(pixels, axis=1, append=pixels[:, :1])).mean(axis=0)
    rows = pixels.std(axis=1)
    columns = pixels.std(axis=0)
    # The first and last row show a pole alone and vary little. A border of one colour, as of a
    # plain background, is no evidence.
    return bool(
        steps[-1] < MAX_SEAM * np.median(steps)
        and max(rows[0], rows[-1]) < MAX_POLE * np.median(rows)
        and columns[0] > MIN_STRUCTURE * np.median(columns)
    )


def split_panorama(
    path: Path, hidden: Bool[np.ndarray, "h w"] | None = None
) -> Iterator[tuple[UInt8[np.ndarray, "s s 3"], Bool[np.ndarray, "s s"] | None]]:
    """Draw the `VIEWS` of a panorama and of its mask, at its resolution or `MAX_VIEW_SIDE`.

    `hidden` are the pixels of the upright panorama that its mask hides, or None without one. Yields
    the colours of each view, and its hidden pixels or None.
    """
    # At this width of the panorama a view is `MAX_VIEW_SIDE` wide (see `_project_rays`).
    widest = math.ceil(math.pi * MAX_VIEW_SIDE)
    with open_image(path) as image:
        # A JPEG is decoded at a fraction of its size if that is enough.
        image.draft("RGB", (widest, widest // 2))
        panorama = reduce_to_rgb(ImageOps.exif_transpose(image))
    panorama.thumbnail((widest, widest), Image.Resampling.LANCZOS)
    # Repeated columns let the interpolation continue across the seam.
    pixels = np.pad(
        np.asarray(panorama), ((0, 0), (REPEATED_COLUMNS, REPEATED_COLUMNS), (0, 0)), mode="wrap"
    )
    padded_mask = None
    if hidden is not None:
        scaled = Image.fromarray(hidden).resize(panorama.size, Image.Resampling.NEAREST)
        padded_mask = np.pad(
            np.asarray(scaled, np.uint8),
            ((0, 0), (REPEATED_COLUMNS, REPEATED_COLUMNS)),
            mode="wrap",
        )
    for yaw, pitch in VIEWS:
        places = _project_rays(compute_view_rotation(yaw, pitch), panorama.width)
        colors = remap(pixels, places, cv2.INTER_CUBIC)
        if padded_mask is None:
            yield colors, None
        else:
            yield colors, remap(padded_mask, places, cv2.INTER_NEAREST) > 0


def _project_rays(rotation: Float[np.ndarray, "3 3"], width: int) -> Float[np.ndarray, "s s 2"]:
    """Project the pixels of a view to positions (x, y) in a panorama with repeated columns.

    `rotation` is that of `compute_view_rotation`, and `width` that of the panorama without them.
    """
    # A 90° view reaches from -1 to 1 at z = 1. Its centre keeps the resolution of the panorama's
    # equator, which has width / 2π pixels per radian: half of the side of the view per unit.
    side = round(width / math.pi)
    places = (np.arange(side) + 0.5) / side * 2 - 1
    rays = np.stack([*np.meshgrid(places, places), np.ones((side, side))], axis=-1) @ rotation.T
    longitude = np.arctan2(rays[..., 0], rays[..., 2])
    latitude = np.arctan2(rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
    # `remap` counts from pixel centres: 0 is the centre of the first repeated column.
    x = (longitude / (2 * np.pi) + 0.5) * width - 0.5 + REPEATED_COLUMNS
    y = (latitude / np.pi + 0.5) * width / 2 - 0.5
    return np.stack([x, y], axis=-1).astype(np.float32)


def compute_view_rotation(yaw: int, pitch: int) -> Float[np.ndarray, "3 3"]:
    """Compute the rotation from the axes of a view (degrees) to those of its panorama."""
    turned = (0.0, math.radians(yaw), 0.0)
    raised = (math.radians(pitch), 0.0, 0.0)
    return cv2.Rodrigues(np.array(turned))[0] @ cv2.Rodrigues(np.array(raised))[0]

"""Painted images of targets, read from a folder."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from gscompleter.apps.inputs.holes_file import HOLES_FILE, HoleRow, has_holes, read_holes
from gscompleter.apps.inputs.named_photographs import add_photograph
from gscompleter.apps.inputs.task import Target
from gscompleter.data.photographs import Photographs, Resolution
from gscompleter.data.scene import load_cameras
from gscompleter.generators.painted import Painting, fit_mask, fit_painting
from gscompleter.numerics.geometry import is_same_camera
from gscompleter.system.errors import InputError, join_names, quote_value
from gscompleter.system.files.image import (
    HALF_OPAQUE,
    convert_to_image,
    read_colors_and_alpha,
    read_mask,
)
from gscompleter.system.files.reading import read_bytes
from gscompleter.types import Camera

ENDINGS = (".png", ".jpg", ".jpeg", ".webp")
"""Endings of painted images."""


def check_paintings(folder: Path, num_targets: int) -> None:
    """Find and read all images of a folder, before the scene is opened.

    `num_targets` are those named on the command line; without any, `holes.json` has them.
    """
    if not os.path.isdir(folder):
        raise InputError(
            f"There is no folder {quote_value(folder)}; name that of the painted images.", "images"
        )
    if has_holes(folder):
        # Which of them the targets need is known when the cameras are.
        for row in read_holes(folder).frames if num_targets == 0 else ():
            read_colors_and_alpha(find_painted(folder, row.image_path, row))
    elif num_targets == 0:
        raise InputError(
            f"{quote_value(folder)} has no {HOLES_FILE}, which tells the cameras of the images; "
            "copy that of the export there, or name the targets.",
            "target",
        )


def read_paintings(
    targets: Sequence[Target], photographs: Photographs, resolution: Resolution, folder: Path
) -> list[Target]:
    """Add its painted image to each target, and to those of `holes.json` what is known of them.

    Cameras of the targets are as they were read, in the frame of the photographs.
    """
    if not has_holes(folder):
        names = [f"target{number}.png" for number in range(1, len(targets) + 1)]
        return [
            replace(target, painting=read_painting(find_painted(folder, name), target.camera))
            for target, name in zip(targets, names, strict=True)
        ]

    rows = read_holes(folder).frames
    origin = photographs.origin.tolist()
    cameras = load_cameras(folder / HOLES_FILE, resolution, origin=origin)
    painted = []
    for number, target in enumerate(targets, start=1):
        row = find_row(target.camera, rows, cameras)
        if row is None:
            raise InputError(
                f"{quote_value(folder / HOLES_FILE)} has no image for the camera of target "
                f"{number}; leave the targets out to take all that were exported, or export this "
                "one too.",
                "target",
            )
        painting = read_painting(find_painted(folder, row.image_path, row), target.camera, row)
        named = name_target(target, row, photographs, resolution)
        painted.append(replace(named, painting=painting))
    return painted


def find_row(camera: Camera, rows: Sequence[HoleRow], cameras: Sequence[Camera]) -> HoleRow | None:
    """Find the row of a camera; None if its hole was not exported."""
    same = (row for row, known in zip(rows, cameras, strict=True) if is_same_camera(camera, known))
    return next(same, None)


def name_target(
    target: Target, row: HoleRow, photographs: Photographs, resolution: Resolution
) -> Target:
    """Add the photograph that a target is, or was derived from, as the export knew it."""
    if target.frame is not None:
        return target
    frame = row.frame
    if frame is not None and frame in range(len(photographs)):
        # A scene that got photographs since then numbers them in another way.
        camera = photographs.camera(frame, resolution)
        if is_same_camera(camera, target.camera):
            return add_photograph(replace(target, frame=frame), photographs, resolution)
    base = row.derived_from
    if base is not None and base in range(len(photographs)):
        return replace(target, derived_from=base, offset=row.offset)
    return target


def find_painted(folder: Path, name: str, row: HoleRow | None = None) -> Path:
    """Find the painted image that is named like `name`, with any of the endings.

    The exported image itself is not painted; a painted one may lie beside it.
    """
    stem = Path(name).stem
    found = sorted(
        path
        for path in folder.iterdir()
        if path.stem == stem and path.suffix.lower() in ENDINGS and path.is_file()
    )
    painted = [path for path in found if row is None or not is_exported(path, row)]
    if len(painted) == 1:
        return painted[0]
    if painted:
        names = join_names([path.name for path in painted], len(ENDINGS))
        raise InputError(
            f"{quote_value(folder)} has several images of one target ({names}); keep one of them.",
            "images",
        )
    if found:
        raise InputError(
            f"{quote_value(found[0])} is as it was exported; paint what "
            f"{quote_value(row.hole_mask_path if row else '')} shows white, or take its entry out "
            f"of {HOLES_FILE}.",
            "images",
        )
    raise InputError(
        f"{quote_value(folder)} has no {stem}.png (or .jpg, .webp); paint it, or name the targets "
        "that are painted.",
        "images",
    )


def is_exported(path: Path, row: HoleRow) -> bool:
    """Check whether an image has the bytes that were exported."""
    return hashlib.sha256(read_bytes(path)).hexdigest() == row.sha256


def read_painting(path: Path, camera: Camera, row: HoleRow | None = None) -> Painting:
    """Read a painted image at the size of its camera, with the mask of the export beside it."""
    colors, alpha = read_colors_and_alpha(path)
    opaque = np.full(colors.shape[:2], True) if alpha is None else alpha >= HALF_OPAQUE
    camera = camera.to("cpu")
    painting = fit_painting(convert_to_image(colors), torch.from_numpy(opaque), camera, path.name)
    mask = path.with_name(row.hole_mask_path) if row else None
    if mask is None or not mask.is_file():
        return painting
    # `read_mask` has what is black.
    asked = fit_mask(torch.from_numpy(~read_mask(mask)), camera, mask.name)
    return replace(painting, asked=asked)

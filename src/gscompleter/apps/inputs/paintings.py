"""Painted images of targets, read from a folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from gscompleter.apps.inputs.holes_file import (
    HOLES_FILE,
    HoleRow,
    PathRow,
    has_holes,
    read_holes,
)
from gscompleter.apps.inputs.named_photographs import add_photograph
from gscompleter.apps.inputs.task import Target
from gscompleter.data.photograph_names import name_target
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
from gscompleter.system.files.reading import hash_file
from gscompleter.system.files.video import read_video
from gscompleter.types import Camera

PAINTING_ENDINGS = (".png", ".jpg", ".jpeg", ".webp")
"""Endings of painted images."""
VIDEO_ENDINGS = (".mp4", ".mov", ".mkv", ".webm")
"""Endings of videos along the targets, which were repaired in place of their images."""


def check_paintings(folder: Path, num_targets: int) -> None:
    """Check a folder of painted images as far as it can be before the scene is opened.

    `num_targets` is the number of targets named on the command line. Without any, `holes.json` has
    the targets, and all of their images are found and read.
    """
    if not os.path.isdir(folder):
        raise InputError(
            f"There is no folder {quote_value(folder)}; name that of the painted images.", "images"
        )
    if has_holes(folder):
        holes = read_holes(folder)
        # Named targets need some of the images: those of their cameras, which are not known yet.
        if num_targets == 0:
            for source in find_sources(folder, holes.frames, holes.path):
                if not is_video_file(source):
                    read_colors_and_alpha(source)
    elif num_targets == 0:
        raise InputError(
            f"{quote_value(folder)} has no {HOLES_FILE}, which tells the cameras of the images; "
            "copy that of the export there, or name the targets.",
            "target",
        )


def read_paintings(
    targets: Sequence[Target], photographs: Photographs, resolution: Resolution, folder: Path
) -> list[Target]:
    """Add its painted image to each target, and the photograph that `holes.json` knows for it.

    Cameras of the targets are as they were read, in the frame of the photographs. Without a
    `holes.json` the images are called target1, target2, … in the order of the targets.
    """
    if not has_holes(folder):
        painted = []
        for number, target in enumerate(targets, start=1):
            name = f"target{number}.png"
            source = find_by_stem(folder, name, PAINTING_ENDINGS)
            if source is None:
                raise make_unpainted_error(folder, name)
            painted.append(replace(target, painting=read_painting(source, target.camera)))
        return painted

    holes = read_holes(folder)
    origin = photographs.origin.tolist()
    cameras = load_cameras(folder / HOLES_FILE, resolution, origin=origin)
    rows = []
    for number, target in enumerate(targets, start=1):
        row = find_row(target.camera, holes.frames, cameras)
        if row is None:
            raise InputError(
                f"{quote_value(folder / HOLES_FILE)} has no image for the camera of target "
                f"{number}; leave the targets out to take all that were exported, or export this "
                "one too.",
                "target",
            )
        rows.append(row)
    sources = find_sources(folder, rows, holes.path)
    stills = read_video_frames(sources, rows, holes.path)
    return [
        replace(
            add_exported_photograph(target, row, photographs, resolution),
            painting=read_painting(source, target.camera, row, still),
        )
        for target, row, source, still in zip(targets, rows, sources, stills, strict=True)
    ]


def is_video_file(source: Path) -> bool:
    """Check whether what was painted is a video, rather than an image."""
    return source.suffix.lower() in VIDEO_ENDINGS


def find_sources(folder: Path, rows: Sequence[HoleRow], exported: PathRow | None) -> list[Path]:
    """Find what was painted for each target: its image, or else the repaired video.

    `exported` describes the video along the targets, None without one. Raise InputError for a
    target that has neither.
    """
    # Telling a repaired video from the exported one reads all of it, so that is done once.
    find_repaired = cache(partial(find_repaired_video, folder, exported))
    sources = []
    for row in rows:
        source = find_by_stem(folder, row.image_path, PAINTING_ENDINGS, row.sha256)
        if source is None and row.path_frame is not None:
            source = find_repaired()
        if source is None:
            raise make_unpainted_error(folder, row.image_path, row)
        sources.append(source)
    return sources


def find_repaired_video(folder: Path, exported: PathRow | None) -> Path | None:
    """Find the video that was painted in place of images; None if there is only the exported."""
    if exported is None:
        return None
    return find_by_stem(folder, exported.video_path, VIDEO_ENDINGS, exported.sha256)


def read_video_frames(
    sources: Sequence[Path], rows: Sequence[HoleRow], exported: PathRow | None
) -> list[UInt8[np.ndarray, "h w 3"] | None]:
    """Read the frame of each target that is painted in the video; None for the others.

    `sources` are those of `find_sources`, and `exported` describes the exported video. Raise
    InputError if the repaired one has another number of frames than that.
    """
    numbers = [
        row.path_frame if is_video_file(source) else None
        for source, row in zip(sources, rows, strict=True)
    ]
    wanted = set(numbers) - {None}
    if not wanted or exported is None:
        return [None] * len(sources)

    # All of them are frames of the same video.
    video = next(filter(is_video_file, sources))
    # Only the wanted frames are kept, since all of them would fill the memory.
    frames = {}
    count = 0
    for frame in read_video(video, "null", is_grey=False):
        if count in wanted:
            frames[count] = frame
        count += 1
    if count != exported.num_frames:
        raise InputError(
            f"{quote_value(video)} has {count} frames, and {exported.num_frames} were exported; "
            "keep all of them, whatever their size and rate.",
            "images",
        )
    return [None if number is None else frames[number] for number in numbers]


def find_row(camera: Camera, rows: Sequence[HoleRow], cameras: Sequence[Camera]) -> HoleRow | None:
    """Find the row of a camera; None if its hole was not exported."""
    same = (row for row, known in zip(rows, cameras, strict=True) if is_same_camera(camera, known))
    return next(same, None)


def add_exported_photograph(
    target: Target, row: HoleRow, photographs: Photographs, resolution: Resolution
) -> Target:
    """Add the photograph that a target is, or was derived from, as the export knew it.

    A scene that got photographs since the export numbers them in another way, so that the number in
    the row alone is not believed.
    """
    if target.frame is not None:
        return target
    frame = row.frame
    # A photograph without a camera is another one than the target was.
    if frame is not None and frame in photographs.posed:
        # The camera tells whether the number is still that of the same photograph.
        camera = photographs.camera(frame, resolution)
        if is_same_camera(camera, target.camera):
            return add_photograph(replace(target, frame=frame), photographs, resolution)
    base = row.derived_from
    if base is not None and base in range(len(photographs)):
        # Here the name of the target tells it, since that holds the name of the file.
        file = photographs.frame(base).file_name
        if name_target(None, file, base, row.offset) == row.title:
            return replace(target, derived_from=base, offset=row.offset)
    return target


def make_unpainted_error(folder: Path, name: str, row: HoleRow | None = None) -> InputError:
    """Make the error of a target without a painted image, which `name` would be.

    `row` is its entry in `holes.json`; None without that file.
    """
    if row is not None and find_by_stem(folder, name, PAINTING_ENDINGS) is not None:
        return InputError(
            f"{quote_value(folder / name)} is as it was exported; paint what "
            f"{quote_value(row.hole_mask_path)} shows white, or take its entry out of "
            f"{HOLES_FILE}.",
            "images",
        )
    return InputError(
        f"{quote_value(folder)} has no {Path(name).stem}.png (or .jpg, .webp); paint it, or name "
        "the targets that are painted.",
        "images",
    )


def find_by_stem(
    folder: Path, name: str, endings: Sequence[str], exported: str | None = None
) -> Path | None:
    """Find the only file that `list_by_stem` lists; None without any, InputError for several."""
    found = list_by_stem(folder, name, endings, exported)
    if len(found) > 1:
        names = join_names([path.name for path in found], len(endings))
        kind = "images of one target" if endings == PAINTING_ENDINGS else "repaired videos"
        raise InputError(
            f"{quote_value(folder)} has several {kind} ({names}); keep one of them.", "images"
        )
    return found[0] if found else None


def list_by_stem(
    folder: Path, name: str, endings: Sequence[str], exported: str | None = None
) -> list[Path]:
    """List the files that are named like `name` with any of the endings, but not the exported one.

    `exported` is the SHA-256 of that one; None if every file counts.
    """
    found = sorted(
        path
        for path in folder.iterdir()
        if path.stem == Path(name).stem and path.suffix.lower() in endings and path.is_file()
    )
    return [path for path in found if exported is None or hash_file(path) != exported]


def read_painting(
    path: Path,
    camera: Camera,
    row: HoleRow | None = None,
    still: UInt8[np.ndarray, "h w 3"] | None = None,
) -> Painting:
    """Read a painted image at the size of its camera, with the mask of the export beside it.

    `still` is the frame of the target, if `path` is a video. Without the mask, as for a layer that
    lies in another folder, the hole that the scene has now tells what was asked for.
    """
    colors, alpha = (still, None) if still is not None else read_colors_and_alpha(path)
    opaque = np.full(colors.shape[:2], True) if alpha is None else alpha >= HALF_OPAQUE
    camera = camera.to("cpu")
    painting = fit_painting(
        convert_to_image(colors), torch.from_numpy(opaque), camera, quote_value(path.name)
    )
    mask = path.with_name(row.hole_mask_path) if row else None
    if mask is None or not mask.is_file():
        return painting
    # `read_mask` marks black pixels, and what was asked for is white.
    asked = fit_mask(torch.from_numpy(~read_mask(mask)), camera, quote_value(mask.name))
    return replace(painting, asked=asked)

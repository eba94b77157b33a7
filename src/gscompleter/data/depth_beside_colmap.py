"""Depth maps that lie beside a COLMAP model.

* Dense stereo of COLMAP writes `stereo/depth_maps/NAME.geometric.bin` (or `.photometric.bin`):
  width, height and channels in text, each with `&` behind it, then z-depth as float32, row by row.
* 3DGS regularises its training by inverse depth that a network predicted: images
  `depths/NAME.png` without the ending of the photograph, and `depth_params.json` in the folder of
  the model. Inverse z-depth in scene units is `value / 65536 * scale + offset`, with a scale and an
  offset for each photograph, fitted to COLMAP's points.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np
from jaxtyping import Float

from gscompleter.data.file_names import FolderListings
from gscompleter.data.frame import Frame, find_file
from gscompleter.data.json_fields import get_number
from gscompleter.data.limits import MAX_NUMBER, require
from gscompleter.system.errors import InputError, join_names, quote_value
from gscompleter.system.files.image_opening import open_image
from gscompleter.system.files.reading import read_bytes, read_json
from gscompleter.types import MAX_IMAGE_SIDE

DENSE = "stereo/depth_maps"
"""Folder of COLMAP's dense depth."""
DENSE_ENDINGS = (".geometric.bin", ".photometric.bin")
"""Its files after the name of the photograph; the first are checked against other photographs."""
DEPTH_PARAMETERS_FILE = "depth_params.json"
"""File with the scale and offset of each map of inverse depth."""
INVERSE_FOLDERS = ("depths", "depth", "depths_any")
"""Folders of inverse depth, as the pages of 3DGS and its successors call them."""
FULL_SCALE = 65536
"""Divisor of the values of inverse depth."""
MAX_SCALE_RATIO = 5.0
"""Largest ratio of a scale to the median of all, either way; 3DGS trusts no other map."""
MIN_INVERSE_SHARE = 0.02
"""Smallest inverse depth that is read, relative to the largest of its map. Below it lies the sky,
where the error of a prediction is a multiple of what it says."""
DENSE_KIND = "depth of COLMAP's dense stereo"
INVERSE_KIND = "inverse depth of 3DGS"
DEPTH_KINDS = (DENSE_KIND, INVERSE_KIND)
"""Names of the two kinds in notes, by which the report tells them from the depth of points."""
MAX_UNSCALED_PHOTOGRAPHS = 3
"""Photographs that a note names."""


def attach_depth_maps(
    frames: Sequence[Frame], roots: Sequence[Path], model: Path
) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Attach the depth maps of photographs, and say which kind was found.

    Args:
        frames: Frames of a model.
        roots: Folders from that of the model up to that of the scene.
        model: Folder of the model.
    """
    listings = FolderListings()
    dense = [_find_dense(frame, roots, listings) for frame in frames]
    count = sum(path is not None for path in dense)
    notes: list[str] = []
    if count:
        frames = [
            frame if path is None else replace(frame, depth=partial(read_dense, path))
            for frame, path in zip(frames, dense, strict=True)
        ]
        notes.append(f"{count} of {len(frames)} photographs have {DENSE_KIND}.")
    if not os.path.isfile(model / DEPTH_PARAMETERS_FILE):
        return tuple(frames), tuple(notes)

    parameters = read_parameters(model / DEPTH_PARAMETERS_FILE)
    predicted = [_attach_predicted(frame, roots, parameters, listings) for frame in frames]
    count = sum(frame.predicted_depth is not None for frame in predicted)
    folders = ", ".join(INVERSE_FOLDERS)
    note = f"{count} of {len(frames)} photographs have {INVERSE_KIND} ({DEPTH_PARAMETERS_FILE})"
    if count == 0:
        note += f"; its maps are searched in {folders} beside the photographs, as NAME.png"
    distrusted = [frame.name for frame in frames if _is_distrusted(frame, parameters)]
    if distrusted:
        names = join_names(distrusted, MAX_UNSCALED_PHOTOGRAPHS)
        note += f"; that of {names} is not used, because its scale is none or far from the others"
    return tuple(predicted), (*notes, f"{note}.")


def _find_dense(frame: Frame, roots: Sequence[Path], listings: FolderListings) -> Path | None:
    return find_file(roots, [f"{DENSE}/{frame.name}{end}" for end in DENSE_ENDINGS], listings)


def _attach_predicted(
    frame: Frame,
    roots: Sequence[Path],
    parameters: Mapping[str, tuple[float, float]],
    listings: FolderListings,
) -> Frame:
    stem = os.path.splitext(frame.name)[0]
    if stem not in parameters or _is_distrusted(frame, parameters):
        return frame
    names = [f"{folder}/{stem}.png" for folder in INVERSE_FOLDERS]
    path = find_file(roots, names, listings)
    if path is None:
        return frame
    scale, offset = parameters[stem]
    return replace(frame, predicted_depth=partial(read_inverse_depth, path, scale, offset))


def _is_distrusted(frame: Frame, parameters: Mapping[str, tuple[float, float]]) -> bool:
    """Return True if 3DGS would not use the map of a photograph, by its scale."""
    stem = os.path.splitext(frame.name)[0]
    if stem not in parameters:
        return False
    scale = parameters[stem][0]
    middle = median([one for one, _ in parameters.values() if one > 0] or [0.0])
    # A scale of zero is written where a photograph shows too few points to fit one.
    return scale <= 0 or not middle / MAX_SCALE_RATIO <= scale <= MAX_SCALE_RATIO * middle


def read_parameters(path: Path) -> dict[str, tuple[float, float]]:
    """Read scale and offset by the name of the photograph, without its ending."""
    advice = "write it again with make_depth_scale.py of 3DGS"
    content = read_json(path, advice)
    require(
        isinstance(content, dict),
        f"{quote_value(path)} is no list of scales by the names of photographs; {advice}.",
    )
    parameters = {}
    for name, entry in content.items():
        title = f"{quote_value(name)} in {quote_value(path)}"
        scale = get_number(entry, "scale", title, -MAX_NUMBER, MAX_NUMBER)
        parameters[name] = scale, get_number(entry, "offset", title, -MAX_NUMBER, MAX_NUMBER)
    return parameters


def read_inverse_depth(path: Path, scale: float, offset: float) -> Float[np.ndarray, "h w"]:
    """Read z-depth in scene units from an image of inverse depth; 0 where it is unknown."""
    with open_image(path) as image:
        values = np.array(image)
    # Programs write grey values as three equal channels, too.
    values = values[..., 0] if values.ndim == 3 else values
    inverse = values.astype(np.float64) / FULL_SCALE * scale + offset
    known = inverse > MIN_INVERSE_SHARE * inverse.max(initial=0.0)
    return np.where(known, 1 / inverse.clip(1e-12), 0.0).astype(np.float32)


def read_dense(path: Path) -> Float[np.ndarray, "h w"]:
    """Read z-depth in scene units of COLMAP's dense stereo; 0 where it is unknown."""
    data = read_bytes(path)
    try:
        width, height, channels, values = data.split(b"&", 3)
        size = int(width), int(height)
        if int(channels) != 1 or not all(1 <= side <= MAX_IMAGE_SIDE for side in size):
            raise ValueError("it is no map of one channel")
        depth = np.frombuffer(values, "<f4").reshape(size[1], size[0])
    except ValueError as error:
        raise InputError(
            f"{quote_value(path)} is no depth map of COLMAP, or ends too early; run dense stereo "
            "again, or move it away."
        ) from error
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0.0).astype(np.float32)

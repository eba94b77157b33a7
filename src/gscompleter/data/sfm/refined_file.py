"""Refined poses in a file of a result, which later commands and other programs read.

The file has the keys of nerfstudio's `transforms.json`. Poses are camera-to-world in OpenGL axes
and in the frame of the given poses; intrinsics are those of the photographs without distortion. A
hash of the names and the given poses tells which photographs it belongs to. It lists the refined
cameras alone, and none if the given poses are kept.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gscompleter.data.cameras import find_pose_defect
from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm.refining import PoseRefinement
from gscompleter.data.transforms import OPENCV_FROM_OPENGL
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.result_format import RESULT_MARK
from gscompleter.system.files.typed_json import read_typed_json
from gscompleter.system.files.writing import replace_file

REFINED_POSES_ADVICE = "take it from its folder again, or move it away to use the given poses"


@dataclass(frozen=True)
class RefinedFrame:
    """A photograph with its refined pose; other keys of a frame are for other programs."""

    file_path: str
    """File of the photograph, as in `Frame.file_name`."""
    transform_matrix: list[list[float]]
    """Camera-to-world matrix [4, 4] in OpenGL axes."""


@dataclass(frozen=True)
class RefinedFile:
    """The keys of the file that a later command reads."""

    given: str
    """Hash of the photographs as they were given (`hash_poses`)."""
    frames: list[RefinedFrame]
    refinement: PoseRefinement | None = None
    """What the refinement did; None if none was tried."""


def write_refined(
    path: Path,
    given: Photographs,
    refined: Photographs,
    refinement: PoseRefinement | None,
    keep_existing: bool = False,
) -> None:
    """Write the refined poses, those that differ from the given ones.

    `refined` has the frames of `given`, and perhaps more after them. `keep_existing` is that of
    `replace_file`.
    """
    frames: list[dict[str, Any]] = []
    # Photographs that were placed among the given ones come after these, in a file of their own.
    for number, (before, frame) in enumerate(zip(given.frames, refined.frames, strict=False)):
        # A refinement makes a new array of a pose that it changes, and shares the others. Compared
        # by value, a photograph without a pose, whose numbers are NaN, would count as changed.
        if frame.c2w is before.c2w:
            continue
        camera = refined.camera(number)
        (fl_x, _, cx), (_, fl_y, cy), _ = camera.K.double().tolist()
        # The change of axes is its own inverse, so that reading applies it once more.
        matrix = (frame.c2w @ OPENCV_FROM_OPENGL).tolist()
        row = RefinedFrame(frame.file_name, matrix)
        size = {"w": camera.width, "h": camera.height}
        frames.append({**asdict(row), **size, "fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy})
    content = {
        **RESULT_MARK,
        "camera_model": "PINHOLE",
        "given": hash_poses(given),
        "refinement": None if refinement is None else asdict(refinement),
        "frames": frames,
    }
    with replace_file(path, keep_existing) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


def take_refined(
    photographs: Photographs, path: Path
) -> tuple[Photographs, PoseRefinement | None] | None:
    """Return photographs with the poses of a file, and what the refinement did.

    The answer as a whole is None if the file belongs to other photographs, or to these with other
    given poses; what the refinement did is None if none was tried.
    """
    content = read_typed_json(RefinedFile, path, REFINED_POSES_ADVICE)
    if content.given != hash_poses(photographs):
        return None
    poses = {}
    for row in content.frames:
        c2w = np.array(row.transform_matrix, dtype=np.float64)
        if c2w.shape != (4, 4) or find_pose_defect(c2w) is not None:
            raise InputError(
                f"{quote_value(path)} is damaged: it has no pose of {quote_value(row.file_path)}; "
                f"{REFINED_POSES_ADVICE}."
            )
        poses[row.file_path] = c2w @ OPENCV_FROM_OPENGL
    frames = [
        replace(frame, c2w=poses[frame.file_name]) if frame.file_name in poses else frame
        for frame in photographs.frames
    ]
    return replace(photographs, frames=tuple(frames)), content.refinement


def hash_poses(photographs: Photographs) -> str:
    """Hash the names and the poses of photographs, in SHA-256."""
    digest = hashlib.sha256()
    for frame in photographs.frames:
        digest.update(frame.file_name.encode(errors="surrogateescape"))
        digest.update(frame.c2w.tobytes())
    return digest.hexdigest()

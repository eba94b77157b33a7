"""`strokes.json`: the steps of a session, which `repair --strokes` does again.

Every step has a camera, with the keys of nerfstudio's `transforms.json`, so that `--target` reads
the file, too. Masks are images beside it. There is no `file_path`: readers would take the size of a
mask for that of its camera.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch

from gscompleter import __version__
from gscompleter.apps.commands.shared_options import SceneOptions, Size
from gscompleter.apps.inputs.removal import Selection, check_selection
from gscompleter.apps.live.session import UPRIGHT, Action, Session, Step
from gscompleter.data.scene import describe_camera
from gscompleter.data.transforms import OPENCV_FROM_OPENGL
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_bytes
from gscompleter.system.files.result_format import MARK
from gscompleter.system.files.typed_json import read_typed_json
from gscompleter.system.files.writing import replace_file
from gscompleter.types import Camera

STROKES_FILE = "strokes.json"
MASK_FOLDER = "images"
STROKES = (STROKES_FILE, f"{MASK_FOLDER}/stroke*.png")
"""Globs of the files that are written."""
ADVICE = "save the session again"

Row = tuple[float, float, float, float]


@dataclass(frozen=True)
class StrokeRow:
    """A step, with its camera as `transforms.json` has it: in OpenGL axes."""

    action: Action
    w: int
    h: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    transform_matrix: tuple[Row, Row, Row, Row]
    mask_path: str | None = None
    """Image beside the file, white where something is marked; None without marks."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Box of a removal, as `remove --box` takes it; None without one."""
    box_rotation: Row = UPRIGHT

    def make_camera(self) -> Camera:
        """Make the camera in float64, as it was written; InputError if there is no such camera."""
        # `load_cameras` rounds to float32 before large coordinates are brought to their origin.
        c2w = np.array(self.transform_matrix) @ OPENCV_FROM_OPENGL
        K = [[self.fl_x, 0.0, self.cx], [0.0, self.fl_y, self.cy], [0.0, 0.0, 1.0]]
        return Camera(torch.from_numpy(c2w), torch.tensor(K, dtype=torch.float64), self.w, self.h)


@dataclass(frozen=True)
class StrokesFile:
    """The part of `strokes.json` that is read besides the cameras."""

    version: str
    frames: tuple[StrokeRow, ...]
    resolution: Size | None = None
    """Working size of the session, as `--resolution` takes it."""
    near: float | None = None
    far: float | None = None
    context: tuple[int, ...] | None = None
    """Frames of the photographs of the session, or of the cameras of a file; None if its cameras
    were found."""


def write_strokes(
    folder: Path, session: Session, options: SceneOptions, context: Sequence[int] | None
) -> None:
    """Write the steps of a session, their masks, and what its scene was made of, to a folder."""
    frames = []
    for number, step in enumerate(session.steps, start=1):
        mask_path = None
        if step.mask is not None:
            mask_path = f"{MASK_FOLDER}/stroke{number}.png"
            (folder / MASK_FOLDER).mkdir(exist_ok=True)
            (folder / mask_path).write_bytes(step.mask)
        frames.append(
            {
                "action": step.action,
                "mask_path": mask_path,
                "box": step.box,
                "box_rotation": step.box_rotation,
                **describe_camera(step.camera),
            }
        )
    content = {
        **MARK,
        "version": __version__,
        "resolution": options.resolution,
        "near": options.near,
        "far": options.far,
        "context": None if context is None else list(context),
        "camera_model": "PINHOLE",
        "frames": frames,
    }
    with replace_file(folder / STROKES_FILE) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


def read_strokes(path: Path) -> StrokesFile:
    """Read and validate a `strokes.json`, without its masks."""
    strokes = read_typed_json(StrokesFile, path, ADVICE)
    if not strokes.frames:
        raise InputError(f"{quote_value(path)} has no steps; {ADVICE}.", "strokes")
    for row in strokes.frames:
        # What is read lies beside the file, whatever it says.
        if row.mask_path is not None and not is_beside(row.mask_path):
            raise InputError(
                f"{quote_value(path)} names the mask '{quote_value(row.mask_path)}', and only "
                f"files beside it are read; {ADVICE}."
            )
        if row.box is not None:
            check_selection(Selection(row.box, row.box_rotation))
    return strokes


def read_steps(strokes: StrokesFile, folder: Path) -> list[Step]:
    """Make the steps of a `strokes.json`, with cameras in its frame; read masks from `folder`."""
    return [
        Step(
            row.action,
            row.make_camera(),
            None if row.mask_path is None else read_bytes(folder / row.mask_path),
            row.box,
            row.box_rotation,
        )
        for row in strokes.frames
    ]


def is_beside(name: str) -> bool:
    """Return True if a relative path leads to a file below its folder."""
    path = PurePosixPath(name)
    is_plain = "\\" not in name and "\0" not in name and path.parts != ()
    return is_plain and not path.is_absolute() and ".." not in path.parts

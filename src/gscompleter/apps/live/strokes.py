"""`strokes.json`: the steps of a session.

`live` goes on with them, and `repair --strokes` does them again. The file also has what the session
began with, so that `live OUT` needs nothing else.

Every step has a camera, with the keys of nerfstudio's `transforms.json`, so that `--target` reads
the file, too. Masks are images beside it. There is no `file_path`: readers would take the size of a
mask for that of its camera.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
import torch

from gscompleter import __version__
from gscompleter.apps.inputs.removal import check_selection
from gscompleter.apps.live.session import UPRIGHT, Action, Session, SessionStep, check_step
from gscompleter.apps.requests.scene import Size
from gscompleter.apps.requests.splat import Selection
from gscompleter.data.scene import describe_camera
from gscompleter.data.transforms import OPENCV_FROM_OPENGL
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_folder import STROKES_FOLDER
from gscompleter.system.files.reading import read_bytes
from gscompleter.system.files.result_format import RESULT_MARK
from gscompleter.system.files.result_names import STROKES_FILE
from gscompleter.system.files.typed_json import read_typed_json
from gscompleter.types import Camera

STROKES = (STROKES_FILE, f"{STROKES_FOLDER}/stroke*.png")
"""Globs of the files that are written."""
STROKES_ADVICE = "save the session again"
"""End of each sentence about a damaged file."""
SEPARATE_OPTIONS = ("resolution", "near", "far", "context")
"""Options with an entry of their own beside `session`, since `repair --strokes` reads them, too."""

FourNumbers = tuple[float, float, float, float]


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
    transform_matrix: tuple[FourNumbers, FourNumbers, FourNumbers, FourNumbers]
    mask_path: str | None = None
    """Image beside the file, white where something is marked; None without marks."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Box of a removal, as `remove --box` takes it; None without one."""
    box_rotation: FourNumbers = UPRIGHT
    """Rotation of the box, as `remove --box-rotation` takes it."""

    def make_step(self, mask: bytes | None) -> SessionStep:
        """Make the step, with the content of its mask."""
        return SessionStep(self.action, self.make_camera(), mask, self.box, self.box_rotation)

    def make_camera(self) -> Camera:
        """Make the camera in float64, in the frame of the photographs, as it was written.

        Raises InputError if there is no such camera.
        """
        # `load_cameras` rounds to float32 before large coordinates are brought to their origin.
        c2w = np.array(self.transform_matrix) @ OPENCV_FROM_OPENGL
        K = [[self.fl_x, 0.0, self.cx], [0.0, self.fl_y, self.cy], [0.0, 0.0, 1.0]]
        return Camera(torch.from_numpy(c2w), torch.tensor(K, dtype=torch.float64), self.w, self.h)


@dataclass(frozen=True)
class StrokesFile:
    """Hold the entries of `strokes.json` that a session reads; others are for other readers."""

    version: str
    frames: tuple[StrokeRow, ...]
    resolution: Size | None = None
    """Working size of the session, as `--resolution` takes it."""
    near: float | None = None
    far: float | None = None
    context: tuple[int, ...] | None = None
    """Frames of the photographs of the session, or of the cameras of a file; None if its cameras
    were found."""
    saved: str | None = None
    """`digest_steps` of the steps that the completed scene beside the file has; None without a
    scene."""
    session: dict[str, Any] | None = None
    """Options that the session began with; None in files of early versions."""
    scene_sha256: str | None = None
    """SHA-256 of the splat that it began with; None if the scene was reconstructed."""
    undone: tuple[StrokeRow, ...] = ()
    """Steps that were undone, the next to be done again first."""


@dataclass(frozen=True)
class SessionStart:
    """What a session began with, for its `strokes.json`."""

    options: Mapping[str, Any]
    """Options that a later session goes on with."""
    resolution: Size | None
    near: float | None
    far: float | None
    context: tuple[int, ...] | None
    """Photographs that it works with; None if its cameras were found, and are found again."""
    scene_sha256: str | None
    """SHA-256 of the splat; None if the scene was reconstructed."""


def write_strokes(folder: Path, session: Session, start: SessionStart) -> None:
    """Write the steps of a session that is saved, and their masks, to a folder."""
    write_masks(folder, list_steps(session))
    content = encode_strokes(session, start, digest_steps(session.steps))
    (folder / STROKES_FILE).write_bytes(content)


def list_steps(session: Session) -> tuple[SessionStep, ...]:
    """List the steps of a session, then those that were undone, the next to be done again first."""
    return (*session.steps, *(step for _, step in reversed(session.undone)))


def write_masks(folder: Path, steps: Sequence[SessionStep], first: int = 0) -> None:
    """Write the masks of steps, from the step at the index `first` on."""
    for index, step in enumerate(steps):
        if index >= first and step.mask is not None:
            (folder / STROKES_FOLDER).mkdir(exist_ok=True)
            (folder / name_mask(index)).write_bytes(step.mask)


def name_mask(index: int) -> str:
    """Name the mask of the step at this index; the numbers in the names begin with 1."""
    return f"{STROKES_FOLDER}/stroke{index + 1}.png"


def encode_strokes(
    session: Session, start: SessionStart, saved: str | None, count: int | None = None
) -> bytes:
    """Encode `strokes.json` with the steps of `list_steps`: all of them, or the first `count`.

    `saved` is the digest of the steps that the completed scene in the folder has; None without a
    scene.
    """
    steps = list_steps(session)[:count]
    rows = [
        describe_step(step, None if step.mask is None else name_mask(index))
        for index, step in enumerate(steps)
    ]
    content = {
        **RESULT_MARK,
        "version": __version__,
        "resolution": start.resolution,
        "near": start.near,
        "far": start.far,
        "context": start.context,
        "saved": saved,
        "session": start.options,
        "scene_sha256": start.scene_sha256,
        "camera_model": "PINHOLE",
        "frames": rows[: len(session.steps)],
        "undone": rows[len(session.steps) :],
    }
    return (json.dumps(content, indent=1) + "\n").encode()


def describe_step(step: SessionStep, mask_path: str | None) -> dict[str, Any]:
    """Describe a step as a row of `strokes.json`; the inverse of `StrokeRow.make_step`."""
    return {
        "action": step.action,
        "mask_path": mask_path,
        "box": step.box,
        "box_rotation": step.box_rotation,
        **describe_camera(step.camera),
    }


def digest_steps(steps: Sequence[SessionStep]) -> str:
    """Return a digest of steps, by which those of a saved scene are known again."""
    digest = sha256()
    for step in steps:
        mask = None if step.mask is None else sha256(step.mask).hexdigest()
        digest.update(json.dumps(describe_step(step, mask)).encode())
    return digest.hexdigest()


def find_strokes_file(path: Path) -> Path:
    """Return the file that `--strokes` names; of a folder, the `strokes.json` in it."""
    return path / STROKES_FILE if path.is_dir() else path


def read_strokes(path: Path) -> StrokesFile:
    """Read and validate a `strokes.json`, without its masks.

    Raises InputError before the scene is opened, which takes longer, if a row is no step.
    """
    strokes = read_typed_json(StrokesFile, path, STROKES_ADVICE)
    for key, rows in (("frames", strokes.frames), ("undone", strokes.undone)):
        for number, row in enumerate(rows):
            # What is read lies beside the file, whatever it says.
            if row.mask_path is not None and not is_below_folder(row.mask_path):
                raise InputError(
                    f"{quote_value(path)} names the mask '{quote_value(row.mask_path)}', and only "
                    f"files beside it are read; {STROKES_ADVICE}."
                )
            with name_row(path, f"{key}.{number}"):
                if row.box is not None:
                    check_selection(Selection(row.box, row.box_rotation))
                # Here only whether there is a mask matters, not its content.
                check_step(row.make_step(None if row.mask_path is None else b""))
    return strokes


@contextmanager
def name_row(path: Path, place: str) -> Iterator[None]:
    """Name the file and the place of a row in its InputErrors, in place of any option."""
    try:
        yield
    except InputError as error:
        reason = str(error).removesuffix(".")
        raise InputError(
            f"{quote_value(path)} is damaged ({place}: {reason}); {STROKES_ADVICE}."
        ) from error


def read_steps(rows: Sequence[StrokeRow], folder: Path) -> tuple[SessionStep, ...]:
    """Make the steps of rows, with cameras in the frame of the file; read masks from `folder`."""
    return tuple(
        row.make_step(None if row.mask_path is None else read_bytes(folder / row.mask_path))
        for row in rows
    )


def is_below_folder(name: str) -> bool:
    """Return True if a path is relative and leads to a file below the folder it is relative to."""
    path = PurePosixPath(name)
    # On Windows, C: leads to another disk, and names may be separated by backslashes.
    is_plain = "\\" not in name and "\0" not in name and PureWindowsPath(name).drive == ""
    return is_plain and not path.is_absolute() and path.parts != () and ".." not in path.parts

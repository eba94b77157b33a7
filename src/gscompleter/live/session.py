"""What is done to a scene camera after camera: every step gives a new session, so that undo is to
go on from the former."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float

from gscompleter.completer import GSCompleter
from gscompleter.data.framing import Resolution
from gscompleter.data.origin import frame_from_photographs
from gscompleter.data.scene import load_cameras, write_cameras
from gscompleter.errors import InputError
from gscompleter.frames.similarity import moved_camera, moved_exactly
from gscompleter.io.files import TARGETS
from gscompleter.types import Camera, Completion, TargetCompletion


@dataclass(frozen=True)
class Place:
    """Between the frame of the photographs, in which cameras are written, and that of the result.

    A camera goes through a file before it is completed, so that the file names the very camera.
    """

    frame: Float[np.ndarray, "4 4"]
    """From the frame of the photographs to that of the result."""
    origin: Float[np.ndarray, "3"]
    """Where the coordinates of the photographs are counted from, in their frame."""
    resolution: Resolution = None
    """Height and width that are worked at, or the most pixels of the longer side."""

    def told(self, camera: Camera) -> Camera:
        """A camera of the result in the frame of the photographs, in float64."""
        return moved_exactly(camera, np.linalg.inv(self.frame))

    def read(self, told: Camera) -> Camera:
        """The camera of the result that a file with `told` names."""
        with TemporaryDirectory() as folder:
            path = Path(folder) / TARGETS
            write_cameras(path, [told])
            (camera,) = load_cameras(path, self.resolution, origin=self.origin.tolist())
        return moved_camera(camera, self.frame @ frame_from_photographs(-self.origin))


@dataclass(frozen=True)
class Step:
    """A camera that the scene was completed for, and the scene with what that added."""

    told: Camera
    """In the frame of the photographs, as it is written."""
    completion: Completion


@dataclass(frozen=True)
class Session:
    """A scene as it began, and all that was done to it and not undone."""

    completer: GSCompleter
    place: Place
    begun: Completion
    steps: tuple[Step, ...] = ()

    @property
    def now(self) -> Completion:
        """The scene as it stands."""
        return self.steps[-1].completion if self.steps else self.begun


def completed(session: Session, camera: Camera) -> tuple[Session, TargetCompletion]:
    """The session once the scene is completed for a camera of the result, and what happened there.

    A camera to which nothing is added leaves the session as it is.

    Raises:
        InputError: as `GSCompleter.advance`, and where the camera cannot be written.
    """
    told = session.place.told(camera)
    target = session.place.read(told).to(session.now.views[0].image.device)
    completion = session.completer.advance(session.now, target)
    result = completion.targets[-1]
    if not len(result.added):
        return session, result
    return replace(session, steps=(*session.steps, Step(told, completion))), result


def undone(session: Session) -> Session:
    """The session without its last step.

    Raises:
        InputError: where there is none.
    """
    if not session.steps:
        raise InputError("There is nothing to undo; complete something first.")
    return replace(session, steps=session.steps[:-1])

"""Immutable sessions: every step returns a new session, so undo returns to the one before."""

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
    """Conversion of cameras between the frames of the photographs and of the result.

    Cameras go through a file before they are used, so that the saved file gives the very same
    result.
    """

    frame: Float[np.ndarray, "4 4"]
    """Similarity from the frame of the photographs to that of the result."""
    origin: Float[np.ndarray, "3"]
    """Local origin of the coordinates, in the frame of the photographs."""
    resolution: Resolution = None

    def told(self, camera: Camera) -> Camera:
        """Convert a camera to the frame of the photographs, in float64."""
        return moved_exactly(camera, np.linalg.inv(self.frame))

    def read(self, told: Camera) -> Camera:
        """Convert a camera to the frame of the result, by way of a file."""
        with TemporaryDirectory() as folder:
            path = Path(folder) / TARGETS
            write_cameras(path, [told])
            (camera,) = load_cameras(path, self.resolution, origin=self.origin.tolist())
        return moved_camera(camera, self.frame @ frame_from_photographs(-self.origin))


@dataclass(frozen=True)
class Step:
    """A completed target camera and the scene after it."""

    told: Camera
    """Target camera in the frame of the photographs, as it is saved."""
    completion: Completion


@dataclass(frozen=True)
class Session:
    """A scene with all steps that are not undone."""

    completer: GSCompleter
    place: Place
    begun: Completion
    steps: tuple[Step, ...] = ()

    @property
    def now(self) -> Completion:
        """The completion after the last step."""
        return self.steps[-1].completion if self.steps else self.begun


def completed(session: Session, camera: Camera) -> tuple[Session, TargetCompletion]:
    """Complete the scene for a camera in the frame of the result.

    Returns the same session if nothing was added.
    """
    told = session.place.told(camera)
    target = session.place.read(told).to(session.now.views[0].image.device)
    completion = session.completer.advance(session.now, target)
    result = completion.targets[-1]
    if not len(result.added):
        return session, result
    return replace(session, steps=(*session.steps, Step(told, completion))), result


def undone(session: Session) -> Session:
    """Remove the last step."""
    if not session.steps:
        raise InputError("There is nothing to undo; complete something first.")
    return replace(session, steps=session.steps[:-1])

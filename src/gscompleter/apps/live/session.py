"""Immutable sessions: every step returns a new session, so undo returns to the one before."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float

from gscompleter.apps.viewer.exhibit import load_scene_cameras
from gscompleter.completer import GSCompleter
from gscompleter.data.photographs import Resolution
from gscompleter.data.scene import write_cameras
from gscompleter.splats.alignment.similarity import transform_camera_exactly
from gscompleter.state import Completion, TargetResult
from gscompleter.system.errors import InputError
from gscompleter.types import Camera


@dataclass(frozen=True)
class Session:
    """A scene with all steps that are not undone."""

    completer: GSCompleter
    completions: tuple[Completion, ...]
    """The scene at first and after each step."""
    transform: Float[np.ndarray, "4 4"]
    """Similarity from the frame of the photographs to that of the result."""
    origin: Float[np.ndarray, "3"]
    """Local origin of the coordinates, in the frame of the photographs."""
    resolution: Resolution = None
    cameras: tuple[Camera, ...] = ()
    """Target camera of each completion in the frame of the photographs, as it is saved."""

    @property
    def latest(self) -> Completion:
        """The completion after the last step."""
        return self.completions[-1]


def complete_camera(session: Session, camera: Camera) -> tuple[Session, TargetResult]:
    """Complete the scene for a camera in the frame of the result.

    Returns the same session if nothing was added or recoloured. The camera goes through a file
    first, so that the saved file gives the very same result.
    """
    saved_camera = transform_camera_exactly(camera, np.linalg.inv(session.transform))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "target.json"
        write_cameras(path, [saved_camera])
        (target,) = load_scene_cameras(path, session.transform, session.origin, session.resolution)
    target = target.to(session.latest.views[0].image.device)
    completion = session.completer.advance(session.latest, target)
    result = completion.targets[-1]
    if not len(result.added) and not result.num_recolored:
        return session, result
    completions = (*session.completions, completion)
    cameras = (*session.cameras, saved_camera)
    return replace(session, completions=completions, cameras=cameras), result


def undo_step(session: Session) -> Session:
    """Remove the last step."""
    earlier = session.completions[:-1]
    if not earlier:
        raise InputError("There is nothing to undo; complete something first.")
    # A step may be a removal, which has no camera: the targets that are left tell how many there
    # are.
    cameras = session.cameras[: len(earlier[-1].targets)]
    return replace(session, completions=earlier, cameras=cameras)

"""What the files of a COLMAP model hold, whichever way it is written."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gscompleter.data.poses import c2w_of, rotation_of


@dataclass(frozen=True)
class PosedImage:
    """An image of a model: its name and its pose from world to camera."""

    name: str
    """Path of the photograph below the folder of all photographs, with forward slashes."""
    camera: int
    """Number of its camera."""
    quaternion: tuple[float, ...]
    """Of the rotation from world to camera, real part first."""
    translation: tuple[float, ...]
    """From world to camera, in scene units."""

    def c2w(self) -> Float[np.ndarray, "4 4"]:
        """Camera-to-world in OpenCV axes; where it does not exist, the transform as it is."""
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation_of(self.quaternion)
        viewmat[:3, 3] = self.translation
        return c2w_of(viewmat)


def portable(name: str) -> str:
    """The name of an image with forward slashes, also where Windows wrote it."""
    return name.replace("\\", "/")

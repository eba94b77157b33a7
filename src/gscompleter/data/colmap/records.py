"""Records of a COLMAP model, binary or text."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import compute_rotation, invert_viewmat


@dataclass(frozen=True)
class PosedImage:
    """An image of a model: its name and its world-to-camera pose."""

    name: str
    """Path below the folder of photographs, with forward slashes."""
    camera: int
    quaternion: tuple[float, ...]
    """World-to-camera rotation, real part first."""
    translation: tuple[float, ...]
    """World-to-camera translation, in scene units."""

    def c2w(self) -> Float[np.ndarray, "4 4"]:
        """Compute camera-to-world in OpenCV axes; an invalid transform stays as it is."""
        viewmat = np.eye(4)
        viewmat[:3, :3] = compute_rotation(self.quaternion)
        viewmat[:3, 3] = self.translation
        return invert_viewmat(viewmat)


def make_portable(name: str) -> str:
    """Replace backslashes of Windows in an image name."""
    return name.replace("\\", "/")

"""The embedded Φ: warp what the photographs saw into the target, and fill what none of them saw.

It needs no weights. Observed pixels come from the photographs through the depth of the scene
(`warp`), made equally bright first (`harmonize`); the rest is filled smoothly from its border
(`smooth`) and given the structure and texture of the photographs by patches (`exemplar`).
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from gscompleter.generators.warp_inpaint.smooth import push_pull
from gscompleter.generators.warp_inpaint.warp import WarpConfig, warp_photographs
from gscompleter.types import Camera, SceneContext, View


@dataclass(frozen=True)
class WarpInpaint:
    """Φ without weights: depth-aware warp of all photographs, then exemplar-based filling."""

    seed: int = 0
    """Of the random search for patches; the same seed gives the same bytes."""
    warp: WarpConfig = WarpConfig()
    """How photographs are carried into the target."""

    def __call__(
        self, nearest: View, target: Camera, context: SceneContext
    ) -> Float[Tensor, "h w 3"]:
        """The image `target` would take, completely filled, in [0, 1]."""
        warped = warp_photographs(target, context, self.warp)
        return push_pull(warped.image, warped.known.to(warped.image.dtype)).clamp(0, 1)

"""The true image, to measure the geometry alone (as the paper's study of long sequences does)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.generators import Request, Synthesis
from gscompleter.geometry import same_camera
from gscompleter.types import Camera, View


@dataclass(frozen=True)
class Oracle:
    """Φ that knows the answer: the photograph taken by the target camera itself."""

    photographs: Sequence[View]
    """True images; the one whose camera is the target's is returned."""

    takes_margin: bool = False
    """A photograph ends where the image of its camera ends."""
    at_once: int = 1

    def synthesize(self, requests: Sequence[Request]) -> list[Synthesis]:
        """The photographs of the targets, errors as those of `photograph`."""
        return [Synthesis(self.photograph(request.target)) for request in requests]

    def photograph(self, target: Camera) -> Float[Tensor, "h w 3"]:
        """The image that the camera took; an InputError where it took none."""
        for photograph in self.photographs:
            if same_camera(photograph.camera, target):
                return photograph.image.to(target.K.device)
        raise InputError(
            f"The generator 'oracle' has {len(self.photographs)} photographs, none of them taken "
            "by the target camera; give it the photograph of the target frame, or choose "
            "'warp-inpaint' where there is none."
        )

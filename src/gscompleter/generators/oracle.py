"""The true image as Φ, to evaluate the geometry alone, as in the paper's long sequences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.generators import GeneratorOutput, GeneratorRequest
from gscompleter.geometry import is_same_camera
from gscompleter.types import Camera, View


@dataclass(frozen=True)
class Oracle:
    """Φ that returns the photograph of the target camera."""

    photographs: Sequence[View]

    supports_padding: bool = False
    """False, because a photograph cannot be extended."""
    max_batch_size: int = 1

    def synthesize(self, requests: Sequence[GeneratorRequest]) -> list[GeneratorOutput]:
        """Return the photographs of the targets."""
        return [
            GeneratorOutput(self.find_photograph(request.target), is_photograph=True)
            for request in requests
        ]

    def find_photograph(self, target: Camera) -> Float[Tensor, "h w 3"]:
        """Find the photograph of `target`; raise InputError if there is none."""
        for photograph in self.photographs:
            if is_same_camera(photograph.camera, target):
                return photograph.image.to(target.K.device)
        raise InputError(
            f"The generator 'oracle' has {len(self.photographs)} photographs, none of them taken "
            "by the target camera; give it the photograph of the target frame, or choose "
            "'warp-inpaint' if there is none."
        )

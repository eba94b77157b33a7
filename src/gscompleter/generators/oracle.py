"""The true image as Φ, to evaluate the geometry alone, as in the paper's long sequences."""

from __future__ import annotations

from collections.abc import Sequence

from gscompleter.errors import InputError
from gscompleter.generators import FunctionGenerator, GeneratorOutput
from gscompleter.geometry import is_same_camera
from gscompleter.types import Camera, GeneratorInput, View


def make_oracle(photographs: Sequence[View]) -> FunctionGenerator:
    """Make the Φ that returns the photograph of the target camera, which cannot be padded."""

    def find_photograph(nearest: View, target: Camera, context: GeneratorInput) -> GeneratorOutput:
        for photograph in photographs:
            if is_same_camera(photograph.camera, target):
                return GeneratorOutput(photograph.image.to(target.K.device), is_photograph=True)
        raise InputError(
            f"The generator 'oracle' has {len(photographs)} photographs, none of them taken by the "
            "target camera; give it the photograph of the target frame, or choose 'warp-inpaint' "
            "if there is none."
        )

    return FunctionGenerator(find_photograph, supports_padding=False)

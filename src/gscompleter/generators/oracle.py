"""Φ that returns the photograph of the target camera: what geometry alone costs."""

from __future__ import annotations

from collections.abc import Sequence

from gscompleter.config.generators import GeneratorSettings
from gscompleter.generators import FunctionGenerator, GeneratorOutput
from gscompleter.numerics.geometry import is_same_camera
from gscompleter.system.errors import InputError
from gscompleter.types import Camera, GeneratorInput, View


def load_oracle(
    settings: GeneratorSettings, seed: int, photographs: Sequence[View], device: str
) -> FunctionGenerator:
    """Load the generator; beyond a photograph there is nothing, so that it cannot be padded."""

    def find_photograph(nearest: View, target: Camera, context: GeneratorInput) -> GeneratorOutput:
        for photograph in photographs:
            if is_same_camera(photograph.camera, target):
                return GeneratorOutput(photograph.image.to(target.K.device), is_photograph=True)
        raise InputError(
            f"The generator 'oracle' has {len(photographs)} photographs, none of them taken by the "
            "target camera; give it that photograph, or choose 'warp-inpaint'."
        )

    return FunctionGenerator(find_photograph, supports_padding=False)

"""Φ: nearest photograph and target camera -> the image at the target (paper, Eq. 6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from gscompleter.config import SynthesisConfig
from gscompleter.config.generators import (
    GENERATOR_PLUGINS,
    GENERATORS,
    GeneratorSettings,
    get_settings_class,
)
from gscompleter.config.settings import validate
from gscompleter.system.errors import InputError
from gscompleter.system.plugins import is_in_file, load_from_file, load_function, load_plugins
from gscompleter.system.tensor_checks import describe, is_whole_number
from gscompleter.types import Camera, GeneratorInput, View


@dataclass(frozen=True)
class GeneratorRequest:
    """Input of Φ for one image: the photograph taken closest to `target`, and all of them."""

    nearest: View
    target: Camera
    context: GeneratorInput
    synthesis: SynthesisConfig = SynthesisConfig()
    """Settings of the completion for a learned Φ; the built-in ones read none of them."""


@dataclass(frozen=True)
class GeneratorOutput:
    """Output of Φ for one image."""

    image: Float[Tensor, "h w 3"]
    """In [0, 1], of the size of the target."""
    notes: tuple[str, ...] = ()
    """Sentences about the image for a reader of the results."""
    is_inconsistent: bool = False
    """True if the image does not show the scene of the photographs."""
    is_photograph: bool = False
    """True if the image is a true photograph, which may recolour all that it shows."""
    painter: str = ""
    """Name of the program, model or person that painted the image elsewhere; empty for Φ itself."""


@runtime_checkable
class Generator(Protocol):
    """Interface of Φ."""

    @property
    def supports_padding(self) -> bool:
        """True if Φ can synthesize a padded target image."""

    @property
    def max_batch_size(self) -> int:
        """Largest batch; with 1, each request sees what the previous ones added."""

    def synthesize(self, requests: Sequence[GeneratorRequest]) -> list[GeneratorOutput]:
        """Synthesize one image per request, in order."""


ImageFunction = Callable[[View, Camera, GeneratorInput], Tensor | GeneratorOutput]
"""Simplest form of Φ: (nearest, target, context) -> image [h, w, 3] or `GeneratorOutput`."""


@dataclass(frozen=True)
class FunctionGenerator:
    """A plain function as a generator, with padding and without batches."""

    function: ImageFunction
    supports_padding: bool = True
    max_batch_size: int = 1

    def synthesize(self, requests: Sequence[GeneratorRequest]) -> list[GeneratorOutput]:
        """Call the function once per request."""
        outputs = []
        for request in requests:
            answer = self.function(request.nearest, request.target, request.context)
            if not isinstance(answer, GeneratorOutput):
                answer = GeneratorOutput(answer)
            outputs.append(answer)
        return outputs


def as_generator(phi: Any) -> Generator:
    """Return a `Generator`, wrapping an `ImageFunction`; raise InputError for anything else."""
    # A class has the attributes of its instances, too, and would pass for one.
    is_object = isinstance(phi, Generator) and not isinstance(phi, type)
    if not is_object and (not callable(phi) or isinstance(phi, type)):
        raise InputError(
            "The generator has to be a function of nearest view, target and context, or an object "
            "with supports_padding, max_batch_size and synthesize, such as gsc.load_generator "
            f"returns, and is {describe(phi)}."
        )
    generator: Generator = phi if is_object else FunctionGenerator(phi)
    if not is_whole_number(generator.max_batch_size) or generator.max_batch_size < 1:
        raise InputError(
            "The max_batch_size of the generator has to be a whole number from 1, and is "
            f"{describe(generator.max_batch_size)}."
        )
    # A method would always count as True.
    if not isinstance(generator.supports_padding, bool):
        raise InputError(
            "The supports_padding of the generator has to be True or False, and is "
            f"{describe(generator.supports_padding)}."
        )
    if not callable(generator.synthesize):
        raise InputError("The synthesize of the generator has to be a function of requests.")
    return generator


def load_generator(
    name: str,
    seed: int = 0,
    photographs: Sequence[View] = (),
    device: str = "cpu",
    settings: GeneratorSettings | None = None,
) -> Generator:
    """Load a generator by name or from `file.py:function`.

    Only `oracle` and `painted` use `photographs`.
    They are the images of the targets: true ones, or those that were painted.
    """
    kind = get_settings_class(name)
    settings = settings or kind()
    if type(settings) is not kind:
        raise InputError(
            f"The generator {name!r} takes {kind.__name__}, got {type(settings).__name__}.",
            "generator",
        )
    settings = validate(settings, "generator_")
    if getattr(settings, "offload", False) and device == "cpu":
        raise InputError(
            "offload keeps parts of the generator off the GPU, and it runs on the CPU; leave it "
            "out, or choose the device cuda.",
            "generator_offload",
        )
    if is_in_file(name):
        return as_generator(load_from_file(name, "generator"))
    if name in GENERATORS:
        load = load_function(*GENERATORS[name].load.split(":"))
    else:
        load = load_plugins(GENERATOR_PLUGINS)[name]
    return as_generator(load(settings, seed, photographs, device))

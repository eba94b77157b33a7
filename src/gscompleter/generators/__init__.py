"""Φ: the nearest photograph and a target camera -> the image that camera would take.

A generator says what it needs and answers requests; any callable of the form above is taken for one
(`as_generator`). The table of names serves the command line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.types import Camera, SceneContext, View


@dataclass(frozen=True)
class Request:
    """One image that Φ is asked for."""

    nearest: View
    """The photograph taken closest to `target`."""
    target: Camera
    context: SceneContext
    """All photographs, and renders of the scene as it is; what Φ uses of it is its own affair."""


@dataclass(frozen=True)
class Synthesis:
    """What Φ answers."""

    image: Float[Tensor, "h w 3"]
    """In [0, 1], of the size of the target."""
    notes: tuple[str, ...] = ()
    """What a reader of the results should know of it, a sentence each."""


@runtime_checkable
class Generator(Protocol):
    """Φ of the paper: what it needs, and the images that it synthesizes."""

    @property
    def takes_margin(self) -> bool:
        """Whether it can draw more than a target's own image, which is then completed wider."""

    @property
    def at_once(self) -> int:
        """Most requests that it takes together; with 1 each sees what the ones before added."""

    def synthesize(self, requests: Sequence[Request]) -> list[Synthesis]:
        """An answer for each of `requests`, in their order."""


ImageFunction = Callable[[View, Camera, SceneContext], Tensor | Synthesis]
"""Φ at its simplest: (nearest, target, context) -> an image [h, w, 3], or one with notes."""


@dataclass(frozen=True)
class OneByOne:
    """A plain function as a generator: one request at a time, with the margin."""

    function: ImageFunction
    takes_margin: bool = True
    at_once: int = 1

    def synthesize(self, requests: Sequence[Request]) -> list[Synthesis]:
        """What the function answers to each of `requests`."""
        answers = [self.function(r.nearest, r.target, r.context) for r in requests]
        return [a if isinstance(a, Synthesis) else Synthesis(a) for a in answers]


def as_generator(phi: Generator | ImageFunction) -> Generator:
    """`phi` itself, or the plain function that it is as a generator."""
    return phi if isinstance(phi, Generator) else OneByOne(phi)


@dataclass(frozen=True)
class DiffusionSettings:
    """What a generator with weights can be told. Whatever is None is left to it."""

    path: str | None = None
    """Folder or hub id of its weights; None takes the published ones."""
    steps: int | None = None
    """Denoising steps."""
    retries: int = 0
    """How many further seeds are tried where an image disagrees with the photographs."""
    prompt: str | None = None
    """What it is told of the image, in words."""
    depth: str | None = None
    """Where the depth of the photograph comes from: `context`, `monocular`, or the folder or hub id
    of a depth estimation model of transformers."""
    at_once: int | None = None
    """How many targets are denoised together, at most."""
    offload: bool = False
    """Keep on the GPU only the part of the network that is at work: slower, and less memory."""


TAKES: dict[str, tuple[str, ...]] = {
    "pe-field": ("path", "steps", "retries", "depth", "at_once", "offload"),
    "diffusers-inpaint": ("path", "steps", "retries", "prompt", "offload"),
}
"""The settings that each generator with weights knows; the others know none."""


@dataclass(frozen=True)
class GeneratorRequest:
    """What a generator of the table may be made from."""

    seed: int
    photographs: Sequence[View]
    device: str
    settings: DiffusionSettings


def _warp_inpaint(request: GeneratorRequest) -> Generator:
    from gscompleter.generators.warp_inpaint import WarpInpaint

    return OneByOne(WarpInpaint(seed=request.seed))


def _oracle(request: GeneratorRequest) -> Generator:
    from gscompleter.generators.oracle import Oracle

    return Oracle(request.photographs)


def _pe_field(request: GeneratorRequest) -> Generator:
    from gscompleter.generators.diffusion.pe_field import load_pe_field

    return load_pe_field(request.seed, request.device, request.settings)


def _diffusers_inpaint(request: GeneratorRequest) -> Generator:
    from gscompleter.generators.diffusion.inpaint import load_diffusers_inpaint

    return OneByOne(load_diffusers_inpaint(request.seed, request.device, request.settings))


GENERATORS: dict[str, Callable[[GeneratorRequest], Generator]] = {
    "warp-inpaint": _warp_inpaint,
    "oracle": _oracle,
    "pe-field": _pe_field,
    "diffusers-inpaint": _diffusers_inpaint,
}


def load_generator(
    name: str,
    seed: int = 0,
    photographs: Sequence[View] = (),
    device: str = "cpu",
    settings: DiffusionSettings = DiffusionSettings(),
) -> Generator:
    """The generator called `name`.

    Args:
        name: A name of the table.
        seed: Of everything random in it; the same seed gives the same image.
        photographs: True images of the targets, which only `oracle` looks at.
        device: Where its network runs, if it has one: cpu or cuda.
        settings: For one with weights. The network itself is loaded once in a process.

    Raises:
        InputError: where there is none of that name, packages or weights are missing, or a setting
            is one that it does not know, or out of range.
    """
    if name not in GENERATORS:
        raise InputError(f"There is no generator {name!r}; choose one of {', '.join(GENERATORS)}.")
    check_settings(name, settings, device)
    return GENERATORS[name](GeneratorRequest(seed, photographs, device, settings))


def check_settings(name: str, settings: DiffusionSettings, device: str) -> None:
    """Refuse settings that the generator called `name` does not know, and senseless values.

    Raises:
        InputError: where there is one.
    """
    for field in fields(settings):
        value, option = getattr(settings, field.name), f"--generator-{field.name.replace('_', '-')}"
        if value == "":
            raise InputError(f"{option} is empty; leave it out, or say what it shall be.")
        if value != field.default and field.name not in TAKES.get(name, ()):
            others = [other for other, known in TAKES.items() if field.name in known]
            raise InputError(
                f"The generator {name!r} knows no {option} ({value}); leave that out, or choose "
                f"{' or '.join(others)}."
            )
    for option, number, least in (
        ("steps", settings.steps, 1),
        ("retries", settings.retries, 0),
        ("at-once", settings.at_once, 1),
    ):
        if number is not None and number < least:
            raise InputError(f"--generator-{option} is {number}; at least {least} is needed.")
    if settings.offload and device == "cpu":
        raise InputError(
            "--generator-offload keeps parts of the generator off the GPU, and it runs on the CPU; "
            "leave it out, or choose --device cuda."
        )

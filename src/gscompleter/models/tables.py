"""Tables of the learned models, which the core finds through entry points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from gscompleter.generators import FunctionGenerator, Generator
from gscompleter.models.weights.published import PUBLISHED
from gscompleter.reconstructors import Reconstructor
from gscompleter.types import View


def load_learned_reconstructor(name: str, weights: Path | None, device: str) -> Reconstructor:
    """Load the reconstructor with the published weights of that name."""
    from gscompleter.models.feed_forward.build import build

    return build(name, weights, device)


def load_pe_field(settings: Any, seed: int, photographs: Sequence[View], device: str) -> Generator:
    """Load PE-Field, the diffusion transformer of the paper."""
    from gscompleter.models.diffusion.pe_field import load_pe_field

    return load_pe_field(seed, device, settings)


def load_diffusers_inpaint(
    settings: Any, seed: int, photographs: Sequence[View], device: str
) -> Generator:
    """Load an inpainting pipeline of diffusers."""
    from gscompleter.models.diffusion.inpaint import load_diffusers_inpaint

    return FunctionGenerator(load_diffusers_inpaint(seed, device, settings))


RECONSTRUCTORS: dict[str, Callable[[Path | None, str], Reconstructor]] = {
    name: partial(load_learned_reconstructor, name)
    for name, weights in PUBLISHED.items()
    if weights.is_reconstructor
}
"""Loaders of the learned reconstructors, called with the path of the weights and a device."""

GENERATORS: dict[str, Callable[[Any, int, Sequence[View], str], Generator]] = {
    "pe-field": load_pe_field,
    "diffusers-inpaint": load_diffusers_inpaint,
}
"""Loaders of the learned generators, called with settings, seed, true images and a device."""

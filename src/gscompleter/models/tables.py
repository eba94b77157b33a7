"""Tables of the learned models, which the core finds through entry points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from gscompleter.config.generators import FileSettings
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


@dataclass(frozen=True)
class InpaintingLoader:
    """Loads a generator that fills holes by a network of one file."""

    load_network: Callable[[Path | None, str], Any]
    settings: ClassVar[type[FileSettings]] = FileSettings

    def __call__(
        self, settings: FileSettings, seed: int, photographs: Sequence[View], device: str
    ) -> Generator:
        """Load the network from the file of the settings, or the published one."""
        from gscompleter.models.inpainting.fill import InpaintingGenerator

        local = None if settings.weights is None else Path(settings.weights)
        return FunctionGenerator(InpaintingGenerator(self.load_network(local, device)))


def load_migan(local: Path | None, device: str) -> Any:
    """Load MI-GAN."""
    from gscompleter.models.inpainting.migan import load_migan

    return load_migan(local, device)


def load_lama(local: Path | None, device: str) -> Any:
    """Load LaMa."""
    from gscompleter.models.inpainting.lama import load_lama

    return load_lama(local, device)


RECONSTRUCTORS: dict[str, Callable[[Path | None, str], Reconstructor]] = {
    name: partial(load_learned_reconstructor, name)
    for name, weights in PUBLISHED.items()
    if weights.is_reconstructor
}
"""Loaders of the learned reconstructors, called with the path of the weights and a device."""

GENERATORS: dict[str, Callable[[Any, int, Sequence[View], str], Generator]] = {
    "pe-field": load_pe_field,
    "diffusers-inpaint": load_diffusers_inpaint,
    "migan": InpaintingLoader(load_migan),
    "lama": InpaintingLoader(load_lama),
}
"""Loaders of the learned generators, called with settings, seed, true images and a device."""

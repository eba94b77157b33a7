"""Tables of the learned models, which the core finds through entry points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gscompleter.config.generators import GeneratorLine, GeneratorSettings
from gscompleter.generators import Generator, as_generator

# The third table, which an entry point finds in this module, too.
from gscompleter.models.depth_predictors import DEPTH_PREDICTORS as DEPTH_PREDICTORS
from gscompleter.models.settings import (
    DiffusersInpaintSettings,
    FileSettings,
    Flux2KleinSettings,
    PEFieldSettings,
)
from gscompleter.models.weights.published import PUBLISHED
from gscompleter.reconstructors import Reconstructor
from gscompleter.types import View

FFGS_VARIANT = "FAMILY/VARIANT"
"""Placeholder in the list of names; `find_loader` passes what the user gives as `variant`."""


# Imports are local, so that naming a model imports neither torch nor the packages of the others.
def load_learned_reconstructor(name: str, weights: Path | None, device: str) -> Reconstructor:
    """Load the reconstructor with the published weights of that name."""
    from gscompleter.models.feed_forward.build import build

    return build(name, weights, device)


def _load_map_anything(weights: Path | None, device: str) -> Reconstructor:
    """Load MapAnything through its own package."""
    from gscompleter.models.map_anything import load_map_anything

    return load_map_anything(weights, device)


def _load_ffgs(weights: Path | None, device: str, variant: str = FFGS_VARIANT) -> Reconstructor:
    """Load a model of the package ffgs."""
    from gscompleter.models.ffgs import load_ffgs

    return load_ffgs(variant, weights, device)


@dataclass(frozen=True)
class GeneratorLoader:
    """Loads a generator, and names the class of its settings."""

    load: Callable[[Any, int, str], Any]
    """Called with settings, seed and device: a learned generator needs no true image."""
    settings: type[GeneratorSettings]
    line: GeneratorLine

    def __call__(
        self, settings: Any, seed: int, photographs: Sequence[View], device: str
    ) -> Generator:
        """Load the generator; a plain function is wrapped."""
        return as_generator(self.load(settings, seed, device))


def _load_pe_field(settings: Any, seed: int, device: str) -> Any:
    """Load PE-Field, the diffusion transformer of the paper."""
    from gscompleter.models.diffusion.pe_field import load_pe_field

    return load_pe_field(seed, device, settings)


def _load_diffusers_inpaint(settings: Any, seed: int, device: str) -> Any:
    """Load an inpainting pipeline of diffusers."""
    from gscompleter.models.diffusion.inpaint import load_diffusers_inpaint

    return load_diffusers_inpaint(seed, device, settings)


def _load_migan(settings: FileSettings, seed: int, device: str) -> Any:
    """Load MI-GAN."""
    from gscompleter.models.inpainting.migan import load_migan

    return load_migan(settings.weights, device)


def _load_lama(settings: FileSettings, seed: int, device: str) -> Any:
    """Load LaMa."""
    from gscompleter.models.inpainting.lama import load_lama

    return load_lama(settings.weights, device)


RECONSTRUCTORS: dict[str, Callable[[Path | None, str], Reconstructor]] = {
    name: partial(load_learned_reconstructor, name)
    for name, weights in PUBLISHED.items()
    if weights.is_reconstructor
} | {"mapanything": _load_map_anything, f"ffgs:{FFGS_VARIANT}": _load_ffgs}
"""Loaders of the learned reconstructors, called with the path of the weights and a device."""

WARPED_INPUT = "the warped photographs and the mask of unseen pixels"
WARPED_OUTPUT = "the warped photographs exactly; {} in the mask"

GENERATORS = {
    "pe-field": GeneratorLoader(
        _load_pe_field,
        PEFieldSettings,
        GeneratorLine(
            input="the nearest photograph, its depth, both cameras",
            output="a newly painted image, colour-matched to the photographs",
            needs="`pip install 'gscompleter[diffusion]'`, weights, in practice a GPU",
        ),
    ),
    "diffusers-inpaint": GeneratorLoader(
        _load_diffusers_inpaint,
        DiffusersInpaintSettings,
        GeneratorLine(
            input=WARPED_INPUT,
            output=WARPED_OUTPUT.format("the model's painting"),
            needs="the same as `pe-field`, and `--generator-weights`",
        ),
    ),
    "flux2-klein": GeneratorLoader(
        _load_diffusers_inpaint,
        Flux2KleinSettings,
        GeneratorLine(
            input="the warped photographs with the hole painted over, the nearest photograph, and "
            "a prompt; no mask",
            output=WARPED_OUTPUT.format("the model's image"),
            needs="the same as `pe-field`; downloads 8 to 13 GB",
        ),
    ),
    "migan": GeneratorLoader(
        _load_migan,
        FileSettings,
        GeneratorLine(
            input=WARPED_INPUT,
            output=WARPED_OUTPUT.format("the network's filling"),
            needs="`pip install 'gscompleter[onnx]'`, 28 MB of weights",
        ),
    ),
    "lama": GeneratorLoader(
        _load_lama,
        FileSettings,
        GeneratorLine(
            input=WARPED_INPUT,
            output=WARPED_OUTPUT.format("the network's filling"),
            needs="`pip install 'gscompleter[onnx]'`, 208 MB of weights",
        ),
    ),
}
"""Loaders of the learned generators, called with settings, seed, photographs and a device."""

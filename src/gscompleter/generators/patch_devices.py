"""Run the rounds of search and vote of the default Φ on a device.

The CPU has compiled loops, whose bytes never change; a GPU has the same as operations on tensors.
Tone, lines and the first matches of a level stay on the CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol, runtime_checkable

from gscompleter.generators.patch_rounds import (
    FINEST_SPACING,
    RunRounds,
    run_with_kernels,
    run_with_tensors,
)
from gscompleter.numerics.tensor_patchmatch import PATCHES_BYTES
from gscompleter.system.devices import make_for_device

MIN_DEVICE_PATCHES = 2**15
"""Patches from which a level is searched on a GPU. A round has some 700 launches for any number of
them (`numerics/tensor_patchmatch.py`), about 3.5 ms; in that time eight threads search and vote
with 30,000 patches, at 0.9 µs of one thread for each."""
SOURCE_BYTES = 17
"""Bytes for each pixel of the sources: colours, depth, and whether it is usable."""
TARGET_BYTES = 130
"""Most bytes for each pixel of the target: the image before and after a round, and what belongs to
the unknown pixels and to a patch of every second one."""


@runtime_checkable
class PatchDevice(Protocol):
    """The choice of an implementation on a device; arrays lie on the CPU."""

    def choose_rounds(self, num_patches: int) -> RunRounds:
        """Choose how a level with so many patches to match is filled."""


@dataclass(frozen=True)
class CpuPatches:
    """Rounds in compiled loops."""

    def choose_rounds(self, num_patches: int) -> RunRounds:
        """Choose the kernels."""
        return run_with_kernels


@dataclass(frozen=True)
class TensorPatches:
    """Rounds as operations of torch."""

    device: str

    def choose_rounds(self, num_patches: int) -> RunRounds:
        """Choose tensors for a large level, and the kernels for a small one."""
        if num_patches < MIN_DEVICE_PATCHES:
            return run_with_kernels
        return partial(run_with_tensors, device=self.device)


PATCH_DEVICES: dict[str, Callable[[str], PatchDevice]] = {
    "cpu": lambda _: CpuPatches(),
    "cuda": TensorPatches,
    # No Mac was at hand, and its GPU has no double precision, in which sums are rounded once.
    "mps": lambda _: CpuPatches(),
}
"""Makers of the choice by the type of the device, from its name."""


def get_patch_device(name: str) -> PatchDevice:
    """Return the choice for a device such as `cuda` or `cuda:1`; InputError for an unknown one."""
    return make_for_device(PATCH_DEVICES, name, "warp-inpaint")


def estimate_patch_bytes(photographs: Sequence[tuple[int, int]], target: tuple[int, int]) -> int:
    """Estimate the most bytes that the holes of an image take on a GPU while they are filled.

    Sizes are heights and widths in pixels. All of the image may be a hole. A small one is filled on
    the CPU, and takes none.
    """
    height, width = target
    # Of the finest level every second patch is matched; others are quarters of it.
    if height * width // FINEST_SPACING < MIN_DEVICE_PATCHES:
        return 0
    # The target is a source, too, and all have the size of the largest.
    heights, widths = zip(*photographs, target, strict=True)
    sources = (len(photographs) + 1) * max(heights) * max(widths)
    return SOURCE_BYTES * sources + TARGET_BYTES * height * width + PATCHES_BYTES

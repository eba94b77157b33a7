"""Compute the planes and surfaces of plane-sweep on a device.

The CPU has compiled loops, whose bytes never change; a GPU has the same as operations on tensors.
Everything else of stereo stays on the CPU: it takes a tenth of the time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol, runtime_checkable

from gscompleter.numerics.kernels import tgv
from gscompleter.numerics.tensor_tgv import fit_on_device
from gscompleter.reconstructors.plane_sweep.matching import (
    PixelMap,
    PlaneSearch,
    search_with_kernels,
    search_with_tensors,
)
from gscompleter.reconstructors.plane_sweep.surfaces import FitHeights
from gscompleter.system.devices import make_for_device

MIN_DEVICE_PIXELS = 2**17
"""Pixels from which a level of the surfaces is fitted on a GPU. A coarser level has twice as many
iterations, each of as many launches (`numerics/tensor_tgv.py`), for a quarter of the pixels: of 2
million the finest two are three quarters of the work, and a tenth of the launches."""


@runtime_checkable
class DepthDevice(Protocol):
    """The steps of plane-sweep that a device implements; arrays lie on the CPU."""

    def find_planes(self, searches: Sequence[PlaneSearch]) -> list[tuple[PixelMap, PixelMap]]:
        """Find the best plane of each pixel, to a fraction, and the cost gap to the second best."""

    def choose_fit(self, num_pixels: int) -> FitHeights:
        """Choose the fit of a level of the surfaces with so many pixels."""


@dataclass(frozen=True)
class CpuDepth:
    """Steps in compiled loops."""

    def find_planes(self, searches: Sequence[PlaneSearch]) -> list[tuple[PixelMap, PixelMap]]:
        """Find the planes of one view after the other with the kernels."""
        return [search_with_kernels(search) for search in searches]

    def choose_fit(self, num_pixels: int) -> FitHeights:
        """Choose the kernel."""
        return tgv.fit


@dataclass(frozen=True)
class TensorDepth:
    """Steps as operations of torch."""

    device: str

    def find_planes(self, searches: Sequence[PlaneSearch]) -> list[tuple[PixelMap, PixelMap]]:
        """Find the planes of all views on the device."""
        return search_with_tensors(searches, self.device)

    def choose_fit(self, num_pixels: int) -> FitHeights:
        """Choose tensors for a large level, and the kernel for a small one."""
        return tgv.fit if num_pixels < MIN_DEVICE_PIXELS else partial(fit_on_device, self.device)


DEPTH_DEVICES: dict[str, Callable[[str], DepthDevice]] = {
    "cpu": lambda _: CpuDepth(),
    "cuda": TensorDepth,
    # No Mac was at hand to compare the results with, and it shares its memory with its CPU.
    "mps": lambda _: CpuDepth(),
}
"""Makers of the steps by the type of the device, from its name."""


def get_depth_device(name: str) -> DepthDevice:
    """Return the steps of a device such as `cuda` or `cuda:1`; InputError for an unknown one."""
    return make_for_device(DEPTH_DEVICES, name, "plane-sweep")

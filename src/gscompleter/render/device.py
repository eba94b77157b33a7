"""The devices on which the renderer and the networks run."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache
from typing import Literal

import torch

from gscompleter.config.settings import Device
from gscompleter.render.gsplat_kernels import explain_missing_gpu, explain_missing_renderer
from gscompleter.system.errors import InputError

RendererDevice = Literal["cpu", "cuda"]
NetworkDevice = Literal["cpu", "cuda", "mps"]
"""AMD's GPUs are `cuda` as well (torch for ROCm); `mps` is the GPU of a Mac."""


@dataclass(frozen=True)
class Devices:
    """The device of the renderer, which photographs and Gaussians share, and that of networks."""

    renderer: RendererDevice
    networks: NetworkDevice


def choose_devices(
    device: Device = "auto",
    renderer: RendererDevice | None = None,
    networks: NetworkDevice | None = None,
) -> Devices:
    """Choose both devices: that of `renderer` or `networks` if it is given, else `device`."""
    return Devices(
        choose_device(device) if renderer is None else choose_device(renderer, "renderer-device"),
        choose_network_device(device, "device")
        if networks is None
        else choose_network_device(networks),
    )


def choose_device(device: Device = "auto", option: str = "device") -> RendererDevice:
    """Choose the device of the renderer; `auto` uses a GPU if gsplat can draw on it.

    Raises:
        InputError: `device` is `cuda`, and gsplat cannot draw; it says what is missing. Or it is
            `mps`, and torch sees no GPU of a Mac.
    """
    # The CPU is chosen without asking for a GPU, which takes time and memory on one.
    if device == "cpu":
        return "cpu"
    # The GPU of a Mac runs networks. The renderer `metal` draws there from Python only: it draws
    # the whole scene anew for each step, and no Mac was at hand to compare it with the CPU.
    if device == "mps":
        choose_network_device(device, option)
        return "cpu"
    missing = explain_missing_renderer()
    if missing is None:
        return "cuda"
    if device == "cuda":
        # A GPU that torch sees still runs the networks.
        hint = ""
        if option == "device" and torch.cuda.is_available():
            hint = ", or the GPU for networks alone (--renderer-device cpu)"
        raise InputError(
            f"The device cuda cannot draw: {missing}. docs/install.md lists all steps; choose the "
            f"device cpu{hint}.",
            option,
        )
    # Without a GPU nothing is missed, and nothing has to be said.
    if torch.cuda.is_available():
        _warn_of_cpu(missing)
    return "cpu"


def choose_network_device(device: Device, option: str = "network-device") -> NetworkDevice:
    """Choose the device of the networks; `auto` uses any GPU that torch sees.

    Raises:
        InputError: torch does not see the GPU that is asked for.
    """
    if device == "cpu":
        return "cpu"
    if device in ("auto", "cuda") and torch.cuda.is_available():
        return "cuda"
    if device in ("auto", "mps") and torch.backends.mps.is_available():
        return "mps"
    if device == "auto":
        return "cpu"
    reason = explain_missing_gpu() if device == "cuda" else "torch sees no GPU of a Mac"
    raise InputError(f"The networks cannot run on {device}: {reason}; choose cpu.", option)


@cache
def _warn_of_cpu(missing: str) -> None:
    """Say once in a process that the renderer stays on the CPU though there is a GPU."""
    logging.getLogger("gscompleter").warning(
        "gscompleter: there is a GPU, but the renderer runs on the CPU: %s.", missing
    )

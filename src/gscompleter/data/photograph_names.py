"""Names of photographs and targets, the same in lines, tables and pages."""

from __future__ import annotations

import math

from gscompleter.system.errors import format_rounded
from gscompleter.types import Camera

RENDER = "render "
"""Beginning of the names of renders in place of photographs."""
MIN_TURN = 0.5
"""Smallest turn of a camera that is said, in degrees."""
MIN_SHIFT = 1e-3
"""Smallest shift of a camera that is said, relative to the longest of its components and 1."""


def name_render(number: int) -> str:
    """Name a render in place of a photograph; they are counted from 1."""
    return f"{RENDER}{number}"


def name_photograph(frame: int | None, file: str | None) -> str:
    """Name a photograph by its number and its file, as in "5 (IMG_0012.jpg)".

    A render in place of one, which has no file, is named by the number in its name alone.
    """
    if file is not None and file.startswith(RENDER):
        return file.removeprefix(RENDER)
    number = "–" if frame is None else str(frame)
    return number if file is None else f"{number} ({file})"


def name_target(
    frame: int | None,
    file: str | None,
    derived_from: int | None,
    offset: str | None,
) -> str:
    """Name a target: a photograph, a camera near one, or a camera from elsewhere.

    `file` is that of the photograph that it is or that it was derived from, or the name of a render
    in its place; `offset` tells targets near one photograph apart.
    """
    kind = "render" if file is not None and file.startswith(RENDER) else "photograph"
    if derived_from is not None:
        near = f"near {kind} {name_photograph(derived_from, file)}"
        return near if offset is None else f"{near}, {offset}"
    return "a given camera" if frame is None else f"{kind} {name_photograph(frame, file)}"


def describe_offset(camera: Camera, base: Camera) -> str:
    """Describe how a camera is moved and turned from another one, as that one looks."""
    # Into the axes of the base camera.
    axes = base.c2w[:3, :3].double().T
    shift = (axes @ (camera.center - base.center).double()).tolist()
    x, y, z = (axes @ camera.forward.double()).tolist()
    yaw = math.degrees(math.atan2(x, z))
    pitch = math.degrees(math.atan2(-y, math.hypot(x, z)))
    parts = []

    # The axes of a camera point right, down and forward; only the longest move is said.
    length, negative, positive = max(
        zip(shift, ("left", "up", "back"), ("right", "down", "forward"), strict=True),
        key=lambda one: abs(one[0]),
    )
    if abs(length) >= MIN_SHIFT * max(1.0, base.center.abs().max().item()):
        side = positive if length > 0 else negative
        parts.append(f"moved {side} by {format_rounded(abs(length), 2)}")

    if max(abs(yaw), abs(pitch)) >= MIN_TURN:
        if abs(yaw) >= abs(pitch):
            side = "right" if yaw > 0 else "left"
            turn = yaw
        else:
            side = "up" if pitch > 0 else "down"
            turn = pitch
        parts.append(f"turned {side} by {abs(turn):.0f}°")
    return " and ".join(parts) or "at the same place"

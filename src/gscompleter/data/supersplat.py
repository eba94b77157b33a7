"""Camera poses of SuperSplat: the `poseSets` of a project's document.json, or the list.

A pose has a position and a target in SuperSplat's world, which is that of the splat rotated by 180°
about z, so that y points up. It has neither image size nor roll: cameras are upright, and their
field of view is that of the longer side.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.frame import Frame, capitalize
from gscompleter.data.json_fields import get_array, get_optional_number
from gscompleter.data.resize import Resolution
from gscompleter.errors import InputError, quote_value

DEFAULT_FOV = 60.0
"""SuperSplat's default field of view, in degrees."""
FOV_RANGE = (1.0, 179.0)
"""Range of the field of view, in degrees."""
SPLAT_FROM_WORLD = np.array([-1.0, -1.0, 1.0])
"""Axis factors from SuperSplat's world to the splat: 180° about z."""
ADVICE = "export the camera poses from SuperSplat again"


def is_supersplat(content: Any) -> bool:
    """Check whether the content of a JSON file holds poses of SuperSplat."""
    if isinstance(content, dict):
        return "poseSets" in content
    first = content[0] if isinstance(content, list) and content else None
    return isinstance(first, dict) and "target" in first and "rotation" not in first


def parse_poses(content: Any, path: Path, resolution: Resolution) -> list[Frame]:
    """Read SuperSplat's poses as cameras in the frame of the splat; `resolution` must be given."""
    if resolution is None or isinstance(resolution, int):
        raise InputError(
            f"The poses of SuperSplat in {quote_value(path)} have no image size; give a resolution "
            "(height and width).",
            "resolution",
        )
    poses = _find_poses(content)
    if not isinstance(poses, list) or not poses:
        raise InputError(f"{quote_value(path)} holds no poses; {ADVICE}.")
    return [
        _parse_frame(pose, f"pose {n} of {quote_value(path)}", resolution)
        for n, pose in enumerate(poses)
    ]


def _find_poses(content: Any) -> Any:
    if isinstance(content, list):
        return content
    sets = content["poseSets"]
    first = sets[0] if isinstance(sets, list) and sets else None
    return first.get("poses") if isinstance(first, dict) else None


def _parse_frame(pose: Any, title: str, resolution: tuple[int, int]) -> Frame:
    if not isinstance(pose, dict):
        raise InputError(
            f"{capitalize(title)} is no object with a position and a target; {ADVICE}."
        )
    position, target = (
        get_array(pose, key, (3,), title) * SPLAT_FROM_WORLD for key in ("position", "target")
    )
    height, width = resolution
    fov = get_optional_number(pose, "fov", title, *FOV_RANGE) or DEFAULT_FOV
    focal = max(height, width) / 2 / math.tan(math.radians(fov) / 2)
    intrinsics = Intrinsics((width, height), (focal, focal))
    return Frame(title, title, _build_upright_c2w(position, target), intrinsics, None)


def _build_upright_c2w(
    position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Build camera-to-world of an upright camera that points at a target; NaN along y."""
    with np.errstate(all="ignore"):
        z = (target - position) / np.linalg.norm(target - position)
        x = np.cross([0.0, 1.0, 0.0], z)
        x = x / np.linalg.norm(x)
    c2w = np.eye(4)
    c2w[:3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
    c2w[:3, 3] = position
    return c2w

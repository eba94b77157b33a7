"""Targets that earlier commands completed, as the record beside the splat tells (decision 151).

What was invented for a target gives way where photographs show something else, and what a scene
shows is another after it is made anew. Both open holes where an earlier command had filled them.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gscompleter.data.photographs import Resolution
from gscompleter.data.scene import parse_camera
from gscompleter.numerics.geometry import is_same_camera
from gscompleter.splats.edits import Edit, Edits
from gscompleter.system.errors import InputError
from gscompleter.types import Camera

EMPTY_SHARES = "empty"
"""Key of an edit's settings: the empty share of the image of each of its `cameras`, in order."""


@dataclass(frozen=True)
class EarlierTarget:
    """A target of an earlier command."""

    camera: Camera
    """The camera, in the frame of the photographs as they are read."""
    empty_share: float
    """Share of its image that this command left empty."""


def read_earlier_targets(
    edits: Edits,
    files: Mapping[int | None, str],
    resolution: Resolution,
    origin: Float[np.ndarray, "3"],
) -> tuple[EarlierTarget, ...]:
    """Read the targets of all edits of a splat that used photographs of a folder.

    `files` are those of the photographs of the folder, and `origin` is that of their coordinates.
    Of a camera that was completed twice, the later edit counts. There are none of a splat that
    another program changed since, as that may have moved it.
    """
    if not edits.is_unchanged:
        return ()
    names = set(files.values())
    found: list[EarlierTarget] = []
    for edit in edits.edits:
        # The cameras are in the frame of its photographs.
        photographs = edit.settings.get("photographs")
        if not photographs or not names.issuperset(photographs):
            continue
        for target in read_targets_of(edit, resolution, origin):
            others = [other for other in found if not is_same_camera(other.camera, target.camera)]
            found = [*others, target]
    return tuple(found)


def read_targets_of(
    edit: Edit, resolution: Resolution, origin: Float[np.ndarray, "3"]
) -> list[EarlierTarget]:
    """Read the targets of an edit; none if an earlier version did not tell what it left empty.

    A record that somebody changed may hold anything. It is read when a completion is done, which is
    not lost for it.
    """
    cameras = edit.settings.get("cameras")
    shares = edit.settings.get(EMPTY_SHARES)
    if not isinstance(cameras, list) or not isinstance(shares, list):
        return []
    title = "a camera in the record of edits"
    targets = []
    for described, share in zip(cameras, shares, strict=False):
        if not isinstance(described, dict) or not isinstance(share, (int, float)):
            continue
        with suppress(InputError):
            camera = parse_camera(described, title, resolution, origin.tolist())
            targets.append(EarlierTarget(camera, float(share)))
    return targets

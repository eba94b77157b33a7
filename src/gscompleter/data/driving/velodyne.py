"""KITTI's laser sweeps: x, y, z and reflectance as float32, in the laser frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import read_bytes

POINT_BYTES = 16
"""Size of a point in bytes."""
MAX_BYTES = 1 << 28
"""Largest sweep, in bytes."""


def read_sweep(path: Path, world_from_laser: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 3"]:
    """Read the points of a sweep in the world frame, in metres."""
    data = read_bytes(path, MAX_BYTES)
    if len(data) % POINT_BYTES:
        raise InputError(
            f"{quote_value(path)} is truncated: it ends within a point; copy it again."
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    finite = points[np.isfinite(points).all(axis=1)]
    return finite @ world_from_laser[:3, :3].T + world_from_laser[:3, 3]

"""A splat in map coordinates, as programs for surveys export it: positions are double."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gscompleter import save_ply
from gscompleter.types import Gaussians
from scenes import random_gaussians

PLACE = np.array([500000.25, 4649776.5, 300.0])
"""Place of zero in a zone of UTM, in metres."""


def small_gaussians(count: int = 300, seed: int = 0) -> Gaussians:
    """Make Gaussians of about two centimetres within some metres."""
    gaussians = random_gaussians(count, seed=seed, sh_degree=1)
    return replace(gaussians, scales=gaussians.scales.clamp(0.01, 0.03), encoded=None)


def write_map_ply(
    path: Path, gaussians: Gaussians, place: np.ndarray = PLACE, kind: str = "double"
) -> np.ndarray:
    """Write a .ply whose positions lie at `place`; return them in float64, [n, 3]."""
    save_ply(path, replace(gaussians, origin=None))
    header, body = path.read_bytes().split(b"end_header\n")
    names = [line.split()[2].decode() for line in header.splitlines() if b"property" in line]
    rows = np.frombuffer(body, [(name, "<f4") for name in names])
    wide = np.dtype(
        [(n, {"double": "<f8", "float": "<f4"}[kind] if n in "xyz" else "<f4") for n in names]
    )
    written = np.empty(len(rows), wide)
    for name in names:
        written[name] = rows[name]
    means = gaussians.means.double().numpy() + place
    for axis, name in enumerate("xyz"):
        written[name] = means[:, axis]
        header = header.replace(
            f"property float {name}\n".encode(), f"property {kind} {name}\n".encode()
        )
    path.write_bytes(header + b"end_header\n" + written.tobytes())
    return means

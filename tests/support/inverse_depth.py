"""Depth beside a COLMAP model: inverse depth as 3DGS reads it, and COLMAP's dense stereo."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from exact_room import ExactCamera

HIGHEST = 65535
"""Largest value of a map; 3DGS divides by one more."""


def write_inverse_depth(
    scene: Path,
    cameras: Sequence[ExactCamera],
    factors: Mapping[int, np.ndarray] | None = None,
    scales: Mapping[int, float] | None = None,
) -> Path:
    """Write depths/*.png and depth_params.json beside a model whose photographs are photo_NNN.png.

    `factors` multiply the inverse depth of some photographs, `scales` replace what is written.
    """
    (scene / "depths").mkdir()
    parameters = {}
    for number, camera in enumerate(cameras):
        inverse = 1 / camera.depth * (factors or {}).get(number, 1.0)
        low, high = inverse.min(), inverse.max()
        values = np.round((inverse - low) / (high - low) * HIGHEST).astype(np.uint16)
        Image.fromarray(values).save(scene / f"depths/photo_{number:03d}.png")
        scale = (scales or {}).get(number, float(high - low) * (HIGHEST + 1) / HIGHEST)
        parameters[f"photo_{number:03d}"] = {"scale": scale, "offset": float(low)}
    (scene / "sparse/0/depth_params.json").write_text(json.dumps(parameters))
    return scene


def write_dense_depth(scene: Path, cameras: Sequence[ExactCamera]) -> Path:
    """Write stereo/depth_maps as COLMAP does, with a hole in the upper left corner."""
    folder = scene / "stereo" / "depth_maps"
    folder.mkdir(parents=True)
    for number, camera in enumerate(cameras):
        depth = camera.depth.astype("<f4")
        depth[:4, :4] = 0
        head = f"{camera.width}&{camera.height}&1&".encode()
        (folder / f"photo_{number:03d}.png.geometric.bin").write_bytes(head + depth.tobytes())
    return scene

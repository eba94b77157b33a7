"""Compilation of all kernels in advance, by completing a tiny scene: a textured wall.

Kernels are compiled at their first call, for the types of its arguments. A completion calls all of
them with the types that users' scenes have.
"""

from __future__ import annotations

import time
from collections.abc import Collection
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from gscompleter.completer import GSCompleter
from gscompleter.numerics.image_ops import smooth_masked
from gscompleter.numerics.kernels.compiled import get_cache_folder, is_compiled, mark_compiled
from gscompleter.render.gsplat_kernels import explain_missing_gpu, explain_missing_renderer
from gscompleter.render.loading import load_renderer
from gscompleter.render.lod import simplify_scene
from gscompleter.splats.morton import sort_nearby
from gscompleter.splats.ply import load_ply, save_ply
from gscompleter.system.progress import show_progress, stage
from gscompleter.types import Camera, View

SPLAT_PART = "splat"
"""Part that only input splats need."""
PARTS = ("cpu", "plane-sweep", "warp-inpaint", SPLAT_PART)
"""Renderer, models and part that have kernels."""

IMAGE_SIZE_PX = 64
DISPARITY_PX = 6
"""Disparity of the wall between neighbouring cameras, in pixels."""
WALL_DEPTH = 2.0
"""Depth of the wall, in baselines."""


def list_missing(names: Collection[str]) -> list[str]:
    """List those of some parts whose kernels are not compiled."""
    return [name for name in PARTS if name in names and not is_compiled(name)]


def compile_kernels(names: Collection[str]) -> float | None:
    """Compile the missing kernels of these parts; return the seconds, or None if there are none."""
    missing = list_missing(names)
    # Without a cache each kernel is compiled when it is used, and a rehearsal gains nothing.
    if not missing or get_cache_folder() is None:
        return None

    start = time.perf_counter()
    # The stages of the rehearsal are none of the user's scene, and are not shown.
    with stage("compiling kernels for this machine, once"), show_progress(None):
        rehearse(with_splat=SPLAT_PART in missing)

    # The rehearsal completes with all models, and so compiles all parts but that of the splat even
    # if only one of them was asked for.
    for name in PARTS:
        if name != SPLAT_PART or SPLAT_PART in missing:
            mark_compiled(name)
    return time.perf_counter() - start


def compile_gsplat() -> str | None:
    """Compile gsplat's kernels for the GPU, if there is one; return a sentence about it."""
    if explain_missing_gpu() is not None:
        return None
    missing = explain_missing_renderer()
    if missing is None:
        return "gsplat is compiled for the GPU."
    return f"The GPU cannot draw: {missing}."


def rehearse(with_splat: bool) -> None:
    """Complete the wall, reconstructed from two photographs and optionally given."""
    completer = GSCompleter(renderer=load_renderer("cpu"))
    views = make_photographs()
    target = make_wall_camera(2)
    completion = completer(views, target)
    # Results are written, and splats are read, by kernels as well.
    with TemporaryDirectory() as folder:
        save_ply(Path(folder, "wall.ply"), completion.scene)
        wall = load_ply(Path(folder, "wall.ply"))
    sort_nearby(wall)
    if with_splat:
        # The reconstructed context stands for a splat, which comes with check views.
        completer(views, target, completion.context, views)
        simplify_scene(completion.context, [target])


def make_photographs() -> list[View]:
    """Create photographs of the wall, parallel to their image planes, by two cameras."""
    # Smoothed noise is a texture that stereo can match; white noise differs from pixel to pixel.
    random = torch.Generator().manual_seed(0)
    noise = torch.rand(IMAGE_SIZE_PX, IMAGE_SIZE_PX + DISPARITY_PX, 3, generator=random)
    wall = smooth_masked(noise, torch.ones(noise.shape[:2], dtype=torch.bool), 1)
    # A camera one baseline farther to the right sees the same wall, shifted by the disparity.
    return [
        View(wall[:, DISPARITY_PX * i :][:, :IMAGE_SIZE_PX].contiguous(), make_wall_camera(i))
        for i in range(2)
    ]


def make_wall_camera(place: int) -> Camera:
    """Create a camera `place` baselines to the right."""
    c2w = torch.eye(4)
    c2w[0, 3] = place
    # Disparity = focal length * baseline / depth, with a baseline of 1.
    focal = DISPARITY_PX * WALL_DEPTH
    K = torch.tensor([[focal, 0, IMAGE_SIZE_PX / 2], [0, focal, IMAGE_SIZE_PX / 2], [0, 0, 1]])
    return Camera(c2w, K, IMAGE_SIZE_PX, IMAGE_SIZE_PX, near=WALL_DEPTH / 2, far=WALL_DEPTH * 4)

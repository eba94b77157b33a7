"""Compilation of kernels in advance, by completing a tiny scene: a textured wall.

Kernels are compiled at their first call, for the types of its arguments. A completion calls all of
them with the types that users' scenes have. Those of the models are compiled in a process of their
own, beside the others: numba compiles on one thread of a process only.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.completer import GSCompleter
from gscompleter.generators import load_generator
from gscompleter.numerics.geometry import unproject
from gscompleter.numerics.image_ops import smooth_masked
from gscompleter.numerics.kernels.compiled import get_cache_folder, is_compiled, mark_compiled
from gscompleter.numerics.kernels.splat_rows import mark_usable
from gscompleter.reconstructors import Reconstructor, load_reconstructor
from gscompleter.render.gsplat_kernels import explain_missing_gpu, explain_missing_renderer
from gscompleter.render.loading import load_renderer
from gscompleter.render.lod import simplify_scene
from gscompleter.splats.morton import sort_nearby
from gscompleter.splats.ply import load_ply, save_ply
from gscompleter.system.children import start_python
from gscompleter.system.progress import show_progress, stage
from gscompleter.system.threads import get_thread_count
from gscompleter.types import (
    Camera,
    DepthMap,
    GeneratorInput,
    Reconstruction,
    View,
    make_observed,
    merge,
    sh_from_rgb,
)

RENDERER_PART = "cpu"
"""Renderer, optimisation and files of splats."""
RECONSTRUCTOR_PART = "plane-sweep"
GENERATOR_PART = "warp-inpaint"
SPLAT_PART = "splat"
"""Part that only input splats need."""
COSTS = {RENDERER_PART: 58, RECONSTRUCTOR_PART: 41, GENERATOR_PART: 18, SPLAT_PART: 18}
"""Time to compile each part that has kernels, in that of `time_compilation` (decision 098)."""
PARTS = tuple(COSTS)
"""The parts that have kernels: the renderer, the models, and what input splats need."""
PARTS_BESIDE = (RECONSTRUCTOR_PART, GENERATOR_PART)
"""Parts that are compiled in a process of their own, beside the others."""
CHILD = "import sys; from gscompleter.apps.warmup import rehearse; rehearse(sys.argv[1:])"
"""Program of that process."""

IMAGE_SIZE_PX = 64
DISPARITY_PX = 6
"""Disparity of the wall between neighbouring cameras, in pixels."""
WALL_DEPTH = 2.0
"""Depth of the wall, in baselines."""


def list_uncompiled(names: Collection[str]) -> list[str]:
    """List those of some parts whose kernels are not compiled."""
    return [name for name in PARTS if name in names and not is_compiled(name)]


def compile_kernels(names: Collection[str]) -> float | None:
    """Compile the missing kernels of these parts; return the seconds.

    Return None if none is missing, or without a cache.
    """
    # Without a cache each kernel is compiled when it is used, and a rehearsal gains nothing.
    if not list_uncompiled(names) or get_cache_folder() is None:
        return None
    start = time.perf_counter()
    with compile_beside(names):
        pass
    return time.perf_counter() - start


@contextmanager
def compile_beside(names: Collection[str]) -> Iterator[None]:
    """Compile the missing kernels of these parts, some of them beside the block, the rest after it.

    Within the block only what needs few kernels should be done, such as reading photographs and a
    splat: they are compiled before the line that announces the others.
    """
    missing = list_uncompiled(names)
    # As in `compile_kernels`.
    if not missing or get_cache_folder() is None:
        yield
        return

    models, others = split_work(missing, get_thread_count())
    child = start_python(CHILD, models) if models else None
    try:
        yield
        # The stages of the rehearsal are none of the user's scene, and are not shown.
        with stage(describe_compilation(models, others)), show_progress(None):
            rehearse(others)
            if child is not None and child.wait() != 0:
                logging.getLogger("gscompleter").warning(
                    "gscompleter: The process that compiles beside this one ended with code %d; "
                    "its kernels are compiled here.",
                    child.returncode,
                )
                rehearse(models)
    finally:
        if child is not None and child.poll() is None:
            child.kill()
            child.wait()
    for name in missing:
        mark_compiled(name)


def split_work(missing: Sequence[str], threads: int) -> tuple[list[str], list[str]]:
    """Split missing parts into those for a process of their own, and the others."""
    models = [name for name in missing if name in PARTS_BESIDE]
    others = [name for name in missing if name not in PARTS_BESIDE]
    # Models call the renderer at the end. By then this process has compiled its kernels, and if it
    # need not, one process is enough.
    if threads == 1 or RENDERER_PART not in others:
        return [], [*others, *models]
    return models, others


def describe_compilation(models: Sequence[str], others: Sequence[str]) -> str:
    """Describe that kernels are compiled, and about how long it takes on this machine."""
    # Both processes work at the same time.
    cost = max(sum(COSTS[name] for name in names) for names in (models, others))
    return f"compiling kernels for this machine, once, {format_duration(cost * time_compilation())}"


def format_duration(seconds: float) -> str:
    """Format a rough time, as multiples of five or ten seconds."""
    step = 5 if seconds < 30 else 10
    return f"about {max(step, step * round(seconds / step))} s"


def time_compilation() -> float:
    """Measure how long it takes to compile one kernel on this machine, in seconds."""
    # The first compilation of a process also imports the parts of numba that compile.
    numba.njit(lambda start: start)(0)
    one = np.ones((1, 4), np.float32)
    kernel = numba.njit(nogil=True, error_model="numpy")(mark_usable.py_func)
    start = time.perf_counter()
    kernel(0, 1, one, one, one, one[0], one, *one[0, :3], np.empty(1, np.bool_))
    return time.perf_counter() - start


def compile_gsplat() -> str | None:
    """Compile gsplat's kernels for the GPU, if there is one; return a sentence about it."""
    if explain_missing_gpu() is not None:
        return None
    missing = explain_missing_renderer()
    if missing is None:
        return "gsplat is compiled for the GPU."
    return f"The GPU cannot draw: {missing}."


def rehearse(parts: Collection[str]) -> None:
    """Complete the wall with the kernels of these parts, and others where they are needed.

    It is reconstructed from two photographs, and then given for the part of input splats.
    """
    has_reconstructor = RECONSTRUCTOR_PART in parts
    reconstructor: Reconstructor = (
        load_reconstructor(RECONSTRUCTOR_PART) if has_reconstructor else reconstruct_wall
    )
    generator = load_generator(GENERATOR_PART) if GENERATOR_PART in parts else paint
    completer = GSCompleter(reconstructor, generator, load_renderer("cpu"))
    views = make_photographs()
    target = make_wall_camera(2)
    completion = completer(views, target)
    if RENDERER_PART in parts:
        # Results are written, and splats are read, by kernels as well.
        with TemporaryDirectory() as folder:
            save_ply(Path(folder, "wall.ply"), completion.scene)
            wall = load_ply(Path(folder, "wall.ply"))
        sort_nearby(wall)
    if SPLAT_PART in parts:
        # The reconstructed context stands for a splat, which comes with check views.
        completer(views, target, completion.context, views)
        simplify_scene(completion.context, [target])


def make_photographs() -> list[View]:
    """Create photographs of the wall, parallel to their image planes, by two cameras."""
    cameras = [make_wall_camera(place) for place in range(2)]
    return [View(draw_wall(camera), camera) for camera in cameras]


def make_wall_camera(place: int) -> Camera:
    """Create a camera `place` baselines to the right."""
    c2w = torch.eye(4)
    c2w[0, 3] = place
    # Disparity = focal length * baseline / depth, with a baseline of 1.
    focal = DISPARITY_PX * WALL_DEPTH
    K = torch.tensor([[focal, 0, IMAGE_SIZE_PX / 2], [0, focal, IMAGE_SIZE_PX / 2], [0, 0, 1]])
    return Camera(c2w, K, IMAGE_SIZE_PX, IMAGE_SIZE_PX, near=WALL_DEPTH / 2, far=WALL_DEPTH * 4)


def draw_wall(camera: Camera) -> Float[Tensor, "h w 3"]:
    """Draw the wall as one of its cameras sees it, also with padding."""
    # Smoothed noise is a texture that stereo can match; white noise differs from pixel to pixel.
    random = torch.Generator().manual_seed(0)
    noise = torch.rand(2 * IMAGE_SIZE_PX, 2 * IMAGE_SIZE_PX, 3, generator=random)
    wall = smooth_masked(noise, torch.ones(noise.shape[:2], dtype=torch.bool), 1)
    # A camera one baseline farther to the right sees the same wall, shifted by the disparity.
    left = IMAGE_SIZE_PX - camera.K[0, 2] + DISPARITY_PX * camera.center[0]
    top = IMAGE_SIZE_PX - camera.K[1, 2]
    columns = (torch.arange(camera.width) + left.round().long()) % wall.shape[1]
    rows = (torch.arange(camera.height) + top.round().long()) % wall.shape[0]
    return wall[rows][:, columns].contiguous()


def paint(nearest: View, target: Camera, context: GeneratorInput) -> Float[Tensor, "h w 3"]:
    """Draw the wall in place of Φ, whose kernels another process compiles."""
    return draw_wall(target)


def reconstruct_wall(views: Sequence[View]) -> Reconstruction:
    """Place a Gaussian at each pixel in place of Ψ, whose kernels another process compiles."""
    depths = [torch.full(view.image.shape[:2], WALL_DEPTH) for view in views]
    gaussians = []
    for view, depth in zip(views, depths, strict=True):
        means = unproject(depth, view.camera).reshape(-1, 3)
        ones = torch.ones(len(means), 3)
        gaussians.append(
            make_observed(
                means=means,
                quats=torch.tensor([1.0, 0, 0, 0]).repeat(len(means), 1),
                scales=ones * WALL_DEPTH / view.camera.K[0, 0],
                opacities=0.9 * ones[:, 0],
                sh=sh_from_rgb(view.image.reshape(-1, 3)),
            )
        )
    maps = [DepthMap(depth, torch.ones_like(depth, dtype=torch.bool)) for depth in depths]
    return Reconstruction(merge(gaussians), tuple(maps))

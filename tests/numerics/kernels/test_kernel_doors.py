"""No number, however odd, makes a compiled loop read or write out of bounds.

Cases that could crash the process run in another one.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import InputError, View
from gscompleter.numerics.kernels import stereo
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.render.cpu import MAX_TILED_SIDE, CpuRenderer, to_arrays
from gscompleter.render.viewpoint import check_lengths
from paths import SUPPORT
from scenes import camera_at, random_gaussians, unchecked

ODD = [np.nan, np.inf, -np.inf, 3e38, -3e38, 1e19, -1e19, 1e-38, 0.0]

DRAW = """
import sys
sys.path.insert(0, sys.argv[1])
from dataclasses import replace
from gscompleter.render.cpu import CpuRenderer
from scenes import camera_at, random_gaussians, unchecked
camera, gaussians, drawn = camera_at(size=40), random_gaussians(50, sh_degree=1), 0
def draw(gaussians, camera):
    global drawn
    gaussians = replace(gaussians, means=gaussians.means.clone().requires_grad_())
    render = CpuRenderer(threads=1).render(gaussians, camera)
    (render.image.sum() + render.depth.sum()).backward()
    drawn += 1
for odd in map(float, sys.argv[2:]):
    for name in ("means", "quats", "scales", "opacities", "sh"):
        values = getattr(gaussians, name).clone()
        values.view(-1)[:9] = odd
        draw(replace(gaussians, **{name: values}), camera)
    for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)):
        K = camera.K.clone()
        K[row, column] = odd
        draw(gaussians, unchecked(camera, K=K))
    for row in range(3):
        c2w = camera.c2w.clone()
        c2w[row, 3] = odd
        draw(gaussians, unchecked(camera, c2w=c2w))
    draw(gaussians, unchecked(camera, near=odd))
print(drawn)
"""

SWEEP = """
import numpy as np
from gscompleter.numerics.kernels import stereo
from gscompleter.reconstructors.plane_sweep.sweep import make_full_bands
image = np.random.default_rng(0).random((24, 20, 3)).astype(np.float32)
planes = np.linspace(0, 1, 6).astype(np.float32)
bands = make_full_bands((24, 20), 6)
ran, noise, detail = 0, np.float32(0.01), np.float32(0.4)
for odd in map(float, sys.argv[2:]):
    for row in range(3):
        for column in range(4):
            transform = np.eye(3, 4, dtype=np.float32)
            transform[row, column] = odd
            stereo.compute_matching_costs(image, image, transform, planes, bands, 2, noise, detail)
            stereo.reproject(image[..., 0], image[..., 1], transform, transform)
            pixels = np.nonzero(image[..., 0] > 0.5)
            stereo.reproject_pixels(*pixels, image[..., 0], image[..., 1], transform, transform)
            ran += 1
    odd_planes = np.full(6, odd, np.float32)
    stereo.compute_matching_costs(image, image, transform, odd_planes, bands, 2, noise, detail)
print(ran)
"""


def lines_of(code: str, *words: object) -> list[str]:
    """Run a process and return its lines; a signal that kills it fails the test."""
    command = [sys.executable, "-c", code, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.split()


# The first numbers of each kind, and the others.
@pytest.mark.parametrize("numbers", [ODD[:4], pytest.param(ODD[4:], marks=pytest.mark.slow)])
def test_the_rasteriser_and_the_plane_sweep_bear_every_number(numbers):
    """Both in one process, whose start takes longest."""
    counts = [13 * len(numbers), 12 * len(numbers)]
    assert lines_of(DRAW + SWEEP, SUPPORT, *numbers) == [str(count) for count in counts]


@pytest.mark.parametrize("odd", [*ODD, 7.0, -7.0, 2.5])
def test_whatever_becomes_an_index_lies_within_the_image(odd):
    clipped = stereo._clip(np.float32(odd), np.float32(0), np.float32(5))
    assert 0 <= clipped <= 5
    if np.isfinite(odd):
        assert clipped == np.clip(np.float32(odd), 0, 5)


@pytest.mark.parametrize("size", [(0, 5), (-1, 5), (MAX_TILED_SIDE + 1, 5), (10**9, 10**9)])
def test_an_image_that_cannot_be_numbered_is_refused(size):
    camera = unchecked(camera_at(size=16), width=size[0], height=size[1])
    with pytest.raises(InputError, match="cannot be rendered"):
        CpuRenderer().render(random_gaussians(3), camera)


def test_more_entries_than_can_be_numbered_are_refused(monkeypatch):
    monkeypatch.setattr("gscompleter.render.viewpoint.MAX_ENTRIES", 10)
    with pytest.raises(InputError, match="use fewer or smaller Gaussians"):
        CpuRenderer().render(random_gaussians(100), camera_at(size=64))


def test_fields_of_different_lengths_are_refused():
    arrays = to_arrays(random_gaussians(5))
    with pytest.raises(ValueError, match=r"different lengths: \[3, 5\]"):
        check_lengths(arrays._replace(opacities=np.ones(3, np.float32)))


@pytest.mark.parametrize("size", [(1, 40), (40, 1), (7, 7)])
def test_stereo_on_a_line_of_pixels_is_refused(size):
    views = []
    for x in (-0.3, 0.1):
        camera = replace(camera_at(x, size=40), width=size[0], height=size[1])
        views.append(View(torch.rand(size[1], size[0], 3), camera))
    with pytest.raises(InputError, match="needs at least 8 x 8"):
        PlaneSweep()(views)

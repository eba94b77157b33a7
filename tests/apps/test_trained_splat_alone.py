"""A trained splat of which nothing but the file is known keeps what it shows, from everywhere."""

import json
from dataclasses import replace

import pytest
import torch

from command import run
from gscompleter import load_cameras, load_splat
from gscompleter.data.scene import write_cameras
from gscompleter.numerics.geometry import add_near_plane
from gscompleter.render.loading import load_renderer
from paths import DATA

FOX = DATA / "splats" / "fox"
SIDE = 128
UNTRAINED = 34
"""A photograph that the trainer did not see, in whose image 0.1 % is a hole."""

needs_fox = pytest.mark.skipif(
    not FOX.is_dir(), reason="needs the trained splat of GSCOMPLETER_DATA"
)


# `test_splat_alone.py` demands the same of a splat of a synthetic room.
@pytest.mark.slow
@needs_fox
@pytest.mark.parametrize("margin", [(), ("--config.margin", 0.25)])
def test_photographs_that_nobody_named_see_the_splat_as_before(tmp_path, monkeypatch, margin):
    splat = tmp_path / "splat.ply"
    splat.write_bytes((FOX / "splat.ply").read_bytes())
    cameras = [replace(c, near=None, far=None) for c in load_cameras(FOX, resolution=SIDE)]
    write_cameras(tmp_path / "target.json", [cameras[UNTRAINED]])
    out = tmp_path / "out"
    words = ("complete", splat, "--target", tmp_path / "target.json", "--resolution", SIDE)
    assert run(monkeypatch, *words, *margin, "--out", out, "--quiet") == 0

    summary = json.loads((out / "summary.json").read_text())
    (target,) = summary["targets"]
    assert target["added"] > 0
    if not margin:
        # About as many as the pixels of the hole with its seam, and none in any padding.
        assert target["added"] < 1000
    assert summary["kept"]["worst_psnr"] > 45

    before = load_splat(splat)
    after = load_splat(out / "completed.ply")
    renderer = load_renderer("cpu")
    for camera in cameras[::4]:
        ranged = add_near_plane(camera, before.means)
        given = renderer.render(before, ranged)
        error = (renderer.render(after, ranged).image - given.image).square().mean(dim=-1)
        opaque = given.alpha >= 0.95
        assert -10 * torch.log10(error[opaque].mean().clamp_min(1e-12)) > 45

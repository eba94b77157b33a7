"""Detection of the vehicle that carries the camera, which is fixed in the image."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from command import run
from gscompleter.config import CompleterConfig
from gscompleter.data.formats import open_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.data.scene import write_cameras
from gscompleter.evaluation.cases import Case, open_clips
from gscompleter.evaluation.protocols import make_tasks, parse_protocol
from gscompleter.reconstructors import load_reconstructor
from gscompleter.reconstructors.features.matches import detect_features
from gscompleter.reconstructors.features.stereo_image import make_stereo_images
from gscompleter.stages.context import reconstruct_context
from gscompleter.system.files.image import read_image, write_image
from gscompleter.system.files.reading import read_json
from gscompleter.types import SH_C0, Camera
from scenes import camera_at, open_street

SIZE, COUNT, STEP = 128, 10, 0.7
Painter = Callable[[Tensor, int], Tensor]


def bonnet(size: int = SIZE, height: float = 0.17) -> Tensor:
    """Return the mask of an arched bonnet at the bottom of the image."""
    x = torch.linspace(-1, 1, size)
    top = size * (1 - height + 0.07 * x.abs() ** 2.5)
    return torch.arange(size)[:, None] + 0.5 >= top


def with_bonnet(image: Tensor, number: int) -> Tensor:
    """Render a noisy bonnet with reflections and seams into a photograph."""
    size = image.shape[0]
    shade = 0.05 + 0.2 * torch.linspace(-1, 1, size)[:, None, None] ** 2
    paint = torch.where((torch.arange(size) % 40 == 3)[None, :, None], 0.3, shade)
    reflected = image.flip(0).roll(size // 3, 0)
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(number))
    own = 0.7 * paint + 0.3 * reflected + 0.01 * noise
    return torch.where(bonnet(size)[..., None], own, image).clamp(0, 1)


def untouched(image: Tensor, number: int) -> Tensor:
    return image


def with_even_road(image: Tensor, number: int) -> Tensor:
    """Render an even road between kerbs that lead to the vanishing point."""
    size = image.shape[0]
    y, x = torch.arange(size)[:, None] + 0.5, torch.arange(size)[None] + 0.5
    on_road = (x - size / 2).abs() < 0.9 * (y - size / 2)
    return torch.where(on_road[..., None], 0.35, image)


def drive(
    folder: Path, paint: Painter = with_bonnet, cameras: Sequence[Camera] | None = None
) -> Photographs:
    """Return a clip of a straight drive down the street."""
    folder.mkdir(exist_ok=True)
    given = cameras or [camera_at(z=STEP * n, size=SIZE) for n in range(COUNT)]
    names = [f"{number:02}.png" for number in range(len(given))]
    for number, (name, camera) in enumerate(zip(names, given, strict=True)):
        write_image(folder / name, paint(open_street(camera).image, number))
    write_cameras(folder / "transforms.json", given, names)
    return open_photographs(folder)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Photographs:
    return drive(tmp_path_factory.mktemp("drive") / "street")


def overlap(found: Tensor, truth: Tensor) -> float:
    return ((found & truth).sum() / (found | truth).sum()).item()


def test_a_bonnet_is_found(clip):
    views = clip.views([0, 7])
    assert views[0].ignore_mask is not None
    assert torch.equal(views[0].ignore_mask, views[1].ignore_mask)
    assert overlap(views[0].ignore_mask, bonnet()) > 0.85
    assert (bonnet() & ~views[0].ignore_mask).sum() < 0.02 * bonnet().sum()


def test_its_mask_follows_the_framing(clip):
    (whole,), (small,), (cropped,) = (clip.views([2], r) for r in (None, 64, (64, SIZE)))
    assert overlap(small.ignore_mask, whole.ignore_mask[1::2, 1::2]) > 0.9
    assert torch.equal(cropped.ignore_mask, whole.ignore_mask[32:96])


@pytest.mark.parametrize("paint", [untouched, with_even_road])
def test_a_street_has_none(tmp_path, paint):
    """Neither its sky, which is even, nor a road without texture is a vehicle."""
    assert all(view.ignore_mask is None for view in drive(tmp_path, paint).views(range(COUNT)))


def circle() -> list[Camera]:
    turns = (36.0 * n for n in range(COUNT))
    return [camera_at(np.sin(np.radians(t)), z=np.cos(np.radians(t)), yaw=2 * t) for t in turns]


@pytest.mark.parametrize(
    "cameras",
    [
        [camera_at(z=STEP * n, size=SIZE) for n in range(4)],
        [camera_at(z=1e-9 * (n % 2), size=SIZE) for n in range(COUNT)],
        [camera_at(z=1e-4 * n, size=SIZE) for n in range(COUNT)],
        [replace(camera, width=SIZE, height=SIZE) for camera in circle()],
    ],
    ids=["few", "standing", "hardly moving", "turning"],
)
def test_nothing_is_told_without_a_drive(tmp_path, cameras):
    assert drive(tmp_path, cameras=cameras).views([0])[0].ignore_mask is None


def test_each_camera_of_a_vehicle_is_looked_at_alone(tmp_path):
    """The bonnet is visible to one of two cameras, whose photographs alternate."""
    places = [STEP * n for n in range(COUNT)]
    both = [camera_at(z=z, size=SIZE, focal=focal) for z in places for focal in (0.7, 0.9)]
    alternating = drive(
        tmp_path, lambda image, n: with_bonnet(image, n) if n % 2 else image, cameras=both
    )
    seen = [view.ignore_mask is not None for view in alternating.views(range(4))]
    assert seen == [False, True, False, True]


def test_damaged_photographs_are_passed_over(tmp_path):
    photographs = drive(tmp_path)
    (tmp_path / "00.png").write_bytes(b"nothing")
    (tmp_path / "03.png").unlink()
    (view,) = photographs.views([5])
    assert overlap(view.ignore_mask, bonnet()) > 0.85


def test_nothing_is_found_in_strips(tmp_path):
    """The small copies of strips, as line sensors take them, are one pixel wide."""
    strips = [
        replace(camera, width=4 * SIZE, height=1)
        for camera in (camera_at(z=STEP * n, size=SIZE) for n in range(COUNT))
    ]
    names = [f"{number:02}.png" for number in range(COUNT)]
    for name in names:
        write_image(tmp_path / name, torch.rand(1, 4 * SIZE, 3))
    write_cameras(tmp_path / "transforms.json", strips, names)
    assert open_photographs(tmp_path).views([0])[0].ignore_mask is None


def test_it_can_be_switched_off(clip):
    assert CompleterConfig().ego_mask
    assert not CompleterConfig.paper().ego_mask
    assert clip.keep_ego_vehicle().views([0])[0].ignore_mask is None
    folder = clip.frames[0].image.parent
    case = Case(folder, (0, 1), 3, (), None)
    assert case.load((0,))[0].ignore_mask is not None
    assert replace(case, ego_mask=False).load((0,))[0].ignore_mask is None


def test_evaluations_ignore_it(clip):
    (opened,) = open_clips(clip.frames[0].image.parent)
    task = make_tasks(parse_protocol("n-2"), opened)[0]
    assert all(
        view.ignore_mask is not None for view in pickle.loads(pickle.dumps(task.load))((0, 1))
    )


def test_nothing_is_matched_of_it(clip):
    for image in make_stereo_images(clip.views([2, 3, 4]))[0]:
        columns, rows = detect_features(image)[0].astype(int).T
        assert len(rows)
        assert not image.ignore_mask[rows, columns].any()


# The next test reconstructs the same photographs.
@pytest.mark.slow
def test_nothing_is_made_of_it(clip):
    views = clip.views([2, 3, 4])
    scene = reconstruct_context(load_reconstructor("plane-sweep"), views).source.gaussians
    plain = reconstruct_context(
        load_reconstructor("plane-sweep"), [replace(view, ignore_mask=None) for view in views]
    ).source.gaussians
    # Nothing below the horizon is as far away as where a bonnet is matched.
    low = [s.means[s.means[:, 1] > 0.6] for s in (scene, plain)]
    beyond = [(means[:, 2] > 40.0).sum().item() for means in low]
    assert beyond[0] < 0.1 * beyond[1]


def test_what_is_fitted_takes_nothing_from_it(clip):
    """The colour of a bonnet must not be given to a road that another photograph shows there."""
    views = clip.views([2, 3, 4])
    magenta = torch.tensor([1.0, 0.0, 1.0])
    painted = [
        replace(v, image=torch.where(v.ignore_mask[..., None], magenta, v.image)) for v in views
    ]
    scene = reconstruct_context(load_reconstructor("plane-sweep"), painted).source.gaussians
    red, green, blue = (0.5 + SH_C0 * scene.sh[:, 0]).T
    assert ((torch.minimum(red, blue) - green) > 0.6).float().mean() < 0.003


@pytest.mark.slow
def test_it_is_told_and_shown(clip, tmp_path, monkeypatch):
    folder, out = clip.frames[0].image.parent, tmp_path / "out"
    given = ("--context", 2, 4, "--target", 5, "--near", 1, "--far", 60, "--resolution", 64)
    assert run(monkeypatch, "complete", folder, *given, "--out", out) == 0
    summary = read_json(out / "summary.json", "")
    share = clip.views([2], 64)[0].ignore_mask.float().mean().item()
    assert [row["ignored"] for row in summary["context"]] == [pytest.approx(share)] * 2
    shown = read_image(out / "images" / "context1_ignored.png")
    assert ((shown - torch.tensor([1.0, 0.0, 1.0])).abs().amax(-1) == 0).float().mean() >= share
    assert "stays the same while the camera moves" in (out / "report.html").read_text()
    whole = tmp_path / "whole"
    words = ("complete", folder, *given, "--out", whole, "--config.ego-mask", "False")
    assert run(monkeypatch, *words) == 0
    told = read_json(whole / "summary.json", "")
    assert [row["ignored"] for row in told["context"]] == [0.0, 0.0]
    # A bonnet is no part of the scene, so it counts against the scores where it is not ignored.
    after = [s["targets"][0]["psnr_after"] for s in (summary, told)]
    assert after[0] > after[1]


# `test_a_street_has_none` has synthetic streets.
@pytest.mark.slow
def test_real_scenes_have_none(shared):
    found = {}
    for folder in sorted((shared / "data").iterdir()):
        if folder.is_dir():
            photographs = open_photographs(folder)
            found[folder.name] = [frame.vehicle() for frame in photographs.frames]
    assert len(found) >= 8
    assert all(mask is None for masks in found.values() for mask in masks)

"""Holes of an object: what it encloses on one surface, and nothing of the space around it."""

import math
from dataclasses import replace

import pytest
import torch

import gscompleter as gsc
from gscompleter.config import CompleterConfig, HoleConfig
from gscompleter.config.settings import COVERED
from gscompleter.numerics.enclosed_holes import keep_enclosed
from gscompleter.numerics.geometry import (
    add_near_plane,
    look_along,
    pad_camera,
    resize_camera,
    unproject,
)
from gscompleter.numerics.image_ops import dilate, label_regions
from gscompleter.render.loading import load_renderer
from gscompleter.stages.hole_masks import HoleEdits, compute_hole_mask, find_hole_masks
from gscompleter.stages.synthesize import make_generator_input
from gscompleter.types import Camera, Gaussians, make_observed, merge
from paths import DATA
from scenes import camera_at
from target_views import observe

RENDERER = load_renderer("cpu")
SIZE = 128
CAMERA = camera_at(size=SIZE)
OBJECTS = (
    *("biker.spz", "biker.compressed.ply", "guitar.compressed.ply"),
    *("playbot_lod4.from-sog.ply", "arkit_scene.splat"),
)


def make_plate(depth: float = 3.0, tilt: float = 0.2) -> Gaussians:
    """Make a thin plate of 2 by 2 in front of the camera, a little bent."""
    along = torch.linspace(-1, 1, 81)
    x, y = torch.meshgrid(along, along, indexing="xy")
    z = depth + tilt * x + 0.1 * y**2
    means = torch.stack([x, y, z], dim=-1).reshape(-1, 3)
    count = len(means)
    return make_observed(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), 0.02),
        torch.full((count,), 0.99),
        torch.rand((count, 1, 3), generator=torch.Generator().manual_seed(0)),
    )


def cut(plate: Gaussians, x: float = 0.0, y: float = 0.0, radius: float = 0.2) -> Gaussians:
    """Cut a round hole into a plate."""
    return plate[(plate.means[:, :2] - torch.tensor([x, y])).norm(dim=1) > radius]


def find(scene: Gaussians, camera: Camera = CAMERA) -> torch.Tensor:
    """Find the holes of an object."""
    render = RENDERER.render(scene, camera)
    empty = compute_hole_mask(render.alpha)

    def render_at(other: Camera):
        return RENDERER.render(scene, other)

    return keep_enclosed(empty, render, camera, render_at)


def test_nothing_around_an_object_is_a_hole():
    assert not find(make_plate()).any()


def test_a_hole_in_its_surface_is_one():
    holes = find(cut(make_plate()))
    assert holes.any()
    # It is the part around the middle of the image, and nothing else.
    rows, columns = holes.nonzero().T
    assert label_regions(holes)[1] == 2
    assert (rows.float().mean() - SIZE / 2).abs() < 4
    assert (columns.float().mean() - SIZE / 2).abs() < 4


def test_a_hole_stays_one_where_what_is_not_trusted_joins_it_to_the_space_around():
    scene = cut(make_plate())
    render = RENDERER.render(scene, CAMERA)
    trusted = render.alpha.clone()
    trusted[SIZE // 2 - 3 : SIZE // 2 + 3] = 0.0
    masks = find_hole_masks(
        render,
        trusted,
        pad_camera(CAMERA, 0.0),
        HoleConfig(kind="enclosed"),
        HoleEdits(),
        lambda other: RENDERER.render(scene, other),
    )
    assert masks.empty.any()
    assert masks.holes[masks.empty].all()


def test_a_notch_in_its_edge_is_none():
    assert not find(cut(make_plate(), x=1.0)).any()


def test_a_gap_between_two_surfaces_is_none():
    """A plate whose halves stand at two depths, with a gap where they meet."""
    plate = cut(make_plate(tilt=0.0))
    right = plate.means[:, 0] > 0
    shift = torch.where(right, 1.25, 1.0)[:, None]
    # Along the rays, so that the image stays what it was.
    assert not find(replace(plate, means=plate.means * shift, scales=plate.scales * shift)).any()


def test_a_gap_in_a_thin_frame_is_none():
    plate = cut(make_plate(), radius=0.6)
    outside = plate.means[:, :2].norm(dim=1) > 0.72
    assert not find(plate[~outside]).any()


def test_a_target_completes_only_what_an_object_encloses():
    scene = cut(make_plate())
    views = gsc.render_views(scene, [camera_at(-0.3, size=SIZE), camera_at(0.3, size=SIZE)])
    bare = CompleterConfig.bare()
    enclosed = replace(bare, holes=replace(bare.holes, kind="enclosed"))
    view = observe(scene, views, CAMERA, enclosed)
    assert torch.equal(view.holes, view.empty)
    assert torch.equal(make_generator_input(view).holes, view.holes)
    done = gsc.GSCompleter(config=enclosed)(views, CAMERA, scene=scene)
    (result,) = done.targets
    assert len(result.added) > 20
    assert result.after.alpha[view.camera.crop(view.holes)].mean() > 0.8
    around = compute_hole_mask(result.before.alpha) & ~result.hole_mask
    assert result.after.alpha[around].mean() < result.before.alpha[around].mean() + 0.02

    whole = make_plate()
    done = gsc.GSCompleter(config=enclosed)(views, CAMERA, scene=whole)
    assert len(done.added) == 0
    assert done.targets[0].notes == ("The target sees no hole of the scene: nothing to complete.",)


@pytest.mark.parametrize(
    "name", [OBJECTS[0], *(pytest.param(name, marks=pytest.mark.slow) for name in OBJECTS[1:])]
)
def test_nothing_is_added_to_untouched_objects(name):
    path = DATA / "formats" / "gaussians" / name
    if not path.is_file():
        pytest.skip(f"needs {path}")
    scene = gsc.load_splat(path)
    bare = CompleterConfig.bare()
    completer = gsc.GSCompleter(config=replace(bare, holes=replace(bare.holes, kind="enclosed")))
    cameras = [orbit(scene, degrees) for degrees in (0, 25, 90, 200, 290)]
    views = gsc.render_views(scene, cameras[:2])
    state = completer.begin(views, scene)
    for camera in cameras[2:]:
        state = completer.advance(state, camera)
    assert len(state.added) == 0
    assert all(result.skip_reason for result in state.targets)


def orbit(scene: Gaussians, degrees: float) -> Camera:
    """Look at the middle of an object from a direction, from a little above."""
    low, high = torch.quantile(scene.means[::5], torch.tensor([0.03, 0.97]), dim=0)
    angle = math.radians(degrees)
    aside = torch.tensor([math.cos(angle), -0.25, math.sin(angle)])
    c2w = torch.eye(4)
    c2w[:3, 3] = (low + high) / 2 + 1.1 * (high - low).norm() * aside
    seen = replace(CAMERA, c2w=c2w, near=None, far=None)
    seen = look_along(seen, -aside, torch.tensor([0.0, -1.0, 0.0]))
    return add_near_plane(seen, scene.means)


def test_parts_of_the_same_object_are_judged_alone():
    two = merge([cut(make_plate()), cut(make_plate(depth=6.0), x=0.7)])
    assert label_regions(find(cut(make_plate(), 0.4)))[1] == 2
    # What a plate behind covers is no hole.
    assert not find(two)[SIZE // 2, SIZE // 2]


def test_most_holes_that_are_cut_into_an_object_count():
    path = DATA / "formats" / "gaussians" / "playbot_lod4.from-sog.ply"
    if not path.is_file():
        pytest.skip(f"needs {path}")
    scene = gsc.load_splat(path)
    generator = torch.Generator().manual_seed(3)
    outcomes = []
    for degrees in range(10, 370, 45):
        camera = resize_camera(orbit(scene, degrees), 224, 224)
        render = RENDERER.render(scene, camera)
        # Well inside of the object, so that the cut is enclosed.
        inside = (render.alpha > 0.95) & ~dilate(compute_hole_mask(render.alpha), 14)
        pixels = inside.nonzero()
        for choice in torch.randint(0, len(pixels), (2,), generator=generator):
            y, x = pixels[choice].tolist()
            middle = unproject(render.depth, camera)[y, x]
            radius = 0.07 * render.depth[y, x]
            rest = scene[(scene.means - middle).norm(dim=1) > radius]
            empty = compute_hole_mask(RENDERER.render(rest, camera).alpha)
            missing = empty & (render.alpha >= COVERED)
            counted = find(rest, camera) & missing
            outcomes.append(int(counted.sum()) > 0.5 * int(missing.sum()))
    assert len(outcomes) == 16
    assert sum(outcomes) >= 14

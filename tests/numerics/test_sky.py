"""The sky: a layer of its own outdoors, and none indoors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter.data.formats import open_photographs
from gscompleter.guards.free_space import respect_free_space
from gscompleter.numerics.geometry import project
from gscompleter.numerics.sky import (
    SKY_DEPTH,
    extend_sky,
    find_sky_gaussians,
    is_sky,
    mask_out_sky,
)
from gscompleter.reconstructors.features.depth_range import get_depth_range, set_depth_range
from gscompleter.reconstructors.features.stereo_image import make_stereo_images
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.reconstructors.plane_sweep.emphasis import Emphasis
from gscompleter.reconstructors.plane_sweep.sky_colors import blend_skies, weigh_sky
from gscompleter.reconstructors.plane_sweep.sky_mask import find_even_region
from gscompleter.reconstructors.plane_sweep.sweep import find_hidden_pixels
from gscompleter.render.loading import load_renderer
from gscompleter.stages.extrapolate_registration import extrapolate_sky
from gscompleter.types import SH_C0, DepthMap, View, sh_from_rgb
from scenes import (
    Room,
    camera_at,
    cast,
    gaussians_of,
    open_street,
    random_gaussians,
    view_of,
)

FAR = 40.0


def street(z: float) -> View:
    return open_street(replace(camera_at(z=z, size=96, focal=0.8), near=1.0, far=FAR))


@pytest.fixture(scope="module")
def reconstructed():
    views = [street(0.6), street(0.0)]
    return views, PlaneSweep()(views)


def test_the_sky_of_a_street_lies_far_behind_its_far_plane(reconstructed):
    views, found = reconstructed
    for view, depth in zip(views, found.depths, strict=True):
        truth = torch.isinf(view.depth)
        sky = is_sky(depth.depth, view.camera)
        assert (sky & truth).sum() > 0.85 * truth.sum()
        assert (sky & ~truth).sum() < 0.03 * (~truth).sum()
        assert not (depth.valid & sky).any()


@pytest.mark.parametrize("z", [-0.6, -1.2])
def test_the_sky_stays_sky_where_the_camera_backs_away(reconstructed, z):
    _, found = reconstructed
    view = street(z)
    render = load_renderer("cpu").render(found.gaussians, view.camera)
    truth = torch.isinf(view.depth)
    seen = truth & (render.alpha > 0.5)
    assert seen.sum() > 0.7 * truth.sum()
    error = (render.image - view.image).abs().amax(dim=-1)[seen]
    assert error.median() < 0.02
    assert is_sky(render.depth[seen], view.camera).float().mean() > 0.8


def test_the_sky_is_not_brighter_at_its_edges_than_any_photograph(reconstructed):
    views, found = reconstructed
    camera = views[0].camera
    in_sky = is_sky((found.gaussians.means - camera.center).norm(dim=-1), camera)
    colours = found.gaussians.sh[in_sky, 0] * SH_C0 + 0.5
    shown = torch.cat([view.image[torch.isinf(view.depth)] for view in views])
    assert in_sky.any()
    assert colours.amax() <= shown.amax() + 1e-4


HALL = ((-3.0, -1.5, -1.0), (3.0, 1.5, 14.0))
DEFAULT = Room().boxes[0]
BOX = ((-0.8, -0.1, 1.0), (0.7, 1.5, 1.6))
CUPBOARDS = (((-3.0, -1.5, 2.0), (-1.2, 1.5, 2.6)), ((1.0, -0.9, 3.0), (3.0, 1.5, 3.4)))
FORWARD, ASIDE = ((0.0, 0.2), (0.0, 0.0)), ((-0.1, 0.0), (0.1, 0.0))
"""Positions of two photographs, in x and z."""
WHITE_ROOMS = {
    "ceiling": ((DEFAULT, *Room().boxes[1:]), False, FORWARD),
    "hall behind a box": ((HALL, BOX), False, FORWARD),
    "hall behind a box, aside": ((HALL, BOX), False, ASIDE),
    "hall with a white end": ((HALL, BOX), True, FORWARD),
    "hall with cupboards": ((HALL, *CUPBOARDS), False, ASIDE),
    "full hall": ((HALL, BOX, *CUPBOARDS), False, FORWARD),
    "cupboards": ((DEFAULT, BOX, *CUPBOARDS), False, ASIDE),
    "cupboards before a white wall": ((DEFAULT, BOX, *CUPBOARDS), True, FORWARD),
}
"""Boxes, True if the end is white like the ceiling, and the positions of the photographs."""


def has_sky(views: list[View]) -> bool:
    views = set_depth_range(views, *get_depth_range(views))
    depths = PlaneSweep().estimate_depths(views)
    return any(is_sky(d.depth, v.camera).any() for d, v in zip(depths, views, strict=True))


@pytest.mark.parametrize("name", WHITE_ROOMS)
def test_a_room_with_a_white_ceiling_has_no_sky(name):
    boxes, is_end_white, places = WHITE_ROOMS[name]
    (_, top, _), (_, _, end) = boxes[0]

    def view(x: float, z: float) -> View:
        camera = replace(camera_at(x, z=z), near=0.3, far=20.0)
        image, depth = cast(Room(boxes=boxes), camera)
        _, y, ahead = (camera.center + depth[..., None] * camera.z_rays()).unbind(-1)
        white = (y < top + 0.01) | (is_end_white & (ahead > end - 0.01))
        return View(torch.where(white[..., None], 0.93, image), camera, depth=depth)

    assert not has_sky([view(*place) for place in places])


@pytest.mark.parametrize(
    ("scene", "frames", "size"),
    [
        pytest.param("hololens_room", (0, 1), None, marks=pytest.mark.slow),
        ("hololens_room", (3, 4), (256, 256)),
        pytest.param("redkitchen", (0, 1), None, marks=pytest.mark.slow),
        pytest.param("redkitchen", (18, 19), (256, 256), marks=pytest.mark.slow),
        ("open3d_rgbd", (0, 2), (256, 256)),
        pytest.param("re10k_000c3ab1", (30, 31), None, marks=pytest.mark.slow),
        pytest.param("re10k_0d4de33c", (0, 4), (256, 256), marks=pytest.mark.slow),
    ],
)
def test_a_photographed_room_has_no_sky(scene, frames, size, shared):
    assert not has_sky(open_photographs(shared / "data" / scene).views(frames, size))


@pytest.mark.parametrize(
    "frames", [(0, 1), *(pytest.param(f, marks=pytest.mark.slow) for f in ((34, 32), (22, 21)))]
)
def test_a_photographed_street_has_a_sky(frames, shared):
    given = open_photographs(shared / "data" / "kitti_city", near=3.0, far=100.0)
    assert has_sky(given.views(frames, (256, 256)))


HOUSE = (
    ((-90.0, -90.0, -1.0), (90.0, 1.5, 90.0)),
    ((-6.0, -0.7, 5.0), (6.0, 1.5, 7.0)),
    ((-1.6, -1.4, 3.6), (-0.6, 1.5, 5.0)),
    ((0.6, -1.1, 4.2), (1.8, 1.5, 5.0)),
)
"""The ground, and a house with two towers. Nothing stands behind them."""
BLUE, HAZE, WHITE = (0.45, 0.7, 0.95), (0.7, 0.8, 0.9), (1.0, 1.0, 1.0)


def house(x: float, sky: tuple[float, float, float], towers: int) -> View:
    camera = replace(camera_at(x, size=96), near=2.0, far=8.0)
    image, depth = cast(Room(boxes=HOUSE[: 2 + towers]), camera)
    is_open = depth > 9
    image = torch.where(is_open[..., None], torch.tensor(sky), 0.6 * image)
    return View(image, camera, depth=depth.masked_fill(is_open, torch.inf))


def find_sky_shares(skies: list[tuple[float, float, float]], towers: int = 2) -> list[float]:
    """Find which share of the true sky each photograph of the house gets."""
    views = [house(0.6 * number, sky, towers) for number, sky in enumerate(skies)]
    depths = PlaneSweep().estimate_depths(views)
    shares = []
    for view, depth in zip(views, depths, strict=True):
        found = is_sky(depth.depth, view.camera)
        truth = torch.isinf(view.depth)
        assert (found & ~truth).sum() < 0.03 * (~truth).sum()
        shares.append(float((found & truth).sum() / truth.sum()))
    return shares


def test_a_blue_sky_needs_nothing_far_away_below_it():
    assert min(find_sky_shares([BLUE, BLUE, BLUE])) > 0.85


def test_a_white_sky_needs_a_photograph_that_shows_it_blue():
    """Against the light the sky is clipped to white, as ceilings are."""
    assert find_sky_shares([WHITE, WHITE, WHITE]) == [0, 0, 0]
    assert min(find_sky_shares([WHITE, BLUE, WHITE])) > 0.85


def test_a_light_blue_wall_behind_one_plane_is_no_sky():
    assert find_sky_shares([HAZE, HAZE, HAZE], towers=0) == [0, 0, 0]
    assert min(find_sky_shares([BLUE, BLUE, BLUE], towers=0)) > 0.85


def test_what_is_dark_at_the_top_is_no_sky():
    image = torch.tensor(BLUE).repeat(60, 80, 1)
    image[30:] = torch.rand(30, 80, 3, generator=torch.Generator().manual_seed(0))
    image[:20, :25] = 0.02
    view = View(image, replace(camera_at(size=80), height=60))
    aside = replace(view, camera=replace(camera_at(0.1, size=80), height=60))
    region = find_even_region(make_stereo_images([view, aside])[0][0])
    assert region[:25, 30:].all()
    assert not region[:18, :22].any()


def test_the_sky_has_one_tone_where_photographs_meet():
    cameras = [replace(camera_at(yaw=yaw, size=64), near=1.0, far=10.0) for yaw in (0.0, 20.0)]
    blue = torch.tensor(BLUE).repeat(64, 64, 1)
    blue[20:22, 40:42] = 0.8  # a cloud
    views = [View(blue, cameras[0]), View(torch.ones(64, 64, 3), cameras[1])]
    sky = torch.zeros(64, 64, dtype=torch.bool)
    sky[:40] = True
    # Of two photographs each keeps its own colours.
    for image, view in zip(blend_skies(views, [sky, sky]), views, strict=True):
        torch.testing.assert_close(image[sky], view.image[sky], atol=1e-5, rtol=0)
    # A third one shows no sky.
    third = View(blue, replace(camera_at(yaw=90.0, size=64), near=1.0, far=10.0))
    first, second, _ = blend_skies([*views, third], [sky, sky, torch.zeros_like(sky)])
    # At the border of the second image, which the first shows, and as far from its own.
    pixels, _ = project(cameras[1].center + 80 * cameras[1].z_rays()[10, [6, 30, 50]], cameras[0])
    x, y = pixels.long().unbind(-1)
    assert x[0] < 60
    apart = (second[10, 6] - first[y[0], x[0]]).abs().max()
    assert apart < 0.05 < (views[1].image[10, 6] - blue[y[0], x[0]]).abs().max()
    # Where only one of them shows it, it stays.
    torch.testing.assert_close(first[10, 2], blue[10, 2], atol=0.02, rtol=0)
    assert x[2] > 70
    torch.testing.assert_close(second[10, 60], torch.ones(3), atol=0.02, rtol=0)
    # The cloud keeps its contrast.
    contrast = first[20:22, 40:42].mean() - first[16:26, 36:38].mean()
    wanted = blue[20:22, 40:42].mean() - blue[16:26, 36:38].mean()
    assert contrast == pytest.approx(float(wanted), rel=0.25)


def test_behind_a_surface_the_sky_is_that_of_other_photographs():
    camera = replace(camera_at(size=64), near=1.0, far=10.0)
    views = [
        View(torch.full((64, 64, 3), 0.1), camera),
        View(torch.tensor(BLUE).repeat(64, 64, 1), camera),
        View(torch.ones(64, 64, 3), camera),
    ]
    whole = torch.ones(64, 64, dtype=torch.bool)
    part = whole.clone()
    part[:, 20:] = False
    none = torch.zeros_like(whole)
    tree, *_ = blend_skies(views, [part, whole, none])
    torch.testing.assert_close(tree[30, 40], torch.tensor(BLUE), atol=1e-3, rtol=0)
    # A view without a sky tells nothing.
    before, alone, after = blend_skies(views, [none, part, none])
    assert before is None
    assert after is None
    torch.testing.assert_close(alone, views[1].image, atol=1e-5, rtol=0)


def test_a_part_that_is_nothing_but_sky_is_not_fitted():
    camera = replace(camera_at(size=32), near=1.0, far=10.0)
    view = View(torch.tensor(BLUE).repeat(32, 32, 1), camera)
    scene = gaussians_of(view, torch.full((32, 32), SKY_DEPTH * 10.0))
    whole = torch.ones(32, 32, dtype=torch.bool)
    first = torch.zeros(32 * 32, dtype=torch.long)
    fitted = PlaneSweep().fit_before_sky(
        scene, first, [view] * 3, torch.ones(3, 3), [whole] * 3, Emphasis()
    )
    assert fitted is scene


def test_the_weight_of_a_sky_rises_from_all_its_borders():
    sky = torch.zeros(40, 40, dtype=torch.bool)
    sky[:30] = True
    weight = weigh_sky(sky)
    assert not weight[30:].any()
    assert weight[0].max() <= 0.11
    assert weight[29].max() <= 0.11
    assert weight[15, 20] == 1


def test_a_hole_beside_the_sky_is_sky_if_it_shows_its_colour():
    camera = replace(camera_at(size=16), near=0.5, far=10.0)
    image = torch.full((16, 16, 3), 0.8)
    image[:, :3] = 0.2
    depth = torch.full((16, 16), SKY_DEPTH * 10.0)
    depth[8:] = 5.0
    valid = torch.ones(16, 16, dtype=torch.bool)
    valid[:, :6] = False
    view = View(image, camera)
    candidates = gaussians_of(view, torch.full((16, 16), 5.0))
    moved = extrapolate_sky(candidates, torch.arange(256), DepthMap(depth, valid), view)
    z = (moved.means - camera.center)[:, 2].reshape(16, 16)
    assert is_sky(z[:8, 3:6], camera).all()
    z[:8, 3:6] = 5.0
    torch.testing.assert_close(z, torch.full((16, 16), 5.0), atol=1e-4, rtol=0)


def test_only_the_camera_of_a_gaussian_tells_whether_it_is_sky():
    """The sky of a drive's first photograph is near its last one, whose surfaces are far away."""
    drive = [replace(camera_at(z=z), near=1.0, far=10.0) for z in (0.0, 20.0, 60.0)]
    points = replace(random_gaussians(2), means=torch.tensor([[0.0, 0, 80], [0, 0, 69]]))
    found = find_sky_gaussians(points, torch.tensor([0, 2]), drive)
    assert found.tolist() == [True, False]


def test_without_a_sky_no_candidate_moves():
    view = view_of(Room(), camera_at(size=16))
    candidates = gaussians_of(view)
    scene = DepthMap(view.depth, torch.ones(16, 16, dtype=torch.bool))
    assert extrapolate_sky(candidates, torch.arange(256), scene, view) is candidates


def test_the_sky_goes_on_behind_what_stands_before_it():
    camera = replace(camera_at(size=32), near=0.5, far=10.0)
    image = torch.full((32, 32, 3), 0.8)
    sky = torch.ones(32, 32, dtype=torch.bool)
    sky[:, 4:28] = False
    image[~sky] = 0.1
    sky_image = torch.full((32, 32, 3), 0.8)
    gaussians, pixels = extend_sky(View(image, camera), sky, sky_image, 0.6)
    where = torch.zeros(32 * 32, dtype=torch.bool)
    where[pixels] = True
    assert where.reshape(32, 32)[:, 4:8].all()
    assert where.reshape(32, 32)[:, 24:28].all()
    assert len(pixels) == 8 * 32
    torch.testing.assert_close(gaussians.sh, sh_from_rgb(torch.full((256, 3), 0.8)))


def test_what_would_stand_before_the_sky_becomes_sky():
    camera = replace(camera_at(size=16), near=0.5, far=10.0)
    view = View(torch.full((16, 16, 3), 0.5), camera)
    scene = gaussians_of(view, torch.full((16, 16), SKY_DEPTH * 10.0))
    aside = replace(camera_at(x=0.3, size=16), near=0.5, far=10.0)
    seen = load_renderer("cpu").render(scene, camera)
    candidates = gaussians_of(View(view.image, aside), torch.full((16, 16), 2.0))
    moved, placed = respect_free_space(candidates, aside, [camera], [seen], "constant")
    inner = project(candidates.means, camera)[0].sub(8).abs().amax(dim=-1) < 6
    assert placed[inner].all()
    assert is_sky(moved.means[inner, 2], camera).all()


def test_only_surfaces_are_compared_with_surfaces():
    camera = replace(camera_at(size=16), near=0.5, far=10.0)
    depth = torch.full((16, 16), 5.0)
    depth[:8] = SKY_DEPTH * 10.0
    image = torch.full((16, 16, 3), 0.5)
    render = load_renderer("cpu").render(gaussians_of(View(image, camera), depth), camera)
    valid = mask_out_sky(render, camera).valid
    assert not valid[:6].any()
    assert valid[10:].all()


def test_what_another_view_could_not_have_seen_is_hidden_by_nothing():
    """Four columns leave the other image at the depth that it shows in their direction."""
    there, back = np.eye(3, 4, dtype=np.float32), np.eye(3, 4, dtype=np.float32)
    there[0, 3], back[0, 3] = -10, 10
    near = np.full((32, 32), 0.5, np.float32), there, back
    hidden = find_hidden_pixels(np.full((32, 32), 0.1, np.float32), [near])
    assert hidden[:, 6:].all()
    assert not hidden[:, :4].any()

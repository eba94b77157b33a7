"""Floaters without photographs: `gscompleter clean` without SCENE."""

from __future__ import annotations

import json
from dataclasses import replace

import plyfile
import pytest
import torch

from command import run
from gscompleter.config import FloaterConfig
from gscompleter.data.scene import load_views
from gscompleter.editing.floaters import Surroundings, find_floaters, rate_gaussians
from gscompleter.editing.nearest import NearestGaussians
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.render.loading import load_renderer
from gscompleter.splats import load_splat
from gscompleter.splats.ply import load_ply
from gscompleter.system.errors import InputError
from gscompleter.types import Gaussians, make_observed, merge, sh_from_rgb
from scenes import Room, camera_at, gaussians_of, labelled, view_of

SIZE = 48
ROOM = merge([gaussians_of(view_of(Room(), camera_at(x, size=SIZE))) for x in (-0.3, 0.3)])
UNIT = ROOM.scales.max(dim=1).values.median().item()
"""Usual size of a Gaussian of the room."""


def blobs(places, sigmas, opacity=0.9) -> Gaussians:
    """Make Gaussians of given standard deviations, in units of those of the room."""
    count = len(places)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1)
    scales = (UNIT * torch.as_tensor(sigmas, dtype=torch.float32)).expand(count, 3).clone()
    red = sh_from_rgb(torch.tensor([[1.0, 0.0, 0.0]]).repeat(count, 1))
    return make_observed(torch.as_tensor(places), quats, scales, torch.full((count,), opacity), red)


VIEW = view_of(Room(), camera_at(0.0, size=SIZE))
MIDDLE = gaussians_of(VIEW, 0.5 * VIEW.depth).means[SIZE * SIZE // 4 :: SIZE * SIZE // 4]
"""Places halfway to the walls."""
ON_WALL = ROOM.means[:: len(ROOM) // 3]
KINDS = {
    "isolated": blobs(MIDDLE, [1.0, 0.8, 0.6]),
    "huge": blobs(MIDDLE, [30.0, 20.0, 10.0]),
    "needles": blobs(MIDDLE, [60.0, 0.2, 0.1]),
    "transparent": blobs(ON_WALL, [1.0, 1.0, 0.1], opacity=0.008),
}


def sphere(count: int, radius: float) -> torch.Tensor:
    """Spread points evenly over a sphere."""
    number = torch.arange(count) + 0.5
    height, turn = 1 - 2 * number / count, number * torch.pi * (1 + 5**0.5)
    flat = (1 - height**2).sqrt()
    return radius * torch.stack([flat * turn.cos(), height, flat * turn.sin()], dim=1).float()


def taken(scene: Gaussians, config: FloaterConfig = FloaterConfig()) -> torch.Tensor:
    return torch.stack([*find_floaters(scene, config).values()]).any(dim=0)


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_goes_for_its_reason_and_the_room_stays(kind):
    scene = merge([ROOM, KINDS[kind]])
    reasons = find_floaters(scene)
    assert reasons[kind][len(ROOM) :].all()
    assert not taken(scene)[: len(ROOM)].any()


@pytest.mark.parametrize(("count", "goes"), [(8, True), (9, False)])
def test_a_cluster_of_as_many_as_half_of_the_neighbours_goes(count, goes):
    places = MIDDLE[1] + UNIT * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    assert taken(merge([ROOM, blobs(places, 1.0)]))[len(ROOM) :].all() == goes


def test_floaters_that_hide_one_another_are_found_in_several_rounds():
    places = gaussians_of(VIEW, 0.5 * VIEW.depth).means[:: SIZE * SIZE // 12]
    scene = merge([ROOM, blobs(places, 6.0)])
    config = FloaterConfig()
    everything = torch.ones(len(scene), dtype=torch.bool)
    around = Surroundings(scene, config.neighbors)
    first = torch.stack([*rate_gaussians(scene, everything, around, config).values()]).any(dim=0)
    assert 0 < first.sum() < len(places)
    assert taken(scene).tolist() == [False] * len(ROOM) + [True] * len(places)


def test_neighbours_are_searched_for_again_only_around_what_went(monkeypatch):
    places = gaussians_of(VIEW, 0.5 * VIEW.depth).means[:: SIZE * SIZE // 12]
    scene = merge([ROOM, blobs(places, 6.0)])
    searches = []
    search = NearestGaussians._search
    monkeypatch.setattr(
        NearestGaussians,
        "_search",
        lambda self, points, among: (searches.append(len(points)), search(self, points, among))[1],
    )
    assert taken(scene)[len(ROOM) :].all()
    assert searches[0] == len(scene)
    assert len(searches) > 2
    assert max(searches[1:]) < 0.05 * len(scene)


def test_few_that_lost_a_neighbour_ask_the_tree_that_is_there(monkeypatch):
    means = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0))
    nearest = NearestGaussians(means, means, 5, "searching")
    left = torch.ones(2000, dtype=torch.bool)
    left[[7, 100, 1500]] = False
    asked = []
    monkeypatch.setattr(NearestGaussians, "_search", lambda _, points, among: asked.append(points))
    lost = nearest.take_away(~left, left, left)
    assert len(lost) > 3
    assert [len(points) for points in asked] == [0]
    monkeypatch.undo()
    anew = NearestGaussians(means, means[left], 5, "searching")
    numbers = left.nonzero()[:, 0].numpy()
    assert (nearest.rows[left.numpy()] == numbers[anew.rows[left.numpy()]]).all()


def test_of_two_in_one_place_each_has_the_other_for_a_neighbour_and_not_itself():
    """Which of both a search finds first does not count."""
    places = torch.arange(40)[:, None] * torch.tensor([[1.0, 0.0, 0.0]])
    scene = merge([blobs(places, 4.0), blobs(places, 1.0)])
    around = Surroundings(scene, 2)
    # Of two neighbours, the one in the same place and one of the next place, the smaller counts.
    nearest = torch.from_numpy(around._nearest.rows)
    for own in range(len(scene)):
        others = [number for number in nearest[own].tolist() if number != own]
        assert around.sigma[own] == scene.scales[others].amax(dim=1).min()


def test_a_strength_of_two_takes_more_and_of_a_half_less():
    scene = merge([ROOM, *(blobs(MIDDLE, size, opacity=0.9) for size in (3.0, 5.0, 8.0))])
    counts = [taken(scene, FloaterConfig().strengthen(s)).sum().item() for s in (0.5, 1.0, 2.0)]
    assert counts[0] < counts[1] <= counts[2]
    assert FloaterConfig().strengthen(1.0) == FloaterConfig()


def test_a_huge_one_that_swallows_its_neighbours_goes():
    scene = merge([ROOM, blobs(ON_WALL, 30.0)])
    assert find_floaters(scene)["huge"].tolist() == [False] * len(ROOM) + [True] * len(ON_WALL)


def test_what_is_opaque_is_not_transparent_however_large():
    assert not find_floaters(merge([ROOM, KINDS["huge"]]))["transparent"].any()


@pytest.mark.parametrize("count", [100, 500])
def test_a_sky_and_a_far_wall_stay(count):
    far = 200.0 * ROOM.means.norm(dim=1).median().item()
    sky = sphere(count, far)
    step = far * (4 * torch.pi / count) ** 0.5  # of the mean distance on the sphere
    wall = torch.cartesian_prod(torch.arange(6.0), torch.arange(6.0)) - 2.5
    wall = torch.nn.functional.pad(0.02 * far * wall, (0, 1), value=0.2 * far)
    scene = merge(
        [ROOM, blobs(sky, 0.7 * step / UNIT), blobs(wall, [0.01 * far / UNIT] * 2 + [0.1])]
    )
    assert not taken(scene).any()


def test_the_unit_of_the_scene_changes_nothing():
    scene = merge([ROOM, *KINDS.values()])
    large = replace(scene, means=1000 * scene.means, scales=1000 * scene.scales)
    assert torch.equal(taken(scene), taken(large))
    assert taken(scene)[len(ROOM) :].all()


def test_gaussians_in_one_place_are_not_huge():
    assert not taken(merge([ROOM, *[ROOM[:60]] * 20])).any()


def test_generated_ones_stay():
    ours = [replace(k, generated=torch.ones_like(k.generated)) for k in KINDS.values()]
    assert not taken(merge([ROOM, *ours])).any()


def test_too_few_are_refused():
    with pytest.raises(InputError, match="too few"):
        find_floaters(ROOM[:16])


def test_the_command_takes_them_out_and_strip_puts_them_back(tmp_path, monkeypatch, capsys):
    floaters = merge([*KINDS.values()])
    splat = labelled(tmp_path / "splat.ply", merge([ROOM[:700], floaters, ROOM[700:]]))
    out, preview = tmp_path / "out", tmp_path / "preview"
    assert run(monkeypatch, "clean", "--scene", splat, "--out", out) == 0
    said = capsys.readouterr().out
    assert f"{len(floaters)} of {len(ROOM) + len(floaters):,} Gaussians removed" in said
    labels = plyfile.PlyData.read(str(out / "removed.ply"))["vertex"].data["label"]
    assert labels.tolist() == list(range(700, 700 + len(floaters)))
    summary = json.loads((out / "summary.json").read_text())
    assert summary["gaussians"]["removed"] == len(floaters)
    found = {reason for reason, count in summary["reasons"].items() if count > 0}
    assert found == set(KINDS)
    assert summary["settings"]["config"]["floaters"]["max_gap"] == FloaterConfig().max_gap
    assert torch.equal(load_ply(out / "completed.ply").means, ROOM.means)
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", tmp_path / "back.ply") == 0
    assert (tmp_path / "back.ply").read_bytes() == splat.read_bytes()
    assert run(monkeypatch, "clean", "--scene", splat, "--out", preview, "--dry-run") == 0
    written = ["removed.ply", "removed.png", "summary.json"]
    assert sorted(file.name for file in preview.iterdir()) == written
    assert (preview / "removed.ply").read_bytes() == (out / "removed.ply").read_bytes()
    assert torch.equal(load_splat(preview / "removed.ply").means, floaters.means)
    again = ("--out", out, "--dry-run", "--overwrite")
    assert run(monkeypatch, "clean", "--scene", splat, *again) == 2
    assert "name another folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (("--context", 0), "--context"),
        (("--config.floaters.neighbors", 1), "neighbors"),
        (("--config.floaters.min-opacity", 1.0), "Every Gaussian"),
    ],
)
def test_wrong_input_gets_a_sentence(tmp_path, monkeypatch, capsys, more, sentence):
    splat, out = labelled(tmp_path / "splat.ply", ROOM), tmp_path / "out"
    assert run(monkeypatch, "clean", "--scene", splat, "--out", out, "--quiet", *more) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert said.count("\n") == 1
    assert not out.exists()


def test_photographs_of_a_real_splat_hardly_change_and_floaters_in_it_go(shared):
    """The fox, trained by OpenSplat on 24 of its 40 photographs."""
    folder = shared / "splats" / "fox"
    scene, views = load_splat(folder / "splat.ply"), load_views(folder, [0, 12, 30, 39], 160)
    renderer = load_renderer("cpu")
    size = scene.scales.max(dim=1).values.median().item()
    cameras = [view.camera for view in views]
    depths = [renderer.render(scene, camera).depth[40, 20] for camera in cameras]
    places = [c.center + 0.5 * z * c.z_rays()[40, 20] for c, z in zip(cameras, depths, strict=True)]
    floaters = blobs(torch.stack(places), 2.0 * size / UNIT)
    sh = torch.nn.functional.pad(floaters.sh, (0, 0, 0, scene.sh.shape[1] - 1))
    gone = taken(merge([scene, replace(floaters, sh=sh)]))
    assert gone[len(scene) :].all()
    assert 0 < gone[: len(scene)].sum() < 0.01 * len(scene)
    for view in views:
        before, after = (
            psnr(renderer.render(part, view.camera).image, view.image)
            for part in (scene, scene[~gone[: len(scene)]])
        )
        assert after > before - 0.02

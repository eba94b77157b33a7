"""Splats in a frame described by a trainer's files; large splats, and remote photographs."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from command import run
from gscompleter.data.formats import open_photographs
from gscompleter.data.local_origin import choose_scene_origin, shift_to_origin
from gscompleter.render.loading import load_renderer
from gscompleter.render.lod import thin_gaussians
from gscompleter.splats.alignment.estimate import SplatAlignment, align_splat, sample_views
from gscompleter.splats.alignment.fit import ImageFit, SplatFit, score_splat, summarize_fits
from gscompleter.splats.alignment.similarity import make_similarity, transform_pose
from gscompleter.splats.alignment.trainer_frames import (
    NERFSTUDIO_WORLDS,
    InputSplat,
    find_camera_lists,
    match_names,
)
from gscompleter.splats.ply import load_ply, save_ply
from gscompleter.splats.transform import transform_gaussians
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import write_image
from gscompleter.types import merge
from scenes import Room, camera_at, gaussians_of, photographed, random_gaussians, view_of

RENDERER = load_renderer("cpu")
PLACES = ((-0.6, 0, 0, 6), (0, -0.3, 0.2, 0), (0.6, 0.1, 0, -6), (0.2, 0.3, 0.4, 0))
CAMERAS = [camera_at(*place, size=96) for place in PLACES]
ARBITRARY = make_similarity(
    0.3, Rotation.from_rotvec([0.9, -1.7, 0.4]).as_matrix(), np.array([5.0, 3.0, -2.0])
)
UTM = np.array([482_000.25, 5_458_000.5, 120.0])


@pytest.fixture(scope="module")
def splat():
    """Return the room as two of its photographs show it."""
    return merge([gaussians_of(view_of(Room(), CAMERAS[i])) for i in (0, 2)])


@pytest.fixture
def room(tmp_path):
    """Photographs of the room, with their cameras."""
    return photographed(tmp_path / "room", CAMERAS)


def in_frame(splat, transform):
    return transform_gaussians(splat, torch.from_numpy(transform).float())


def found_for(path, scene, room, origin=(0.0, 0.0, 0.0)):
    given = InputSplat(path, scene, np.array(origin), room)
    return align_splat(given, open_photographs(room), (0, 1), RENDERER)


def write_cameras(path, transform, room, count=4):
    """Write the camera list of a trainer that worked in the frame of `transform`."""
    entries = []
    for number, frame in enumerate(open_photographs(room).frames[:count]):
        pose = transform_pose(frame.c2w, transform)
        position, rotation = pose[:3, 3].tolist(), pose[:3, :3].tolist()
        shape = {"width": 96, "height": 96, "fx": 86.4, "fy": 86.4}
        name = {"id": number, "img_name": frame.name.split("/")[-1].split(".")[0]}
        entries.append({**name, **shape, "position": position, "rotation": rotation})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(entries))


def put_on_map(room, by):
    """Add `by` to the positions of all cameras."""
    content = json.loads((room / "transforms.json").read_text())
    for frame in content["frames"]:
        for row in range(3):
            frame["transform_matrix"][row][3] += by[row]
    (room / "transforms.json").write_text(json.dumps(content))


def write_dataparser(path, transform, scale=0.3):
    rigid = np.diag([1 / scale, 1 / scale, 1 / scale, 1]) @ transform
    path.write_text(json.dumps({"transform": rigid[:3].tolist(), "scale": scale}))


@pytest.mark.parametrize(
    ("splat_at", "cameras_at"),
    [
        ("splat.ply", "cameras.json"),
        ("splat_small.ply", "cameras_small.json"),
        ("point_cloud/iteration_30000/point_cloud.ply", "cameras.json"),
        ("splat.ply", "room/cameras.json"),
    ],
)
def test_cameras_that_a_trainer_left_tell_the_frame(room, splat, tmp_path, splat_at, cameras_at):
    write_cameras(tmp_path / cameras_at, ARBITRARY, room, count=3)
    found = found_for(tmp_path / splat_at, in_frame(splat, ARBITRARY), room)
    assert found.method == "cameras"
    assert np.allclose(found.transform, ARBITRARY, atol=1e-6)


def test_one_wrong_camera_in_the_list_changes_nothing(room, splat, tmp_path):
    write_cameras(tmp_path / "cameras.json", ARBITRARY, room)
    entries = json.loads((tmp_path / "cameras.json").read_text())
    entries[1]["position"] = [40.0, 2.0, 1.0]
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    found = found_for(tmp_path / "splat.ply", in_frame(splat, ARBITRARY), room)
    assert found.method == "cameras"
    assert np.allclose(found.transform, ARBITRARY, atol=1e-6)


def test_cameras_of_another_splat_are_not_looked_at(tmp_path):
    (tmp_path / "cameras_small.json").write_text("[]")
    assert find_camera_lists(tmp_path / "splat.ply", [tmp_path]) == []


@pytest.mark.parametrize("world", NERFSTUDIO_WORLDS)
def test_nerfstudios_transform_leads_from_the_reconstruction(room, splat, tmp_path, world):
    turn = make_similarity(1.0, world, np.zeros(3))
    write_dataparser(room / "dataparser_transforms.json", ARBITRARY @ turn)
    found = found_for(tmp_path / "splat.ply", in_frame(splat, ARBITRARY), room)
    assert found.method == "dataparser"
    assert np.allclose(found.transform, ARBITRARY, atol=1e-6)


def test_a_damaged_list_of_cameras_is_named_where_it_is_needed(room, splat, tmp_path):
    (tmp_path / "cameras.json").write_text('[{"img_name": "0.png"}]')
    assert found_for(tmp_path / "splat.ply", splat, room).method == "given"
    with pytest.raises(InputError, match="cameras.json"):
        found_for(tmp_path / "splat.ply", in_frame(splat, ARBITRARY), room)


def test_names_agree_without_ending_and_where_folders_repeat_them_with_folders():
    assert match_names(["a/1.jpg", "a/2.jpg"], ["1.png", "2", "3"]) == [
        ("a/1.jpg", "1.png"),
        ("a/2.jpg", "2"),
    ]
    rig = ["left/1.jpg", "left/2.jpg", "right/1.jpg", "right/2.jpg"]
    assert match_names(rig, [name[:-4] for name in rig]) == [(name, name[:-4]) for name in rig]
    assert match_names(rig, ["1", "2"]) == []


@pytest.mark.slow
def test_a_remote_scene_takes_a_splat_in_a_frame_of_its_own(room, splat, tmp_path):
    put_on_map(room, UTM)
    origin = open_photographs(room).origin
    centred = in_frame(splat, make_similarity(1.0, np.eye(3), np.array([3.0, 0.0, 1.0])))
    assert not choose_scene_origin(centred, origin).any()
    expected = make_similarity(1.0, np.eye(3), np.array([3.0, 0.0, 1.0]) + origin - UTM)

    to_splat = make_similarity(1.0, np.eye(3), np.array([3.0, 0.0, 1.0]) - UTM)
    write_dataparser(tmp_path / "dataparser_transforms.json", to_splat, scale=1.0)
    found = found_for(tmp_path / "splat.ply", centred, room)
    assert found.method == "dataparser"
    assert np.allclose(found.transform, expected, atol=1e-6)
    (tmp_path / "dataparser_transforms.json").unlink()

    write_cameras(tmp_path / "cameras.json", to_splat, room)
    found = found_for(tmp_path / "splat.ply", centred, room)
    assert found.method == "cameras"
    assert np.allclose(found.transform, expected, atol=1e-6)


def test_a_splat_in_the_map_of_its_photographs_is_told_from_their_origin(splat):
    origin = np.array([3000.0, 1000.0, 0.0])
    there = in_frame(splat, make_similarity(1.0, np.eye(3), origin))
    assert np.array_equal(choose_scene_origin(there, origin), origin)
    told = shift_to_origin(origin, there, CAMERAS)
    assert torch.allclose(told.means, splat.means, atol=1e-3)


# `tests/data/test_limits.py` completes a splat in large coordinates.
@pytest.mark.slow
@pytest.mark.parametrize("place", [(3000.0, 1000.0, 0.0), (0.0, 0.0, 0.0)])
def test_a_result_is_relative_to_an_origin_where_the_splat_lies_there(
    room, splat, place, tmp_path, monkeypatch, capsys
):
    put_on_map(room, (3000.0, 1000.0, 0.0))
    here = make_similarity(1.0, np.eye(3), np.array(place)) @ ARBITRARY
    to_splat = here @ make_similarity(1.0, np.eye(3), np.array((-3000.0, -1000.0, 0.0)))
    write_cameras(tmp_path / "cameras.json", to_splat, room)
    given, out = tmp_path / "splat.ply", tmp_path / "out"
    save_ply(given, in_frame(splat, here))
    words = ("--context", 0, 2, "--target", 1, "--resolution", 64, "--out", out)
    assert run(monkeypatch, "complete", room, "--scene", given, *words) == 0
    frame = json.loads((out / "summary.json").read_text())["frame"]
    assert frame["method"] == "cameras"
    moved_by = load_ply(given).means - load_ply(out / "context.ply").means
    assert np.allclose(moved_by, frame["origin"], atol=1e-3)
    assert any(frame["origin"]) == any(place)
    assert ("relative to a local origin" in capsys.readouterr().out) == any(place)


# `test_estimate.py` finds similarities; `test_one_wrong_camera_in_the_list_changes_nothing` is
# about cameras.
@pytest.mark.slow
def test_floaters_kilometres_away_change_nothing(tmp_path):
    """The frame is found in the images, which have to be larger for it."""
    cameras = [camera_at(*place, size=192) for place in PLACES]
    room = photographed(tmp_path / "room", cameras)
    splat = merge([gaussians_of(view_of(Room(), cameras[i])) for i in (0, 2)])
    some = splat[:: len(splat) // 300]
    away = torch.nn.functional.normalize(some.means, dim=1) * 1e5
    floaters = in_frame(splat, ARBITRARY)[: len(some)]
    floaters = type(splat)(**{**vars(floaters), "means": away})
    found = found_for(tmp_path / "s.ply", merge([in_frame(splat, ARBITRARY), floaters]), room)
    assert found.method == "similarity"
    assert np.abs(np.linalg.inv(ARBITRARY) @ found.transform - np.eye(4)).max() < 0.03


def test_a_large_splat_is_thinned_to_one_that_looks_alike(splat, room):
    views = sample_views(open_photographs(room), (0, 1))
    fewer = thin_gaussians(splat, len(splat) // 4)
    assert len(splat) // 5 < len(fewer) <= len(splat) // 4
    assert fewer.means.unique(dim=0).shape == fewer.means.shape
    full, thin = (score_splat(scene, views, RENDERER) for scene in (splat, fewer))
    assert thin.coverage == pytest.approx(full.coverage, abs=0.05)
    assert thin.margin > full.margin - 3
    assert thin_gaussians(splat, len(splat)) is splat


def fit_of(*margins, psnr=15.0, covered=0.8, drift=0.1) -> SplatFit:
    return summarize_fits([ImageFit(psnr, margin, covered, drift) for margin in margins])


def test_two_photographs_that_show_the_splat_are_enough_and_one_of_many_is_not():
    assert fit_of(4.0, 4.0, 0.1, -1.0, 0.3, 0.2, 0.5, 0.1).is_match
    assert not fit_of(4.0, 0.1, 0.1, -1.0, 0.3, 0.2, 0.5, 0.1).is_match
    assert fit_of(4.0).is_match
    assert not fit_of().is_match


def test_little_of_a_flat_wall_is_no_sign():
    assert fit_of(0.0, 0.0, psnr=35.0).is_match
    assert not fit_of(0.0, 0.0, psnr=35.0, covered=0.1).is_match


def test_details_that_are_off_are_told():
    off = SplatAlignment("given", np.eye(4), fit_of(5.0, 5.0, drift=4.2), fit_of(), side=240)
    assert off.describe() == (
        "The splat as it is fits the photographs at 15.0 dB in images of 240 px; details are off "
        "by 4.2 px in them."
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_any_similarity_of_a_real_splat_is_found(shared, seed):
    fox = shared / "splats" / "fox"
    if not fox.is_dir():
        pytest.skip(f"needs the splat of another trainer, and there is no folder {fox}")
    generator = np.random.default_rng(seed)
    scale = (0.3, 1.2, 7.0)[seed % 3]
    turn = Rotation.random(random_state=generator).as_matrix()
    truth = make_similarity(scale, turn, 5 * scale * generator.normal(size=3))
    splat = load_ply(fox / "splat.ply")
    given = InputSplat(fox.parent / "s.ply", in_frame(splat, truth), np.zeros(3), fox / "images")
    photographs = open_photographs(fox)
    found = align_splat(given, photographs, (0, 3), RENDERER)
    assert found.method == "similarity"
    assert np.abs(np.linalg.inv(truth) @ found.transform - np.eye(4)).max() < 3e-3
    plain = score_splat(splat, sample_views(photographs, (0, 3)), RENDERER)
    assert found.fit.psnr == pytest.approx(plain.psnr, abs=0.2)


@pytest.fixture
def drive(tmp_path):
    """Photographs of which the splat shows 6 and 7, named 14 and 15; others show something else."""
    around = [camera_at(0.1 * x, 0.0, 0.0, 180, size=96) for x in range(18)]
    cameras = [*around[:14], CAMERAS[0], CAMERAS[2], *around[14:]]
    folder = photographed(tmp_path / "drive", cameras)
    generator = torch.Generator().manual_seed(0)
    for number in set(range(len(cameras))) - {14, 15}:
        coarse = torch.rand(1, 3, 12, 12, generator=generator)
        image = torch.nn.functional.interpolate(coarse, (96, 96), mode="bilinear")[0]
        write_image(folder / f"{number}.png", image.permute(1, 2, 0))
    return folder


def test_a_splat_of_a_part_of_a_drive_is_found_in_it(splat, drive, tmp_path):
    shown = [view.frame for view in sample_views(open_photographs(drive), (0, 1))]
    assert not {6, 7} & set(shown)
    found = found_for(tmp_path / "s.ply", splat, drive)
    assert found.given_fit.is_match
    assert np.abs(found.transform - np.eye(4)).max() < 0.05
    # Only what no photograph agrees with is refused.
    with pytest.raises(InputError, match="does not show what the photographs show"):
        found_for(tmp_path / "s.ply", random_gaussians(300), drive)


def test_samples_reach_the_end_of_a_drive(drive):
    shown = [view.frame for view in sample_views(open_photographs(drive), (0, 1, 2, 3))]
    assert shown[:4] == [0, 1, 2, 3]
    assert shown[4:] == [4, 9, 14, 19]


@pytest.mark.parametrize("count", [1, 3])
def test_photographs_from_one_place_refuse_a_foreign_splat_as_others_do(tmp_path, count):
    cameras = [camera_at(0.0, yaw=10 * number, size=96) for number in range(count)]
    folder = photographed(tmp_path / "tripod", cameras)
    foreign = InputSplat(tmp_path / "s.ply", random_gaussians(300), np.zeros(3), folder)
    with pytest.raises(InputError, match="does not show what the photographs show"):
        align_splat(foreign, open_photographs(folder), (0,), RENDERER)


def test_the_photographs_that_a_splat_was_made_of_are_asked(splat, drive, tmp_path):
    photographs = open_photographs(drive)
    given = InputSplat(tmp_path / "s.ply", splat, np.zeros(3), drive)
    views = sample_views(photographs, (0, 1), (6, 7))
    assert [view.frame for view in views] == [6, 7]
    assert align_splat(given, photographs, (0, 1), RENDERER, (6, 7)).fit.coverage > 0.9
    # Without one that can be read, others are.
    for name in ("14.png", "15.png"):
        (drive / name).write_bytes(b"")
    assert len(sample_views(open_photographs(drive), (0, 1), (6, 7))) == 8


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fountain_p11", "kitti_city"])
def test_a_real_splat_of_another_scene_is_refused(shared, name):
    fox = shared / "splats" / "fox"
    if not fox.is_dir():
        pytest.skip(f"needs the splat of another trainer, and there is no folder {fox}")
    given = InputSplat(fox / "splat.ply", load_ply(fox / "splat.ply"), np.zeros(3), fox)
    with pytest.raises(InputError, match="give the photographs and poses"):
        align_splat(given, open_photographs(shared / "data" / name), (0, 2), RENDERER)

"""A splat in map coordinates is completed as the same splat near zero, and stays in its map."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import gscompleter as gsc
from command import run
from gscompleter import load_splat, merge, save_ply
from gscompleter.apps.report.schema import ResultFrame
from gscompleter.apps.viewer.exhibit import (
    ViewerContent,
    add_file_cameras,
    load_scene_cameras,
    load_viewer_completion,
    load_viewer_files,
    place_content,
)
from gscompleter.data.formats import open_photographs
from map_scene import PLACE, write_map_ply
from scenes import Room, camera_at, gaussians_of, photographed, view_of

SIZE = 48
CAMERAS = [camera_at(x, size=SIZE) for x in (-0.3, 0.1, 0.5)]
MAP = np.floor(PLACE)
WORDS = ("--context", 0, 1, "--target", 2, "--resolution", SIZE, SIZE, "--quiet")


def shift_cameras(path: Path, by: np.ndarray) -> None:
    """Add `by` to the positions of all cameras of a file."""
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        for row, offset in enumerate(by.tolist()):
            frame["transform_matrix"][row][3] += offset
    path.write_text(json.dumps(content))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return two folders of the same room and splat, one near zero and one in a map."""
    folder = tmp_path_factory.mktemp("scenes")
    splat = merge([gaussians_of(view_of(Room(), camera)) for camera in CAMERAS[:2]])
    for name in ("near", "map"):
        photographed(folder / name / "room", CAMERAS)
    save_ply(folder / "near" / "splat.ply", splat)
    write_map_ply(folder / "map" / "splat.ply", splat, MAP)
    shift_cameras(folder / "map" / "room" / "transforms.json", MAP)
    return folder / "near", folder / "map"


def places_of(path: Path) -> np.ndarray:
    scene = load_splat(path)
    return scene.means.double().numpy() + np.array(scene.origin or (0, 0, 0))


def summary_of(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


@pytest.fixture(scope="module")
def completed(folders):
    """Return the folders of both completions."""
    outs = []
    with pytest.MonkeyPatch.context() as monkeypatch:
        for folder in folders:
            words = (folder / "room", "--scene", folder / "splat.ply", "--out", folder / "OUT")
            assert run(monkeypatch, "complete", *words, *WORDS) == 0
            outs.append(folder / "OUT")
    return outs


def test_the_map_changes_nothing_of_a_completion(completed):
    near, there = map(summary_of, completed)
    assert near["gaussians"] == there["gaussians"]
    assert near["gaussians"]["added"] > 0
    for key in ("psnr_before", "psnr_after", "hole_fraction"):
        assert there["targets"][0][key] == pytest.approx(near["targets"][0][key], abs=1e-3)
    for name in ("completed.ply", "generated.ply", "context.ply"):
        expected = places_of(completed[0] / name) + MAP
        assert np.abs(places_of(completed[1] / name) - expected).max() < 1e-3
        assert b"property double x" in (completed[1] / name).read_bytes()[:2000]
        assert b"property double x" not in (completed[0] / name).read_bytes()[:2000]


def test_the_given_file_comes_back_byte_for_byte(completed, folders, tmp_path, monkeypatch):
    out = tmp_path / "back.ply"
    assert run(monkeypatch, "strip", completed[1] / "completed.ply", "--out", out) == 0
    assert out.read_bytes() == (folders[1] / "splat.ply").read_bytes()


def test_the_frame_of_the_result_is_the_map(completed, folders):
    frame = summary_of(completed[1])["frame"]
    assert frame["method"] == "given"
    assert np.array_equal(frame["transform"], np.eye(4))
    assert frame["origin"] == list(load_splat(folders[1] / "splat.ply").origin)
    (camera,) = json.loads((completed[1] / "targets.json").read_text())["frames"]
    centre = np.array(camera["transform_matrix"])[:3, 3]
    assert np.abs(centre - MAP - CAMERAS[2].center.numpy()).max() < 1e-6


def test_cameras_of_a_page_see_what_they_saw(completed):
    near, there = (load_viewer_completion(out, drop_nonfinite=False) for out in completed)
    assert len(near.cameras) == len(there.cameras) == 3
    origin = np.array(there.after.origin)
    for ours, theirs in zip(near.cameras, there.cameras, strict=True):
        centre = theirs.camera.center.double().numpy() + origin - MAP
        assert np.abs(centre - ours.camera.center.numpy()).max() < 1e-5
    assert there.before.origin == there.after.origin


def test_cameras_of_a_file_are_those_of_the_splat_beside_it(folders):
    content = load_viewer_files(folders[1] / "splat.ply", None, drop_nonfinite=False)
    content = add_file_cameras(content, folders[1] / "room", None)
    for camera, shot in zip(CAMERAS, content.cameras, strict=True):
        centre = shot.camera.center.double().numpy() + np.array(content.after.origin) - MAP
        assert np.abs(centre - camera.center.numpy()).max() < 1e-5


@pytest.mark.parametrize("is_splat_in_map", [False, True])
def test_cameras_of_a_splat_in_another_frame_are_not_rounded(tmp_path, is_splat_in_map):
    """Either the splat or its photographs are in a map."""
    cameras = [camera_at(0.37, 0.13, size=SIZE), *CAMERAS]
    photographed(tmp_path, cameras)
    splat = gaussians_of(view_of(Room(), CAMERAS[0]))
    origin = tuple(MAP.tolist()) if is_splat_in_map else None
    by = MAP if is_splat_in_map else -MAP
    if not is_splat_in_map:
        shift_cameras(tmp_path / "transforms.json", MAP)
    transform = np.eye(4)
    transform[:3, 3] = by
    rows = tuple(map(tuple, transform.tolist()))
    # As versions wrote it whose origin was that of the splat, in its frame.
    frame = ResultFrame("cameras", rows, origin or (0.0, 0.0, 0.0))
    content = place_content(ViewerContent("a", replace(splat, origin=origin), None), frame)
    loaded = load_scene_cameras(tmp_path, content.transform, content.origin)
    for camera, expected in zip(loaded, cameras, strict=True):
        assert torch.allclose(camera.center, expected.center, atol=1e-5)


@pytest.mark.slow
def test_the_origin_of_a_result_is_that_of_its_photographs(folders, tmp_path, monkeypatch):
    """Its splat is in a map, and its photographs are not, as cameras.json beside it tells."""
    splat = shutil.copy(folders[1] / "splat.ply", tmp_path / "splat.ply")
    entries = []
    for number, frame in enumerate(open_photographs(folders[0] / "room").frames):
        position, rotation = (frame.c2w[:3, 3] + MAP).tolist(), frame.c2w[:3, :3].tolist()
        name = {"id": number, "img_name": Path(frame.name).stem}
        shape = {"width": SIZE, "height": SIZE, "fx": 0.9 * SIZE, "fy": 0.9 * SIZE}
        entries.append({**name, **shape, "position": position, "rotation": rotation})
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    words = (folders[0] / "room", "--scene", splat, "--out", tmp_path / "OUT")
    assert run(monkeypatch, "complete", *words, *WORDS) == 0
    frame = summary_of(tmp_path / "OUT")["frame"]
    assert frame["method"] == "cameras"
    assert np.allclose(np.array(frame["transform"])[:3, 3], MAP)
    assert frame["origin"] == [0, 0, 0]


def test_a_page_counts_in_the_coordinates_of_the_file(folders, tmp_path, monkeypatch):
    page = tmp_path / "page.html"
    assert run(monkeypatch, "view", folders[1] / "splat.ply", "--save", page) == 0
    text = page.read_text()
    centre = json.loads(text.partition('"frame": {"centre": ')[2].partition(', "unit"')[0])
    middle = np.median(places_of(folders[1] / "splat.ply"), axis=0)
    assert np.abs(np.array(centre) - middle).max() < 0.1


@pytest.mark.slow
def test_boxes_are_in_the_coordinates_of_the_file(folders, tmp_path, monkeypatch):
    counts = []
    for name, folder, place in zip("ab", folders, (np.zeros(3), MAP), strict=True):
        low, high = np.array([-0.5, -0.5, 3]) + place, np.array([0.5, 0.5, 6]) + place
        words = ("--box", *low.tolist(), *high.tolist(), "--out", tmp_path / name)
        scene = (folder / "room", "--scene", folder / "splat.ply")
        assert run(monkeypatch, "remove", *scene, *words, "--resolution", SIZE, SIZE) == 0
        counts.append(summary_of(tmp_path / name)["gaussians"])
    assert counts[0] == counts[1]
    assert counts[0]["removed"] > 50
    out = tmp_path / "back.ply"
    assert run(monkeypatch, "strip", tmp_path / "b" / "completed.ply", "--out", out) == 0
    assert out.read_bytes() == (folders[1] / "splat.ply").read_bytes()


def test_a_box_beside_a_map_is_told_where_the_map_is(folders, tmp_path, monkeypatch, capsys):
    scene = ("--scene", folders[1] / "splat.ply", "--out", tmp_path / "OUT")
    words = ("--box", -1, -1, -1, 1, 1, 1, "--resolution", SIZE, SIZE)
    assert run(monkeypatch, "remove", folders[1] / "room", *scene, *words) == 2
    assert "reaches from 499" in capsys.readouterr().err


@pytest.fixture(scope="module")
def local_splat(folders, tmp_path_factory) -> Path:
    """Write the splat relative to the origin of the photographs in the map, as results are."""
    place = open_photographs(folders[1] / "room").origin
    splat = load_splat(folders[0] / "splat.ply")
    means = splat.means + torch.from_numpy(MAP - place).float()
    path = tmp_path_factory.mktemp("local") / "splat.ply"
    save_ply(path, replace(splat, means=means))
    return path


def test_a_box_beside_a_splat_near_zero_is_told_where_that_is(
    folders, local_splat, tmp_path, monkeypatch, capsys
):
    scene = ("--scene", local_splat, "--out", tmp_path / "OUT")
    low = MAP.astype(int).tolist()
    words = ("--box", *low, *(number + 1 for number in low), "--resolution", SIZE, SIZE)
    assert run(monkeypatch, "remove", folders[1] / "room", *scene, *words) == 2
    said = capsys.readouterr().err
    assert "reaches from" in said
    assert "reaches from 499" not in said


@pytest.mark.slow
def test_boxes_are_in_the_coordinates_of_a_splat_near_zero(
    folders, local_splat, tmp_path, monkeypatch
):
    counts = []
    moved = MAP - open_photographs(folders[1] / "room").origin
    splats = (folders[0] / "splat.ply", local_splat)
    for name, folder, splat, by in zip("ab", folders, splats, (np.zeros(3), moved), strict=True):
        low, high = np.array([-0.5, -0.5, 3]) + by, np.array([0.5, 0.5, 6]) + by
        words = ("--box", *low.tolist(), *high.tolist(), "--out", tmp_path / name)
        scene = (folder / "room", "--scene", splat)
        assert run(monkeypatch, "remove", *scene, *words, "--resolution", SIZE, SIZE) == 0
        counts.append(summary_of(tmp_path / name)["gaussians"]["removed"])
    assert counts[0] == counts[1]
    assert counts[0] > 50


# `test_remove.py` removes a selection, and `tests/splats/test_origin.py` reads origins.
@pytest.mark.slow
def test_selected_gaussians_are_found_in_the_map(folders, tmp_path, monkeypatch):
    scene = load_splat(folders[1] / "splat.ply")
    # A selection has a middle of its own, and so another origin.
    chosen = scene[(scene.means[:, 0] > 1) & (scene.means[:, 0] < 2)]
    save_ply(tmp_path / "chosen.ply", chosen)
    assert load_splat(tmp_path / "chosen.ply").origin != scene.origin
    words = ("--select", tmp_path / "chosen.ply", "--out", tmp_path / "OUT", "--quiet")
    place = (folders[1] / "room", "--scene", folders[1] / "splat.ply")
    assert run(monkeypatch, "remove", *place, *words, "--resolution", SIZE, SIZE) == 0
    assert summary_of(tmp_path / "OUT")["gaussians"]["removed"] >= len(chosen)


@pytest.mark.slow
def test_a_splat_alone_takes_cameras_of_its_map(folders, completed, tmp_path, monkeypatch):
    results = []
    for name, folder, out in zip("ab", folders, completed, strict=True):
        cameras = ("--cameras", folder / "room", "--target", out / "targets.json")
        more = ("--resolution", SIZE, SIZE, "--out", tmp_path / name, "--quiet")
        assert run(monkeypatch, "complete", folder / "splat.ply", *cameras, *more) == 0
        results.append(summary_of(tmp_path / name))
    assert results[0]["gaussians"] == results[1]["gaussians"]


@pytest.mark.slow
def test_clean_keeps_the_rows_of_a_map(folders, tmp_path, monkeypatch):
    counts = []
    for name, folder in zip("ab", folders, strict=True):
        words = ("--scene", folder / "splat.ply", "--out", tmp_path / name, "--quiet")
        size = ("--resolution", SIZE, SIZE)
        assert run(monkeypatch, "clean", folder / "room", *words, *size) == 0
        counts.append(summary_of(tmp_path / name)["gaussians"])
    assert counts[0] == counts[1]
    assert b"property double x" in (tmp_path / "b" / "completed.ply").read_bytes()[:2000]


# `tests/splats/test_origin.py` reads and writes such files.
@pytest.mark.slow
def test_a_glb_in_a_map_is_completed_as_well(folders, completed, tmp_path, monkeypatch):
    glb = tmp_path / "splat.glb"
    assert run(monkeypatch, "convert", folders[1] / "splat.ply", glb) == 0
    scene = ("--scene", glb, "--out", tmp_path / "OUT")
    assert run(monkeypatch, "complete", folders[1] / "room", *scene, *WORDS) == 0
    assert summary_of(tmp_path / "OUT")["gaussians"] == summary_of(completed[1])["gaussians"]
    written = places_of(tmp_path / "OUT" / "completed.ply")
    assert np.abs(written.min(0) - places_of(completed[1] / "completed.ply").min(0)).max() < 1e-3


# `tests/splats/test_origin.py` has such a line.
@pytest.mark.slow
def test_small_results_say_how_far_they_round(folders, tmp_path, monkeypatch):
    scene = ("--scene", folders[1] / "splat.ply", "--out", tmp_path / "OUT", "--save-as", ".spz")
    assert run(monkeypatch, "complete", folders[1] / "room", *scene, *WORDS) == 0
    notes = summary_of(tmp_path / "OUT")["scene"]["notes"]
    assert any("the largest rounding of a position is" in note for note in notes)


# `test_the_map_changes_nothing_of_a_completion` does it by the command.
@pytest.mark.slow
def test_python_takes_photographs_at_the_origin_of_a_splat(folders, tmp_path):
    scene = load_splat(folders[1] / "splat.ply")
    room = folders[1] / "room"
    views = gsc.load_views(room, frames=[0, 1], origin=scene.origin)
    target = gsc.load_camera(room, 2, origin=scene.origin)
    for camera, expected in zip([v.camera for v in views] + [target], CAMERAS, strict=True):
        centre = camera.center.double().numpy() + np.array(scene.origin) - MAP
        assert np.abs(centre - expected.center.numpy()).max() < 1e-5
    completion = gsc.GSCompleter()(views, target, scene=scene)
    assert completion.scene.origin == scene.origin
    out = completion.save(tmp_path / "OUT", splat=folders[1] / "splat.ply")
    written = places_of(out / "completed.ply")
    expected = completion.scene.means.double().numpy() + np.array(scene.origin)
    assert np.abs(np.sort(written, axis=0) - np.sort(expected, axis=0)).max() < 1e-5
    content = load_viewer_completion(out, drop_nonfinite=False)
    centre = content.cameras[0].camera.center.double().numpy() + np.array(content.after.origin)
    assert np.abs(centre - MAP - CAMERAS[2].center.numpy()).max() < 1e-5


def test_photographs_in_coordinates_of_their_own_stay_as_they_are(folders):
    origin = np.array(load_splat(folders[1] / "splat.ply").origin)
    near, there = (open_photographs(folder / "room") for folder in folders)
    assert np.array_equal(there.at_origin(origin).origin, origin)
    assert near.at_origin(origin) is near
    with pytest.raises(gsc.InputError, match="An origin has three numbers"):
        gsc.load_views(folders[0] / "room", frames=[0], origin=(1.0, 2.0))


@pytest.mark.slow
def test_marks_of_a_camera_in_the_map_remove_the_same(folders, completed, tmp_path, monkeypatch):
    mask = torch.zeros(SIZE, SIZE)
    mask[16:32, 16:32] = 1
    from gscompleter.system.files.image import write_image

    write_image(tmp_path / "mask.png", mask)
    counts = []
    for name, folder, out in zip("ab", folders, completed, strict=True):
        shutil.copyfile(out / "targets.json", tmp_path / f"{name}.json")
        words = ("--target", tmp_path / f"{name}.json", "--mask", tmp_path / "mask.png")
        scene = (folder / "room", "--scene", folder / "splat.ply", "--out", tmp_path / name)
        more = ("--resolution", SIZE, SIZE, "--quiet")
        assert run(monkeypatch, "repair", *scene, *words, *more) == 0
        counts.append(summary_of(tmp_path / name)["gaussians"])
    assert counts[0] == counts[1]
    assert counts[0]["removed"] > 0

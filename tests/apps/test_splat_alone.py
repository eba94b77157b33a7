"""`complete` of a splat without photographs: cameras are given, beside it, or around a target."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from command import run
from gscompleter import load_cameras, load_ply, save_ply
from gscompleter.apps.inputs.captures import (
    Capture,
    RenderRequest,
    choose_side,
    describe_capture,
)
from gscompleter.apps.inputs.renders import make_frames, open_renders
from gscompleter.apps.inputs.splat import read_splat, sort_splat
from gscompleter.apps.requests.scene import SceneRequest
from gscompleter.apps.requests.splat import Selection, SplatRequest
from gscompleter.data.scene import write_cameras
from gscompleter.parts import MAX_TARGET_ID
from gscompleter.render.loading import load_renderer
from gscompleter.system.files.image import read_image, write_image
from gscompleter.trust.lifted import find_pixel_center
from gscompleter.types import Camera, Gaussians
from scenes import Room, camera_at, gaussians_of, photographed, view_of

SIZE = 64


def make_camera(x: float = 0.0, yaw: float = 0.0) -> Camera:
    return replace(camera_at(x, yaw=yaw, size=SIZE), near=None, far=None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a splat of one photograph, and cameras beside which its hole is seen."""
    folder = tmp_path_factory.mktemp("alone")
    save_ply(folder / "splat.ply", gaussians_of(view_of(Room(), camera_at(size=SIZE))))
    write_cameras(folder / "target.json", [make_camera(yaw=12)])
    write_cameras(folder / "around.json", [make_camera(-0.3), make_camera(0.3), make_camera(0.1)])
    return folder


@pytest.fixture(scope="module")
def done(folder) -> Path:
    """Return the output for a named target."""
    out = folder / "done"
    with pytest.MonkeyPatch.context() as monkeypatch:
        words = ("complete", folder / "splat.ply", "--target", folder / "target.json")
        assert run(monkeypatch, *words, "--out", out, "--quiet") == 0
    return out


def read_summary(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


def test_a_named_target_is_completed_from_renders_around_it(folder, done, tmp_path, monkeypatch):
    summary = read_summary(done)
    scene = summary["scene"]
    assert (scene["format"], scene["renders_from"]) == ("renders", "targets")
    assert summary["settings"]["folder"] is None
    assert summary["settings"]["config"]["trust"] == "full"
    assert summary["settings"]["config"]["registration"]["hole_depth"] == "scene"
    assert summary["held_out"] == []
    assert 1 <= len(summary["context"]) <= 3
    (target,) = summary["targets"]
    # Nobody photographed what a camera of a file sees.
    assert (target["frame"], target["psnr_after"]) == (None, None)
    assert target["added"] > 100
    assert summary["coverage"]["after"] > summary["coverage"]["before"]

    page = (done / "report.html").read_text()
    assert "Renders in place of photographs" in page
    assert "No photograph checked this" in page
    kept = summary["kept"]
    assert kept["cameras"] >= 3
    assert kept["worst_psnr"] > 45
    assert f"Seen from {kept['cameras']} cameras that decided nothing" in page
    for number in range(1, len(summary["context"]) + 1):
        assert (done / "images" / f"context{number}_render.png").is_file()
    assert len(load_cameras(done / "renders.json")) == len(summary["context"])

    # All that was given comes back, byte for byte.
    back = tmp_path / "back.ply"
    assert run(monkeypatch, "strip", done / "completed.ply", "--out", back, "--quiet") == 0
    assert back.read_bytes() == (folder / "splat.ply").read_bytes()


# The next test takes cameras from a file; `done` is a plain completion.
@pytest.mark.slow
def test_the_cameras_of_a_run_give_the_same_scene_again(folder, done, tmp_path, monkeypatch):
    words = ("complete", "--scene", folder / "splat.ply", "--target", folder / "target.json")
    cameras = ("--cameras", done / "renders.json")
    out = tmp_path / "out"
    assert run(monkeypatch, *words, *cameras, "--out", out, "--quiet") == 0
    assert (out / "completed.ply").read_bytes() == (done / "completed.ply").read_bytes()
    assert read_summary(out)["scene"]["renders_from"] == "cameras"


def test_cameras_beside_the_splat_are_found_and_said(folder, tmp_path, monkeypatch, capsys):
    shutil.copy(folder / "splat.ply", tmp_path / "splat.ply")
    write_inria_cameras(tmp_path / "cameras.json", load_cameras(folder / "around.json"))
    words = ("complete", tmp_path / "splat.ply", "--target", folder / "target.json")
    plan = ("--out", tmp_path / "plan", "--dry-run")
    assert run(monkeypatch, *words, "--context", "0", "cam_1", *plan) == 0
    said = capsys.readouterr().err
    assert "cameras.json, which was found beside the splat, take their place" in said


# The plan before takes the same cameras.
@pytest.mark.slow
def test_cameras_beside_the_splat_are_named_in_the_summary(folder, tmp_path, monkeypatch):
    shutil.copy(folder / "splat.ply", tmp_path / "splat.ply")
    write_inria_cameras(tmp_path / "cameras.json", load_cameras(folder / "around.json"))
    words = ("complete", tmp_path / "splat.ply", "--target", folder / "target.json")
    out = tmp_path / "out"
    assert run(monkeypatch, *words, "--context", "0", "cam_1", "--out", out) == 0
    summary = read_summary(out)
    assert [row["frame"] for row in summary["context"]] == [0, 1]
    assert [row["file"] for row in summary["context"]] == ["cam_0", "cam_1"]
    assert summary["targets"][0]["added"] > 100


def write_inria_cameras(path: Path, cameras: list[Camera]) -> None:
    """Write cameras as the trainers of 3DGS do."""
    rows = [
        {
            "id": number,
            "img_name": f"cam_{number}",
            "width": camera.width,
            "height": camera.height,
            "position": camera.center.tolist(),
            "rotation": camera.c2w[:3, :3].tolist(),
            "fx": camera.K[0, 0].item(),
            "fy": camera.K[1, 1].item(),
        }
        for number, camera in enumerate(cameras)
    ]
    path.write_text(json.dumps(rows))


def test_cameras_alone_let_targets_be_found(folder, tmp_path, monkeypatch):
    words = ("complete", folder / "splat.ply", "--cameras", folder / "around.json", "--auto", 1)
    out = tmp_path / "out"
    assert run(monkeypatch, *words, "--out", out, "--dry-run", "--quiet") == 0
    assert len(load_cameras(out / "targets.json")) == 1
    assert len(load_cameras(out / "renders.json")) == 3
    assert (out / "images" / "target1_beside.png").is_file()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ((), "Nothing is named that is to be completed"),
        (("splat.ply", "--up", "0", "0", "0"), "three numbers that are not all zero"),
        (("splat.ply", "--up", "0", "1", "0", "--target", "target.json"), "leave --up out"),
        (("photographs", "--up", "0", "1", "0"), "photographs of SCENE tell what is up"),
        (("object.ply", "--target", "object.json"), "its only hole there is the space around it"),
        (("splat.ply", "--mask", "mask.png"), "name the camera of each with --target"),
        (
            ("splat.ply", "--target", "target.json", "--mask", "mask.png", "mask.png"),
            "There are 2 masks and 1 target cameras",
        ),
        (("splat.ply", "--target", "target.json", "--mask", "wide.png"), "aspect ratio of 64 × 64"),
        (
            ("splat.ply", "--target", "target.json", "--mask", "black.png"),
            "black.png is black everywhere",
        ),
        (("photographs", "--target", "target.json", "--mask", "mask.png"), "Without a splat"),
        (("splat.ply", "--scene", "splat.ply"), "Two splats are named"),
        (("splat.ply", "--target", "3"), "'3' is no target: there are no photographs to name"),
        (("splat.ply", "--target", "target.json", "--context", "0"), "there is none"),
        (("splat.ply", "--target", "opaque.json"), "opaque everywhere in the image of the target"),
        (("splat.ply", "--target", "away.json"), "sees surfaces of the scene in 0.0%"),
        (("splat.ply", "--target", "target.json", "--no-masks"), r"apply this to.*\(--no-masks\)"),
        (("photographs", "--cameras", "around.json"), "photographs of SCENE have cameras"),
        (("splat.ply", "--cameras", "nothing.json"), "nothing.json"),
        (("full.ply", "--target", "target.json", "--dry-run"), "can tell 254 apart"),
        (("full.ply", "--target", "target.json", "--export-holes", "holes"), "can tell 254 apart"),
    ],
)
def test_what_cannot_be_done_is_refused_with_what_to_give_instead(
    folder, tmp_path, monkeypatch, capsys, words, sentence
):
    write_refused(folder)
    monkeypatch.chdir(folder)
    assert run(monkeypatch, "complete", *words, "--out", tmp_path / "out", "--quiet") == 2
    assert re.search(sentence, capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def write_refused(folder: Path) -> None:
    """Write what is refused into the folder, once."""
    if (folder / "photographs").exists():
        return
    photographed(folder / "photographs", [camera_at(0.1, size=SIZE)])
    # A ball of Gaussians of one size, in front of nothing.
    ball = torch.randn((3000, 3), generator=torch.Generator().manual_seed(0))
    ball = torch.nn.functional.normalize(ball, dim=1) * 0.8 + torch.tensor([0.0, 0.0, 4.0])
    dots = gaussians_of(view_of(Room(), camera_at(size=SIZE)))[:3000]
    save_ply(folder / "object.ply", replace(dots, means=ball, scales=torch.full_like(ball, 0.06)))
    write_cameras(folder / "object.json", [make_camera()])
    # No label is left for a target.
    full = gaussians_of(view_of(Room(), camera_at(size=SIZE)))
    labels = full.generated.clone()
    labels[-1] = MAX_TARGET_ID
    save_ply(folder / "full.ply", replace(full, generated=labels))
    mask = torch.zeros((SIZE, SIZE), dtype=torch.bool)
    write_image(folder / "black.png", mask)
    mask[20:30, 20:34] = True
    write_image(folder / "wide.png", mask.repeat(1, 2))
    write_image(folder / "mask.png", mask)
    narrow = make_camera()
    narrow.K[[0, 1], [0, 1]] *= 2
    write_cameras(folder / "opaque.json", [narrow])
    write_cameras(folder / "away.json", [make_camera(yaw=180)])


def test_the_splat_is_kept_bit_for_bit(folder, done):
    given = load_ply(folder / "splat.ply")
    completed = load_ply(done / "completed.ply")
    kept = completed[completed.generated == 0]
    assert len(kept) == len(given)
    assert (kept.means == given.means).all()
    assert (kept.sh == given.sh).all()


# `test_painters.py` completes paintings with photographs.
@pytest.mark.slow
def test_a_painted_hole_of_a_splat_alone_is_completed(folder, tmp_path, monkeypatch):
    words = ("complete", folder / "splat.ply", "--quiet", "--overwrite")
    target = ("--target", folder / "target.json")
    holes = tmp_path / "holes"
    out = tmp_path / "out"
    assert run(monkeypatch, *words, *target, "--out", out, "--export-holes", holes) == 0
    # The cameras of the renders have no names that could be repeated; they are found again.
    assert json.loads((holes / "holes.json").read_text())["context"] == []

    image = read_image(holes / "target1.png")
    is_hole = read_image(holes / "target1_mask.png").mean(dim=-1) > 0.5
    image[is_hole] = torch.tensor([1.0, 0.0, 0.0])
    write_image(holes / "target1.png", image)
    assert run(monkeypatch, *words, "--images", holes, "--painter", "a hand", "--out", out) == 0
    (row,) = read_summary(out)["targets"]
    assert row["painter"] == "a hand"
    after = read_image(out / "images" / "target1_after.png")
    red = (after[..., 0] > 0.6) & (after[..., 1] < 0.4)
    assert (red & is_hole).sum() > 0.7 * is_hole.sum()


@pytest.mark.slow
def test_an_export_does_not_number_renders_that_the_next_command_does_not_have(
    folder, tmp_path, monkeypatch
):
    words = ("complete", folder / "splat.ply", "--auto", 1, "--out", tmp_path / "out", "--quiet")
    assert run(monkeypatch, *words, "--export-holes", tmp_path / "holes") == 0
    (row,) = json.loads((tmp_path / "holes" / "holes.json").read_text())["frames"]
    assert (row["derived_from"], row["offset"]) == (None, None)
    assert row["title"].startswith("near render ")


@pytest.mark.slow
def test_with_nothing_named_the_camera_of_a_pixel_aligned_splat_is_found(
    folder, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    words = ("complete", folder / "splat.ply", "--auto", 1, "--out", out)
    assert run(monkeypatch, *words) == 0
    said = capsys.readouterr()
    assert "renders of the splat at 8 cameras that follow from the sizes" in said.err
    kept = "cameras that decided nothing, what the splat showed stays as it was"
    assert kept not in said.out  # nothing to act on
    assert kept in (out / "report.html").read_text()
    summary = read_summary(out)
    assert summary["scene"]["renders_from"] == "pixels"
    assert summary["targets"][0]["added"] > 100
    first = load_cameras(out / "renders.json")[0]
    assert first.center.norm() < 0.5
    assert first.forward[2] > 0.98


@pytest.mark.slow
def test_whether_a_splat_is_trained_is_decided_once(folder, tmp_path, monkeypatch):
    searches = []

    def search(scene: Gaussians) -> torch.Tensor | None:
        searches.append(len(scene))
        return find_pixel_center(scene)

    for place in ("apps.inputs.renders.find_pixel_center", "trust.lifted.find_pixel_center"):
        monkeypatch.setattr(f"gscompleter.{place}", search)
    words = ("complete", folder / "splat.ply", "--auto", 1, "--dry-run", "--quiet")
    small = ("--resolution", 24, 24, "--config.next-best-view.image-size", 24)
    assert run(monkeypatch, *words, *small, "--out", tmp_path / "out") == 0
    assert len(searches) == 1


@pytest.mark.slow
def test_around_an_object_no_target_is_found(folder, tmp_path, monkeypatch, capsys):
    write_refused(folder)
    write_cameras(tmp_path / "cameras.json", [make_camera(-0.3), make_camera(0.3)])
    words = ("complete", folder / "object.ply", "--cameras", tmp_path / "cameras.json")
    out = tmp_path / "out"
    assert run(monkeypatch, *words, "--auto", 1, "--out", out) == 0
    said = capsys.readouterr()
    assert "The splat is an object on nothing" in said.err
    assert said.out.startswith("Nothing was gained")
    assert read_summary(out)["gaussians"]["added"] == 0
    assert read_summary(out)["targets"] == []


@pytest.mark.parametrize(
    ("source", "further"),
    [
        ("place", {"place": Selection(sphere=(0.0, 0.3, 2.2, 0.3))}),
        ("pixels", {}),
        ("standpoints", {}),
    ],
)
def test_cameras_that_are_found_have_the_depth_range_that_was_given(
    folder, monkeypatch, source, further
):
    if source == "standpoints":
        monkeypatch.setattr("gscompleter.apps.inputs.renders.find_pixel_center", lambda _: None)
        monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_RANDOM", 20)
    splat = SplatRequest(folder / "splat.ply")
    scene, file = sort_splat(read_splat(splat), splat, "cpu")
    reading = SceneRequest(splat.path, resolution=SIZE, near=0.01, far=300.0)
    request = RenderRequest(reading=reading, up=(0.0, -1.0, 0.0), **further)
    task = open_renders(request, file, scene, load_renderer("cpu"), "cpu").task
    assert task.depths == {"near": "given", "far": "given"}
    assert {(view.camera.near, view.camera.far) for view in task.views} == {(0.01, 300.0)}


@pytest.mark.parametrize(
    ("total", "chosen", "words"),
    [(1, 1, "at 1 camera found"), (3, 3, "at 3 cameras found"), (3, 1, "at 1 of the 3 cameras f")],
)
def test_the_sentence_on_renders_counts_their_cameras(total, chosen, words):
    cameras = [make_camera(x / 10) for x in range(total)]
    names = [f"render{number}" for number in range(total)]
    capture = Capture(cameras, names, "targets", "found around the targets", "")
    assert f"renders of the splat {words}" in describe_capture(capture, chosen)


def test_the_frames_of_cameras_in_float64_leave_these_where_they_stand(folder):
    splat = SplatRequest(folder / "splat.ply")
    scene, _ = sort_splat(read_splat(splat), splat, "cpu")
    camera = make_camera(0.3)
    exact = replace(camera, c2w=camera.c2w.double(), K=camera.K.double())
    capture = Capture([exact], ["a"], "cameras", "of a file", "")
    (frame,) = make_frames(capture, scene, load_renderer("cpu"), np.array([100.0, 0, 0]))
    assert exact.center.tolist() == camera.center.tolist()
    assert frame.c2w[0, 3] == 100 + exact.center[0].item()


def test_a_camera_that_covers_little_is_refused(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("gscompleter.apps.inputs.captures.MIN_FOUND_COVERED", 1.01)
    words = ("complete", folder / "splat.ply", "--out", tmp_path / "out", "--quiet")
    assert run(monkeypatch, *words) == 2
    assert "at least 101% are needed to trust it" in capsys.readouterr().err


@pytest.mark.slow
def test_what_a_mask_marks_goes_and_is_filled_and_strip_puts_it_back(folder, tmp_path, monkeypatch):
    write_refused(folder)
    write_cameras(tmp_path / "front.json", [make_camera(0.02)])
    out = tmp_path / "out"
    words = ("complete", folder / "splat.ply", "--target", tmp_path / "front.json")
    words = (*words, "--mask", folder / "mask.png", "--out", out, "--quiet")
    assert run(monkeypatch, *words) == 0
    summary = read_summary(out)
    assert summary["settings"]["mask"] == [str(folder / "mask.png")]
    assert summary["settings"]["config"]["holes"]["forces_removed"] is True
    assert summary["gaussians"]["removed"] > 50
    (target,) = summary["targets"]
    assert target["added"] > 50
    # The hole is what was marked, with its seam.
    assert 0.03 < target["hole_fraction"] < 0.12
    back = tmp_path / "back.ply"
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", back, "--quiet") == 0
    assert back.read_bytes() == (folder / "splat.ply").read_bytes()


@pytest.mark.parametrize(
    ("resolution", "side"), [(None, 640), (96, 96), ((48, 64), 48), ((64, 48), 48)]
)
def test_images_of_found_cameras_are_squares_in_the_size_that_was_asked_for(resolution, side):
    assert choose_side(resolution) == side

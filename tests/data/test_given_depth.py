"""Depth that scenes hold constrains their photographs: depth maps, sweeps, COLMAP's tracks."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from command import run
from exact_room import make_cameras, write_transforms
from gscompleter import GSCompleter, InputError
from gscompleter.apps.report.schema import read_summary
from gscompleter.data.formats import open_photographs
from gscompleter.data.given_depth import drop_edges, drop_hidden
from gscompleter.evaluation.metrics.geometry import compare_depths
from gscompleter.evaluation.metrics.image import compute_masked_psnr
from gscompleter.numerics.geometry import project
from gscompleter.system.files.image import write_image
from gscompleter.types import Camera
from measured_photographs import give_depths
from pose_files import CAMERAS, NAMES, write_colmap_binary, write_colmap_text, write_photographs
from scenes import Room, camera_at, photographed, view_of

STEP = torch.cat([torch.full((40, 32), 1.0), torch.full((40, 32), 2.0)], 1)


def with_depth(folder: Path, cameras: list[Camera]) -> Path:
    """Write photographs of the room with depth maps in millimetres; the far wall is unknown."""
    photographed(folder, cameras)
    content = json.loads((folder / "transforms.json").read_text())
    for number, (frame, camera) in enumerate(zip(content["frames"], cameras, strict=True)):
        depth = view_of(Room(), camera).depth
        values = (1000 * depth.where(depth < 4.9, 0)).round().numpy().astype(np.uint16)
        Image.fromarray(values).save(folder / f"{number}_depth.png")
        frame["depth_file_path"] = f"{number}_depth.png"
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def test_edges_of_a_depth_map_are_dropped_and_its_holes_stay_unknown():
    depth = STEP.clone()
    depth[5:8] = 0
    sure = drop_edges(depth)
    assert (sure[:, 31:33] == 0).all()
    assert torch.equal(sure[:, :30], depth[:, :30])
    assert torch.equal(sure[:, 34:], depth[:, 34:])


def test_a_laser_does_not_see_past_a_nearer_surface():
    sparse = torch.zeros(40, 64)
    sparse[::4, ::3] = STEP[::4, ::3]
    seen = drop_hidden(sparse)
    assert torch.equal(seen[:, :32], sparse[:, :32])
    assert (seen[:, 32] == 0).all()
    assert (seen[:, 36::3][::4] > 0).all()


def test_depth_maps_are_given_instead_of_scored(tmp_path):
    cameras = [camera_at(x, size=64) for x in (-0.2, 0.2)]
    photographs = open_photographs(with_depth(tmp_path / "room", cameras))
    (scored,), (given,) = photographs.views([1]), give_depths(photographs, [1])
    assert given.depth is None
    assert scored.given_depth is None
    known = given.given_depth > 0
    assert torch.equal(given.given_depth[known], scored.depth[known])
    assert 0.5 * (scored.depth > 0).sum() < known.sum() < (scored.depth > 0).sum()


@pytest.mark.parametrize("write", [write_colmap_binary, write_colmap_text])
def test_a_photograph_gets_the_points_of_its_own_tracks(tmp_path, write):
    write_photographs(tmp_path / "images")
    write(tmp_path / "sparse" / "0")
    photographs = open_photographs(tmp_path)
    first, last = give_depths(photographs, [0, len(NAMES) - 1])
    pixels, z = project(photographs.points(), CAMERAS[0])
    inside = ((pixels >= 0) & (pixels < first.camera.width)).all(-1) & (z > 0)
    at = pixels[inside].long()
    assert first.given_depth[at[:, 1], at[:, 0]] == pytest.approx(z[inside], rel=0.5)
    assert 100 < (first.given_depth > 0).sum() <= inside.sum()
    assert not last.given_depth.any()


def test_a_truncated_track_is_refused(tmp_path):
    write_photographs(tmp_path / "images")
    model = write_colmap_binary(tmp_path / "sparse" / "0")
    points = (model / "points3D.bin").read_bytes()
    (model / "points3D.bin").write_bytes(points[:-4])
    with pytest.raises(InputError, match="truncated"):
        give_depths(open_photographs(tmp_path), [0])


@pytest.mark.slow
def test_the_command_says_that_depth_was_given(tmp_path, monkeypatch):
    cameras = [camera_at(x, size=48) for x in (-0.2, 0.2, 0.5)]
    scene = with_depth(tmp_path / "room", cameras)
    out = tmp_path / "out"
    words = ["complete", scene, "--context", 0, 1, "--target", 2, "--out", out, "--quiet"]
    assert run(monkeypatch, *words) == 0
    assert min(row.given_depth for row in read_summary(out).context) > 0.3
    assert "measured or predicted depth" in (out / "report.html").read_text()


# The next test leaves the depth out, too.
@pytest.mark.slow
def test_the_command_leaves_given_depth_out_on_request(tmp_path, monkeypatch):
    scene = with_depth(tmp_path / "room", [camera_at(x, size=48) for x in (-0.2, 0.2, 0.5)])
    out = tmp_path / "out"
    words = ["complete", scene, "--context", 0, 1, "--target", 2, "--out", out, "--quiet"]
    assert run(monkeypatch, *words, "--no-given-depth") == 0
    assert [row.given_depth for row in read_summary(out).context] == [0, 0]
    assert "measured or predicted depth" not in (out / "report.html").read_text()


def test_one_photograph_of_a_folder_with_depth_is_completed(tmp_path, monkeypatch, capsys):
    scene = with_depth(tmp_path / "room", [camera_at(size=48), camera_at(0.3, size=48)])
    words = ["complete", scene, "--context", 0, "--target", 1, "--out", tmp_path / "out"]
    assert run(monkeypatch, *words) == 0
    (target,) = read_summary(tmp_path / "out").targets
    assert target.psnr_after > target.psnr_before + 2
    assert run(monkeypatch, *words, "--overwrite", "--no-given-depth") == 2
    assert "stereo needs at least 2; name more frames" in capsys.readouterr().err


@pytest.mark.slow
def test_exact_depth_gives_no_worse_picture_than_none(tmp_path):
    """Disocclusions beside the boxes were black with it (21.7 dB; without the depth 25.5)."""
    cameras = make_cameras(8)
    fields = []
    for number, camera in enumerate(cameras):
        name = f"{number}.png"
        Image.fromarray((1000 * camera.depth + 0.5).astype(np.uint16)).save(tmp_path / name)
        fields.append({"depth_file_path": name})
    photographs = open_photographs(write_transforms(tmp_path, cameras, frame_fields=fields))
    (target,) = photographs.views([5], (120, 160))
    given = give_depths(photographs, [1, 3], (120, 160))
    without = [replace(view, given_depth=None) for view in given]
    scores = []
    for views in (given, without):
        (result,) = GSCompleter()(views, target.camera).targets
        assert result.unfilled.share <= 0.005
        after = result.after.image
        scores.append(compute_masked_psnr(after, target.image, target.valid_mask))
    assert scores[0] > scores[1]


def test_an_image_without_a_camera_opens_upright_at_the_focal_length_of_exif(tmp_path):
    image = Image.fromarray(np.arange(60 * 80 * 3, dtype=np.uint8).reshape(60, 80, 3))
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 43
    image.save(tmp_path / "a.jpg", exif=exif)
    write_image(tmp_path / "plain.png", torch.zeros(60, 80, 3))
    turned, plain = (open_photographs(tmp_path / name) for name in ("a.jpg", "plain.png"))
    assert turned.format == plain.format == "photograph"
    camera = turned.views([0])[0].camera
    assert (camera.width, camera.height) == (60, 80)
    assert camera.K[0, 0].item() == pytest.approx(100 * 43 / 43.2666, rel=1e-4)
    assert torch.equal(camera.c2w, torch.eye(4))
    assert plain.camera(0).K[0, 0].item() == pytest.approx(100 * 26 / 43.2666, rel=1e-4)
    assert "of a phone, since EXIF has none" in plain.notes[0]
    (tmp_path / "plain.png").unlink()
    assert open_photographs(tmp_path).format == "photograph"


# The test before completes a photograph of a synthetic room.
@pytest.mark.slow
def test_one_photograph_of_a_real_room_is_completed(shared):
    folder = shared / "data" / "hololens_room"
    if not folder.is_dir():
        pytest.skip(f"needs {folder}")
    photographs = open_photographs(folder, near=0.5, far=10.0)
    (target,) = photographs.views([3], (96, 96))
    done = GSCompleter()(give_depths(photographs, [0], (96, 96)), target.camera)
    result, everywhere = done.targets[0], target.valid_mask
    assert compare_depths(result.after.depth, target.depth, ~result.hole_mask).abs_rel < 0.05
    before, after = (
        compute_masked_psnr(render.image, target.image, everywhere)
        for render in (result.before, result.after)
    )
    assert after > before + 0.3

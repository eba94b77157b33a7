"""Any painter: holes are exported, painted elsewhere, and come back into the scene."""

import json
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from command import run
from gscompleter import load_cameras, load_splat, load_views
from gscompleter.apps.commands.batch_rows import parse_batch_row
from gscompleter.apps.completing.path_video import FRAME_STEP, plan_path
from gscompleter.apps.inputs import paintings
from gscompleter.apps.inputs.holes_file import HoleRow, PathRow
from gscompleter.apps.inputs.paintings import add_exported_photograph, find_sources
from gscompleter.apps.inputs.task import Target
from gscompleter.apps.report.film import FRAMES_PER_SECOND, MIN_LEG_SECONDS
from gscompleter.data.formats import open_photographs
from gscompleter.data.photograph_names import name_target
from gscompleter.numerics.geometry import is_same_camera
from gscompleter.system.errors import InputError
from gscompleter.system.files.depth_file import read_depth, write_depth
from gscompleter.system.files.image import read_image, read_pixels
from gscompleter.system.files.reading import hash_file
from gscompleter.system.files.video import read_video, write_video
from scenes import Room, camera_at, cast, photographed, view_of

SIZE = 64
PLACES = ((-0.3, 0), (0.1, 0), (0.7, 12), (-0.9, -12))
TARGETS = (2, 3)
MAGENTA = (255, 0, 255)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    cameras = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in PLACES]
    return photographed(tmp_path_factory.mktemp("painters") / "room", cameras)


def words(scene: Path, out: Path, *more: object) -> list[object]:
    ends = ["--near", 0.5, "--far", 20, "--quiet", "--out", out]
    return ["complete", scene, *more, *ends]


@pytest.fixture(scope="module")
def exported(scene, tmp_path_factory) -> Path:
    """Return the holes of two targets."""
    home = tmp_path_factory.mktemp("exported")
    named = ("--context", 0, 1, "--target", *TARGETS, "--export-holes", home / "holes")
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert run(monkeypatch, *words(scene, home / "out", *named)) == 0
    assert not (home / "out").exists()
    return home / "holes"


@pytest.fixture
def holes(exported, tmp_path) -> Path:
    """Return a copy of the holes to paint."""
    return Path(shutil.copytree(exported, tmp_path / "holes"))


def paint(folder: Path, number: int, colors: np.ndarray | tuple, name: str = "") -> None:
    """Paint the mask of a target, with colours of each pixel or one of all."""
    pixels = read_pixels(folder / f"target{number}.png").copy()
    mask = read_pixels(folder / f"target{number}_mask.png")[..., 0] > 127
    pixels[mask] = np.broadcast_to(np.array(colors, np.uint8), pixels.shape)[mask]
    Image.fromarray(pixels).save(folder / (name or f"target{number}.png"))


def paint_truth(scene: Path, folder: Path, frames: tuple[int, ...] = TARGETS) -> None:
    for number, frame in enumerate(frames, start=1):
        (view,) = load_views(scene, frames=[frame])
        paint(folder, number, (view.image * 255).round().numpy())


def summary_of(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


def test_an_export_has_what_a_painter_needs(scene, exported):
    content = json.loads((exported / "holes.json").read_text())
    assert content["context"] == [0, 1]
    assert [entry["frame"] for entry in content["frames"]] == list(TARGETS)
    cameras = load_cameras(exported / "holes.json")
    for number, (entry, camera, frame) in enumerate(
        zip(content["frames"], cameras, TARGETS, strict=True), start=1
    ):
        truth, _ = cast(Room(), camera)
        assert is_same_camera(camera, load_views(scene, frames=[frame])[0].camera)
        assert entry["image_path"] == f"target{number}.png"
        mask = read_pixels(exported / entry["hole_mask_path"])[..., 0]
        assert set(np.unique(mask)) == {0, 255}
        painted = torch.from_numpy(mask > 127)
        assert entry["hole_fraction"] < painted.float().mean() < 0.6

        # Outside of the mask the image is the scene.
        for name in (entry["image_path"], entry["warped_path"]):
            error = (read_image(exported / name) - truth).abs().mean(dim=-1)
            assert error[~painted].median() < 0.05
        assert entry["reference_frame"] in (0, 1)
        (reference,) = load_views(scene, frames=[entry["reference_frame"]])
        shown = read_image(exported / entry["reference_path"])
        assert (shown - reference.image).abs().max() < 0.01

        unit = content["depth_unit_scale_factor"]
        depth = read_depth(exported / entry["depth_file_path"], unit)
        expected = view_of(Room(), camera).depth.numpy()
        known = ~painted.numpy()
        assert np.median(np.abs(depth / expected - 1)[known]) < 0.05
    field = np.load(exported / content["visible_field_path"])
    # The distance changes its sign at the surface in the middle of the first target.
    camera = cameras[0]
    for voxels, sign in ((-2, 1), (2, -1)):
        depth = float(view_of(Room(), camera).depth[32, 32]) + voxels * float(field["voxel_size"])
        point = (camera.center + depth * camera.c2w[:3, 2]).numpy()
        voxel = np.round((point - field["origin"]) / field["voxel_size"]).astype(int)
        assert np.sign(field["distance"][tuple(voxel)]) == sign
    listed = summary_of(exported)["files"]
    assert sorted(path.name for path in exported.iterdir()) == listed


# A repaired video, below, brings the truth as well.
@pytest.mark.slow
def test_truth_in_the_mask_gives_what_the_oracle_gives(scene, holes, tmp_path, monkeypatch):
    paint_truth(scene, holes)
    painted = ("--images", holes, "--painter", "Photoshop 2026")
    assert run(monkeypatch, *words(scene, tmp_path / "painted", *painted)) == 0
    true = ("--context", 0, 1, "--target", *TARGETS, "--generator", "oracle")
    assert run(monkeypatch, *words(scene, tmp_path / "oracle", *true)) == 0
    summary = summary_of(tmp_path / "painted")
    rows = summary["targets"]
    for row, other in zip(rows, summary_of(tmp_path / "oracle")["targets"], strict=True):
        assert row["frame"] == other["frame"]
        assert row["hole_fraction"] == pytest.approx(other["hole_fraction"], rel=0.02)
        assert row["psnr_after"] > row["psnr_before"] + 1
        assert row["psnr_after"] > other["psnr_after"] - 0.3
        assert row["painter"] == "Photoshop 2026"
        assert other["painter"] is None
    assert summary["settings"]["generator"] == "painted"
    assert summary["settings"]["generator_painter"] == "Photoshop 2026"
    assert summary["settings"]["images"] == str(holes)
    assert "Photoshop 2026" in (tmp_path / "painted" / "report.html").read_text()
    assert [row["frame"] for row in summary["context"]] == [0, 1]


# Tests below read PNG and WebP as well.
@pytest.mark.parametrize(
    "ending", ["jpg", *(pytest.param(e, marks=pytest.mark.slow) for e in ("png", "webp"))]
)
def test_a_painting_of_any_kind_and_size_ends_in_the_splat(
    scene, exported, tmp_path, monkeypatch, ending
):
    """Beside a name of its own, in another folder with --target, at three times the size."""
    folder = tmp_path / "painted"
    folder.mkdir()
    paint(exported, 1, MAGENTA, str(folder / "whole.png"))
    whole = Image.open(folder / "whole.png").resize((3 * SIZE, 3 * SIZE), Image.Resampling.NEAREST)
    whole.save(folder / f"target1.{ending}", quality=95)
    named = ("--context", 0, 1, "--target", TARGETS[0], "--images", folder)
    assert run(monkeypatch, *words(scene, tmp_path / "out", *named)) == 0
    scene_after = load_splat(tmp_path / "out" / "completed.ply")
    colors = 0.5 + 0.2820948 * scene_after.sh[scene_after.generated == 1, 0]
    assert len(colors) > 100
    assert (colors - torch.tensor([1.0, 0.0, 1.0])).abs().median() < 0.1
    (row,) = summary_of(tmp_path / "out")["targets"]
    assert row["painter"] == "an unnamed painter"


# The test before names one target of two.
@pytest.mark.slow
def test_targets_may_be_some_of_those_that_were_exported(scene, holes, tmp_path, monkeypatch):
    paint(holes, 2, MAGENTA, "target2.JPG")
    named = ("--target", TARGETS[1], "--images", holes)
    assert run(monkeypatch, *words(scene, tmp_path / "out", *named)) == 0
    (row,) = summary_of(tmp_path / "out")["targets"]
    assert row["frame"] == TARGETS[1]
    assert row["added"] > 0


# `test_a_painting_of_any_kind_and_size_ends_in_the_splat` has a painting in another folder.
@pytest.mark.slow
def test_a_layer_in_another_folder_needs_the_cameras_alone(scene, holes, tmp_path, monkeypatch):
    """The painting is transparent outside of the mask, and no other file of the export is there."""
    folder = tmp_path / "layers"
    folder.mkdir()
    shutil.copy(holes / "holes.json", folder)
    for number in (1, 2):
        mask = read_pixels(holes / f"target{number}_mask.png")[..., 0]
        layer = np.zeros((SIZE, SIZE, 4), np.uint8)
        layer[..., [0, 2]] = 255
        layer[..., 3] = mask
        Image.fromarray(layer).save(folder / f"target{number}.png")
    assert run(monkeypatch, *words(scene, tmp_path / "out", "--images", folder)) == 0
    for row in summary_of(tmp_path / "out")["targets"]:
        assert row["added"] > 0
        assert not any("hole open" in note for note in row["notes"])
    # Thin parts of the second hole were closed beside the first target, in the colours around them.
    first, _ = summary_of(tmp_path / "out")["targets"]
    assert not any("Outside of its mask" in note for note in first["notes"])


def refused(monkeypatch, capsys, *arguments: object) -> str:
    """Run a command that is refused, and return its sentence."""
    assert run(monkeypatch, *arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert len(lines[0]) <= 300
    return lines[0]


def test_an_image_that_is_not_painted_is_refused(scene, holes, tmp_path, monkeypatch, capsys):
    paint(holes, 1, MAGENTA)
    sentence = refused(monkeypatch, capsys, *words(scene, tmp_path / "out", "--images", holes))
    assert "target2.png is as it was exported" in sentence
    (holes / "target2.png").unlink()
    sentence = refused(monkeypatch, capsys, *words(scene, tmp_path / "out", "--images", holes))
    assert "has no target2.png (or .jpg, .webp)" in sentence
    assert not (tmp_path / "out").exists()


def test_wrong_images_are_refused(scene, holes, tmp_path, monkeypatch, capsys):
    paint_truth(scene, holes)
    command = words(scene, tmp_path / "out", "--images", holes)
    whole = (holes / "target1.png").read_bytes()

    (holes / "target1.png").write_bytes(whole[:200])
    assert "is not an image that can be read" in refused(monkeypatch, capsys, *command)

    Image.open(holes / "target2.png").crop((0, 0, SIZE, SIZE - 4)).save(holes / "target1.png")
    assert f"target1.png has {SIZE} x {SIZE - 4} pixels, and its target {SIZE} x" in refused(
        monkeypatch, capsys, *command
    )

    (holes / "target1.png").write_bytes(whole)
    paint(holes, 1, MAGENTA, "target1.webp")
    assert "several images of one target (target1.png, target1.webp)" in refused(
        monkeypatch, capsys, *command
    )
    (holes / "target1.webp").unlink()

    other = view_of(Room(), camera_at(-0.5, yaw=-20, size=SIZE)).image
    Image.fromarray((other * 255).byte().numpy()).save(holes / "target1.png")
    sentence = refused(monkeypatch, capsys, *command)
    assert "target1.png does not show what its camera sees of the scene" in sentence
    assert not (tmp_path / "out").exists()


def test_a_camera_that_was_not_exported_is_refused(scene, holes, tmp_path, monkeypatch, capsys):
    paint_truth(scene, holes)
    command = words(scene, tmp_path / "out", "--target", 0, "--images", holes)
    assert "has no image for the camera of target 1" in refused(monkeypatch, capsys, *command)


@pytest.mark.parametrize(
    ("damage", "part"),
    [
        ("{", "is not JSON"),
        ('{"version": "1", "context": [0], "frames": []}', "lists no frames"),
        ('{"version": "1", "frames": []}', "context"),
        ({"image_path": "../target1.png"}, "only files beside it are read"),
        ({"path_frame": 3}, "names frame 3 of a video with 0"),
        ({"w": "wide"}, "frames.0.w"),
        ({"transform_matrix": [1, 2]}, "transform_matrix"),
    ],
)
def test_a_damaged_holes_file_is_refused(scene, holes, tmp_path, monkeypatch, capsys, damage, part):
    if isinstance(damage, dict):
        paint_truth(scene, holes)
        content = json.loads((holes / "holes.json").read_text())
        content["frames"][0] |= damage
        damage = json.dumps(content)
    (holes / "holes.json").write_text(damage)
    command = words(scene, tmp_path / "out", "--images", holes)
    assert part in refused(monkeypatch, capsys, *command)


@pytest.mark.parametrize(
    ("more", "part"),
    [
        (["--painter", "me"], "names who painted"),
        (["--generator", "painted"], "needs painted images"),
        (["--images", "NOWHERE"], "There is no folder"),
        (["--images", "EMPTY"], "has no holes.json, which tells the cameras"),
        (["--images", "EMPTY", "--target", 2], "has no target1.png"),
        (["--images", "EMPTY", "--export-holes", "NEW"], "both given"),
        (["--images", "EMPTY", "--auto", 2], "leave --auto"),
        (["--images", "EMPTY", "--generator", "oracle"], "takes the place of a generator"),
        (["--images", "EMPTY", "--generator-steps", 3], "takes the place of a generator"),
        (["--path"], "is a video of what --export-holes writes"),
        (["--export-holes", "NEW", "--dry-run"], "completes nothing"),
        (["--export-holes", "NEW", "--video"], "completes nothing"),
        (["--export-holes", "NEW", "--save-as", ".spz"], "completes nothing"),
        (["--export-holes", "NEW", "--generator", "oracle"], "generates nothing"),
        (["--export-holes", "NEW", "--generator-retries", 2], "generates nothing"),
        (["--export-holes", "OUT"], "have to lie apart from each other"),
        (["--export-holes", "OUT/holes"], "have to lie apart from each other"),
        (["--export-holes", "SCENE"], "is the input"),
        (["--export-holes", "NEW", "--target", 0, "--context", 0, 1], "There is nothing to paint"),
    ],
)
def test_options_that_exclude_each_other_are_refused(
    scene, tmp_path, monkeypatch, capsys, more, part
):
    (tmp_path / "EMPTY").mkdir()
    monkeypatch.chdir(tmp_path)
    more = [scene if word == "SCENE" else word for word in more]
    assert part in refused(monkeypatch, capsys, *words(scene, "OUT", *more))
    assert not (tmp_path / "NEW").exists()


@pytest.mark.slow
def test_what_was_painted_is_not_exported_over(scene, holes, tmp_path, monkeypatch, capsys):
    named = ("--target", TARGETS[0], "--export-holes", holes)
    command = words(scene, tmp_path / "out", *named, "--overwrite")
    # Beside the exported image, as that of the new target 2 it would be in the wrong place.
    paint(holes, 2, MAGENTA, "target2.webp")
    assert "target2.webp was painted" in refused(monkeypatch, capsys, *command)
    (holes / "target2.webp").unlink()
    paint(holes, 2, MAGENTA)
    assert "target2.png was painted" in refused(monkeypatch, capsys, *command)
    (holes / "target2.png").unlink()
    assert run(monkeypatch, *command) == 0
    assert not (holes / "target2_mask.png").exists()


def test_a_surface_near_the_camera_stays_known_before_a_far_one(tmp_path):
    """The farthest depth decides the unit, of which the nearest may be less than half of one."""
    write_depth(tmp_path / "depth.png", torch.tensor([[0.0, 0.1, 1e5]]), 1e5 / 65535)
    assert (read_depth(tmp_path / "depth.png", 1.0) > 0).tolist() == [[False, True, True]]


def test_a_camera_keeps_the_photograph_that_it_was_derived_from(scene):
    """Photographs that were added since the export give others this number."""
    photographs = open_photographs(scene)
    target = Target(camera_at(0.9, size=SIZE))
    file = photographs.frame(1).file_name
    row = HoleRow("a.png", "", "b.png", SIZE, SIZE, 0.1, derived_from=1, offset="turned left by 3°")
    for name, base in ((file, 1), ("other.png", None)):
        title = name_target(None, name, 1, row.offset)
        found = add_exported_photograph(target, replace(row, title=title), photographs, None)
        assert found.derived_from == base
        assert (found.offset is None) == (base is None)


def test_a_photograph_without_a_camera_is_not_that_of_a_target(scene):
    """It took the number of the photograph that the target was at the export."""
    photographs = open_photographs(scene)
    target = Target(photographs.camera(1))
    row = HoleRow("a.png", "", "b.png", SIZE, SIZE, 0.1, frame=1)
    assert add_exported_photograph(target, row, photographs, None).frame == 1
    frames = list(photographs.frames)
    frames[1] = replace(frames[1], lack="COLMAP found no camera for it")
    photographs = replace(photographs, frames=tuple(frames))
    assert add_exported_photograph(target, row, photographs, None) is target


def test_of_several_repaired_videos_none_is_taken(tmp_path):
    path = PathRow("path.mp4", "", 5)
    row = HoleRow("target1.png", "", "b.png", SIZE, SIZE, 0.1, path_frame=2)
    (tmp_path / "path.mov").write_bytes(b"one")
    assert find_sources(tmp_path, [row], path) == [tmp_path / "path.mov"]
    (tmp_path / "path.mkv").write_bytes(b"another")
    with pytest.raises(InputError, match=r"several repaired videos \(path\.mkv, path\.mov\)"):
        find_sources(tmp_path, [row], path)


def test_the_video_of_many_targets_is_hashed_once(tmp_path, monkeypatch):
    hashed = []

    def hash_and_note(path):
        hashed.append(path.name)
        return hash_file(path)

    monkeypatch.setattr(paintings, "hash_file", hash_and_note)
    rows = [
        HoleRow(f"target{number}.png", "", "b.png", SIZE, SIZE, 0.1, path_frame=number)
        for number in range(3)
    ]
    (tmp_path / "path.mov").write_bytes(b"repaired")
    (tmp_path / "target1.png").write_bytes(b"painted")
    sources = find_sources(tmp_path, rows, PathRow("path.mp4", "", 5))
    assert [source.name for source in sources] == ["path.mov", "target1.png", "path.mov"]
    assert hashed.count("path.mov") == 1


def test_a_batch_exports_no_holes(tmp_path):
    with pytest.raises(InputError, match="A batch completes scenes and exports no holes"):
        parse_batch_row({"folder": "SCENE", "export_holes": "HOLES"}, tmp_path)


@pytest.mark.slow
def test_targets_of_an_export_are_found(scene, tmp_path, monkeypatch, capsys):
    """Without --target the planner chooses cameras, of which the second command knows where."""
    named = ("--context", 0, 1, "--auto", 1, "--export-holes", tmp_path / "holes")
    command = [word for word in words(scene, tmp_path / "out", *named) if word != "--quiet"]
    assert run(monkeypatch, *command) == 0
    printed = capsys.readouterr().out
    assert "Nothing was completed" in printed
    assert f"--images {tmp_path / 'holes'} --painter NAME in place of" in " ".join(printed.split())
    assert "--export-holes and --auto." in printed
    paint(tmp_path / "holes", 1, MAGENTA)
    images = ("--images", tmp_path / "holes")
    assert run(monkeypatch, *words(scene, tmp_path / "out", *images)) == 0
    (row,) = summary_of(tmp_path / "out")["targets"]
    assert row["derived_from"] is not None
    assert row["offset"]
    assert row["added"] > 0


def repair(scene: Path, holes: Path, name: str, side: int, drop: int = 0) -> None:
    """Paint the truth into the frames of the targets, as a model that repairs the video."""
    content = json.loads((holes / "holes.json").read_text())
    frames = [frame.copy() for frame in read_video(holes / "path.mp4", "null", is_grey=False)]
    masks = [frame > 127 for frame in read_video(holes / "path_mask.mp4", "null", is_grey=False)]
    for entry in content["frames"]:
        (view,) = load_views(scene, frames=[entry["frame"]])
        number = entry["path_frame"]
        truth = (view.image * 255).round().byte().numpy()
        frames[number] = np.where(masks[number], truth, frames[number])
    images = [Image.fromarray(frame).resize((side, side)) for frame in frames]
    kept = [np.asarray(image) for image in images[: len(images) - drop]]
    write_video(holes / name, kept, rate=16)


@pytest.fixture(scope="module")
def filmed(scene, tmp_path_factory) -> Path:
    """Return the holes of two targets with a video."""
    pytest.importorskip("imageio_ffmpeg", reason="needs gscompleter[film]")
    home = tmp_path_factory.mktemp("filmed")
    named = ("--context", 0, 1, "--target", *TARGETS, "--export-holes", home / "holes", "--path")
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert run(monkeypatch, *words(scene, home / "out", *named)) == 0
    return home / "holes"


@pytest.mark.slow
def test_a_video_passes_the_targets(filmed):
    content = json.loads((filmed / "holes.json").read_text())
    path = content["path"]
    # At a target the video has the mask of the target.
    masks = list(read_video(filmed / path["hole_mask_path"], "null", is_grey=False))
    for entry in content["frames"]:
        own = np.asarray(Image.open(filmed / entry["hole_mask_path"]).convert("L")) > 127
        shown = masks[entry["path_frame"]][..., 0] > 127
        assert (own != shown).mean() < 0.01
    frames = list(read_video(filmed / path["video_path"], "null", is_grey=False))
    masks = list(read_video(filmed / path["hole_mask_path"], "null", is_grey=False))
    assert len(frames) == len(masks) == len(path["cameras"]) == path["num_frames"]
    assert path["num_frames"] % 4 == 1
    for entry in content["frames"]:
        number = entry["path_frame"]
        assert path["cameras"][number]["transform_matrix"] == [
            pytest.approx(row, abs=1e-5) for row in entry["transform_matrix"]
        ]
        image = read_pixels(filmed / entry["image_path"]).astype(int)
        # The colours of a video have half the resolution.
        errors = [np.abs(frame.astype(int) - image).mean() for frame in frames]
        assert errors[number] < 0.3 * max(errors)
        mask = read_pixels(filmed / entry["hole_mask_path"])[..., 0] > 127
        assert ((masks[number][..., 0] > 127) == mask).mean() > 0.98
    listed = summary_of(filmed)["files"]
    assert sorted(file.name for file in filmed.iterdir()) == listed


@pytest.mark.slow
def test_a_repaired_video_completes_the_targets(scene, filmed, tmp_path, monkeypatch, capsys):
    """It has another size and rate; a painted image of a target counts more."""
    holes = Path(shutil.copytree(filmed, tmp_path / "holes"))
    repair(scene, holes, "path.mov", side=3 * SIZE)
    images = ("--images", holes, "--painter", "a video model")
    paint(holes, 1, MAGENTA, "target1.webp")
    assert run(monkeypatch, *words(scene, tmp_path / "out", *images)) == 0
    first, second = summary_of(tmp_path / "out")["targets"]
    assert first["psnr_after"] < first["psnr_before"] + 1
    assert second["psnr_after"] > second["psnr_before"] + 3
    assert second["painter"] == "a video model"

    (holes / "path.mov").unlink()
    repair(scene, holes, "path.mp4", side=SIZE, drop=1)
    command = words(scene, tmp_path / "again", *images)
    assert "and 73 were exported; keep all of them" in refused(monkeypatch, capsys, *command)


def test_targets_of_another_lens_are_not_in_the_video():
    wide, narrow = camera_at(0.5, size=SIZE), camera_at(0.7, size=SIZE, focal=1.2)
    odd = camera_at(0.5, size=SIZE - 1)
    context = [camera_at(0.0, size=SIZE)]
    planned = plan_path(context, [odd, narrow, odd], [])
    frames = [frame for frame in planned.target_frames if frame is not None]
    assert planned.target_frames[1] is None
    assert len(frames) == 2
    assert frames[-1] == len(planned.cameras) - 1
    assert {(camera.width, camera.height) for camera in planned.cameras} == {(SIZE, SIZE)}
    assert plan_path(context, [wide], []).cameras[-1].K.allclose(wide.K)


def test_no_leg_to_a_target_is_shorter_than_a_film_allows():
    targets = [camera_at(0.1 * number, size=SIZE) for number in range(1, 8)]
    stops = (0, *plan_path([camera_at(size=SIZE)], targets, []).target_frames)
    legs = {after - before for before, after in pairwise(stops)}
    (leg,) = legs
    assert leg >= FRAMES_PER_SECOND * MIN_LEG_SECONDS
    assert leg % FRAME_STEP == 0

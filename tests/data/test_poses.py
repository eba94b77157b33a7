"""Camera poses for photographs without any."""

import json
import os
import shutil
import string
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from command import run
from gscompleter.apps.inputs.opening import open_scene
from gscompleter.apps.inputs.removal import find_masks_of
from gscompleter.apps.inputs.task import Opened
from gscompleter.apps.requests.scene import PosesRequest, SceneRequest
from gscompleter.data.formats import open_photographs
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.sfm import poses
from gscompleter.data.sfm.poses import (
    MAX_COPY_SIDE,
    find_poses,
    list_photograph_files,
    make_sort_key,
    write_upright,
)
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import write_image
from mapping_stand_in import model_script, similarity_removed, stand_in
from pose_files import write_colmap_text
from scenes import Room, camera_at, view_of

CAMERAS = [
    camera_at(x=0.3 * i - 1.05, y=0.1 * (i % 3), z=0.05 * i, yaw=14 - 4 * i, size=160)
    for i in range(8)
]
ORIENTATION, FOCAL_35 = 0x0112, 0xA405


def photographs(folder: Path) -> Path:
    """Write eight photographs of the room, numbered from 5, so that 10.png is not second."""
    folder.mkdir()
    for number, camera in enumerate(CAMERAS, start=5):
        write_image(folder / f"{number}.png", view_of(Room(), camera).image)
    return folder


def blank(folder: Path, count: int) -> Path:
    """Write photographs without content."""
    folder.mkdir()
    for number in range(count):
        Image.new("RGB", (64, 48), "grey").save(folder / f"{number}.png")
    return folder


@pytest.mark.slow
def test_the_cameras_of_a_room_are_found_up_to_a_similarity(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    given, out = photographs(tmp_path / "room"), tmp_path / "poses"
    assert run(monkeypatch, "poses", given, "--out", out) == 0
    assert capsys.readouterr().out.startswith("8 of 8 cameras and ")
    assert {path.name for path in out.iterdir()} == {"images", "sparse", "summary.json"}

    opened = open_photographs(out)
    order = [int(frame.name.removesuffix(".png")) - 5 for frame in opened.frames]
    found = np.stack([opened.camera(i).center.numpy() for i in range(len(opened))])
    true = np.stack([CAMERAS[i].center.numpy() for i in order])
    off = np.linalg.norm(similarity_removed(found, true) - true, axis=1)
    assert off.max() < 0.02  # of an extent of 2.1
    focal = float(opened.camera(0).K[0, 0])
    assert focal == pytest.approx(float(CAMERAS[0].K[0, 0]), rel=0.03)


def test_a_jpeg_with_further_pictures_keeps_its_name(tmp_path):
    image = Image.new("RGB", (64, 48), "grey")
    image.save(tmp_path / "IMG_1.jpg", format="MPO", save_all=True, append_images=[image])
    with Image.open(tmp_path / "IMG_1.jpg") as opened:
        assert opened.format == "MPO"
    (tmp_path / "out").mkdir()
    copy = write_upright(tmp_path, "IMG_1.jpg", tmp_path / "out")
    assert copy.name == "IMG_1.jpg"
    with Image.open(tmp_path / "out" / "images" / "IMG_1.jpg") as written:
        assert written.size == (64, 48)


def test_photographs_that_are_not_placed_keep_the_numbers_of_the_others(tmp_path, monkeypatch):
    given, out = blank(tmp_path / "photos", 4), tmp_path / "poses"
    stand_in(monkeypatch, tmp_path, model_script(["0.png", "2.png", "3.png"]))
    find_poses(given, out)
    write_colmap_text(out / "sparse" / "0", ["0.png", "2.png", "3.png"])
    photographs = open_photographs(out)
    assert [frame.file_name for frame in photographs.frames] == list_photograph_files(given)
    assert photographs.posed == [0, 2, 3]
    assert photographs.frame(2).has_photograph()
    with pytest.raises(InputError, match=r"1\.png.*COLMAP found no camera for it; name another"):
        photographs.views(["1.png"])


def test_the_next_run_keeps_what_was_found(tmp_path, monkeypatch):
    given, out = blank(tmp_path / "photos", 4), tmp_path / "poses"
    stand_in(monkeypatch, tmp_path, model_script(["0.png", "2.png", "3.png"]))
    first = find_poses(given, out)
    stand_in(monkeypatch, tmp_path, "raise SystemExit('asked again')")
    again = find_poses(given, out)
    assert again.reused
    assert again.missing == first.missing == ["1.png"]

    os.utime(given / "0.png", ns=(1, 1))
    with pytest.raises(InputError, match="asked again"):
        find_poses(given, out, overwrite=True)
    assert find_poses_summary(out)["poses"]["missing"] == ["1.png"]  # what was there survives


def test_masks_of_the_user_are_not_taken_for_those_of_an_earlier_run(tmp_path, monkeypatch):
    given, out = blank(tmp_path / "photos", 4), tmp_path / "poses"
    stand_in(monkeypatch, tmp_path, model_script(["0.png", "2.png", "3.png"]))
    (out / "masks").mkdir(parents=True)
    (out / "masks" / "0.png.png").write_bytes(b"mine")
    with pytest.raises(InputError, match=r"masks/0\.png\.png"):
        find_poses(given, out, overwrite=True)
    assert (out / "masks" / "0.png.png").read_bytes() == b"mine"


def test_masks_of_what_is_removed_hide_nothing_where_cameras_are_searched_for(
    tmp_path, monkeypatch
):
    """They lie where masks of what to ignore are looked for, and show little in white."""
    given, out = blank(tmp_path / "photos", 4), tmp_path / "out"
    stand_in(monkeypatch, tmp_path, model_script([f"{number}.png" for number in range(4)]))
    goes = given / "masks"
    goes.mkdir()
    for number in range(4):
        with Image.open(given / f"{number}.png") as photograph:
            mask = Image.new("L", photograph.size)
        mask.putpixel((2, 1), 255)
        mask.save(goes / f"{number}.png")
    with pytest.raises(InputError, match="Masks hide .* of the photographs"):
        find_poses(given, out / "colmap")

    find_poses(given, out / "colmap", reading=MaskReading(left_out=goes))
    write_colmap_text(out / "colmap" / "sparse" / "0", [f"{number}.png" for number in range(4)])
    request = SceneRequest(given, removal_masks=goes)
    opened = open_scene(request, PosesRequest(out), Console(quiet=True))
    assert opened.photographs.list_masks() == []
    assert not list((out / "colmap").glob("masks/*"))


def test_masks_of_what_is_removed_that_lie_among_the_photographs_are_no_photographs(tmp_path):
    given = blank(tmp_path / "photos", 4)
    goes = blank(given / "goes", 4)
    request = SceneRequest(given, removal_masks=goes)
    with pytest.raises(InputError, match="goes lies among the photographs, .* move it") as told:
        open_scene(request, PosesRequest(tmp_path / "out"), Console(quiet=True))
    assert told.value.argument == "mask"


def test_masks_of_what_to_ignore_may_lie_beside_photographs_without_cameras(tmp_path, monkeypatch):
    """The search takes them for no photographs, so that nothing has to be moved."""
    given = blank(tmp_path / "photos", 4)
    mask = Image.new("L", (64, 48))
    mask.putpixel((2, 1), 255)
    for number in range(4):
        mask.save(given / f"{number}_mask.png")
    names = [f"{number}.png" for number in range(4)]
    stand_in(monkeypatch, tmp_path, model_script(names))
    request = SceneRequest(given, masks=MaskReading(folder=given))
    # What COLMAP would have found is put where the search keeps it.
    find_poses(given, tmp_path / "out" / "colmap", reading=request.search_masks)
    write_colmap_text(tmp_path / "out" / "colmap" / "sparse" / "0", names)
    opened = open_scene(request, PosesRequest(tmp_path / "out"), Console(quiet=True))
    assert [path.name for path in opened.photographs.list_masks()] == [f"{n}.png" for n in names]


def test_masks_of_what_to_ignore_may_lie_below_those_of_what_is_removed(tmp_path, monkeypatch):
    given, out = blank(tmp_path / "photos", 4), tmp_path / "out"
    ignored = given / "masks"
    ignored.mkdir()
    mask = Image.new("L", (64, 48))
    mask.putpixel((2, 1), 255)
    for number in range(4):
        mask.save(given / f"{number}_mask.png")
        mask.save(ignored / f"{number}.png")
    stand_in(monkeypatch, tmp_path, model_script([f"{number}.png" for number in range(4)]))
    request = SceneRequest(given, masks=MaskReading(folder=ignored), removal_masks=given)
    assert find_poses(given, out, reading=request.search_masks).masked == 4


def test_photographs_are_no_masks_of_what_to_ignore(tmp_path):
    """Their own folder without any mask holds what the search takes for photographs."""
    given = blank(tmp_path / "photos", 4)
    request = SceneRequest(given, masks=MaskReading(folder=given))
    with pytest.raises(InputError, match="photos lies among the photographs") as told:
        open_scene(request, PosesRequest(tmp_path / "out"), Console(quiet=True))
    assert told.value.argument == "ignore"


def search_and_open(request: SceneRequest, out: Path, names: list[str]) -> Opened:
    """Search for the cameras of copies with `names`, and open the photographs with them."""
    find_poses(request.folder, out / "colmap", reading=request.search_masks)
    write_colmap_text(out / "colmap" / "sparse" / "0", names)
    return open_scene(request, PosesRequest(out), Console(quiet=True))


def test_masks_of_what_is_removed_may_lie_beside_their_photographs(tmp_path, monkeypatch):
    """The copies for COLMAP are called as the photographs are, which are no masks of them."""
    given, out = blank(tmp_path / "photos", 4), tmp_path / "out"
    names = [f"{number}.png" for number in range(4)]
    stand_in(monkeypatch, tmp_path, model_script(names))
    mask = Image.new("L", (64, 48))
    mask.putpixel((2, 1), 255)
    for number in range(4):
        mask.save(given / f"{number}_mask.png")
    request = SceneRequest(given, removal_masks=given)
    opened = search_and_open(request, out, names)
    found = find_masks_of(opened.photographs, given)
    assert found == {number: given / f"{number}_mask.png" for number in range(4)}


def test_a_copy_in_another_format_is_known_by_the_name_of_its_photograph(tmp_path, monkeypatch):
    """COLMAP may not read WebP: its copy has the ending of a PNG behind the other one."""
    given, out = tmp_path / "photos", tmp_path / "out"
    goes = blank(tmp_path / "goes", 0)
    given.mkdir()
    mask = Image.new("L", (64, 48))
    mask.putpixel((2, 1), 255)
    for number in range(4):
        Image.new("RGB", (64, 48), "grey").save(given / f"{number}a.webp")
        mask.save(goes / f"{number}a.png")
    copies = [f"{number}a.webp.png" for number in range(4)]
    stand_in(monkeypatch, tmp_path, model_script(copies))
    request = SceneRequest(given, removal_masks=goes)
    opened = search_and_open(request, out, copies)
    found = find_masks_of(opened.photographs, goes)
    assert found == {number: goes / f"{number}a.png" for number in range(4)}
    for word in ("2a", "2a.webp", "2a.webp.png"):
        assert opened.photographs.find_frame(word) == 2


def test_masks_and_alpha_that_are_not_used_hide_nothing_where_cameras_are_searched_for(
    tmp_path, monkeypatch
):
    """`--no-masks` is the advice for masks that hide everything: then no feature would be left."""
    given, out = blank(tmp_path / "photos", 4), tmp_path / "out"
    stand_in(monkeypatch, tmp_path, model_script([f"{number}.png" for number in range(4)]))
    (given / "masks").mkdir()
    for number in range(3):
        with Image.open(given / f"{number}.png") as photograph:
            Image.new("L", photograph.size).save(given / "masks" / f"{number}.png")
    with Image.open(given / "3.png") as photograph:
        transparent = photograph.convert("RGBA")
    transparent.putpixel((2, 1), (0, 0, 0, 0))
    transparent.save(given / "3.png")
    reading = SceneRequest(given, uses_masks=False).search_masks
    found = find_poses(given, out, reading=reading)
    assert found.masked == 0
    assert not list(out.glob("masks/*"))
    assert find_poses(given, out, reading=reading).reused
    # With masks, another search is due.
    found = find_poses(given, out, overwrite=True, reading=MaskReading(may_be_large=True))
    assert (found.masked, found.reused) == (4, False)


def find_poses_summary(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


def test_photographs_without_a_camera_are_named(tmp_path, monkeypatch, capsys):
    stand_in(monkeypatch, tmp_path, model_script(["0.png", "2.png", "3.png"]))
    assert run(monkeypatch, "poses", blank(tmp_path / "p", 4), "--out", tmp_path / "out") == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == (
        "No camera was found for 1.png; they are not used, and the others keep their numbers."
    )
    assert said[1].startswith("3 of 4 cameras and 90 points, mean error 0.50 px: ")


def test_learned_features_are_told_and_what_matches_contradict_is_named(tmp_path, monkeypatch):
    script = model_script(["0.png", "2.png", "3.png"], features="XFeat", contradicted=("1.png",))
    stand_in(monkeypatch, tmp_path, script)
    first, second, third = find_poses(blank(tmp_path / "p", 4), tmp_path / "out").notes
    assert first == "SIFT placed too few photographs; the learned features XFeat placed 3 of 4."
    assert second == "XFeat put 1.png where matches that were kept back do not agree."
    assert third.startswith("No camera was found for 1.png; ")
    # As it is read from the summary.
    assert find_poses(tmp_path / "p", tmp_path / "out").notes == [first, second, third]


@pytest.mark.parametrize("command", ["poses", "complete"])
def test_where_too_few_are_placed_the_missing_extra_is_named(
    tmp_path, monkeypatch, capsys, command
):
    stand_in(monkeypatch, tmp_path, model_script(["0.png"], lacks_learned=True))
    given, out = blank(tmp_path / "p", 4), tmp_path / "out"
    assert run(monkeypatch, command, given, "--out", out, "--quiet") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "placed 1 of 4 photographs" in said
    assert "pip install 'gscompleter[features]' adds features that match farther apart." in said


def test_few_placed_photographs_are_searched_again_once_the_extra_is_there(tmp_path, monkeypatch):
    given, out = blank(tmp_path / "p", 8), tmp_path / "out"
    stand_in(monkeypatch, tmp_path, model_script(["0.png", "2.png", "3.png"], lacks_learned=True))
    monkeypatch.setattr(poses, "has_learned_features", lambda: False)
    (note,) = find_poses(given, out).notes
    assert note.endswith(
        "; pip install 'gscompleter[features]' adds features that match farther apart."
    )
    assert find_poses(given, out).reused
    stand_in(monkeypatch, tmp_path, "raise SystemExit('asked again')")
    monkeypatch.setattr(poses, "has_learned_features", lambda: True)
    with pytest.raises(InputError, match="asked again"):
        find_poses(given, out, overwrite=True)


@pytest.mark.parametrize(
    ("count", "points", "plausible", "told"),
    [
        (3, 1, True, "placed 3 of 4 photographs"),
        (2, 90, True, "placed 2 of 4 photographs"),
        (4, 90, False, "90 points and an implausible lens, which"),
    ],
)
@pytest.mark.parametrize("command", ["poses", "complete"])
def test_a_failed_reconstruction_is_refused(
    tmp_path, monkeypatch, capsys, count, points, plausible, told, command
):
    found = [f"{number}.png" for number in range(count)]
    stand_in(monkeypatch, tmp_path, model_script(found, points, plausible))
    given, out = blank(tmp_path / "p", 4), tmp_path / "out"
    assert run(monkeypatch, command, given, "--out", out, "--quiet") == 2
    said = capsys.readouterr().err
    assert told in said
    assert "add sharp photographs" in said
    assert len(said) < 300
    assert not out.exists()


def test_a_part_of_many_photographs_is_refused_where_it_is_small(tmp_path, monkeypatch):
    stand_in(monkeypatch, tmp_path, model_script(["0.png", "1.png", "2.png"]))
    with pytest.raises(InputError, match="placed 3 of 13 photographs"):
        find_poses(blank(tmp_path / "p", 13), tmp_path / "out")


def test_a_focal_length_that_was_held_is_told(tmp_path, monkeypatch):
    found = [f"{number}.png" for number in range(4)]
    stand_in(monkeypatch, tmp_path, model_script(found, focal=344.2))
    (note,) = find_poses(blank(tmp_path / "p", 4), tmp_path / "out").notes
    assert "4 of 4 cameras" in note
    assert "344 px" in note


@pytest.mark.slow
def test_a_drive_is_placed_with_its_focal_length_held(shared, tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    given = tmp_path / "drive"
    given.mkdir()
    for source in list_photographs(shared, "kitti_city", 30)[20:]:
        shutil.copy(source, given)
    found = find_poses(given, tmp_path / "out")
    assert found.num_registered == 10
    assert found.points > 300
    focal = float(open_photographs(tmp_path / "out").camera(0).K[0, 0])
    true = float(open_photographs(shared / "data" / "kitti_city").camera(0).K[0, 0])
    assert 0.5 < focal / true < 2
    assert found.focal == pytest.approx(focal, rel=0.02)


def test_photographs_of_nothing_have_no_cameras(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    out = tmp_path / "out"
    assert run(monkeypatch, "poses", blank(tmp_path / "p", 3), "--out", out, "--quiet") == 2
    assert "COLMAP placed 0 of 3 photographs" in capsys.readouterr().err
    assert not out.exists()


def test_a_process_that_aborts_is_a_sentence_and_leaves_nothing(tmp_path, monkeypatch):
    abort = """
import os, sys
print("Check failed: x > 0", file=sys.stderr, flush=True)
os.abort()
"""
    stand_in(monkeypatch, tmp_path, abort)
    with pytest.raises(InputError, match=r"gave up \(Check failed: x > 0\);"):
        find_poses(blank(tmp_path / "p", 3), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_two_photographs_are_too_few(tmp_path):
    with pytest.raises(InputError, match="There are 2 photographs"):
        find_poses(blank(tmp_path / "p", 2), tmp_path / "out")


def test_a_folder_of_other_files_has_no_photographs(tmp_path):
    (tmp_path / "notes.txt").write_text("no photograph")
    with pytest.raises(InputError, match="There are 0 photographs"):
        list_photograph_files(tmp_path)


def test_neighbours_are_those_of_the_numbers_however_they_are_written(tmp_path):
    folder = blank(tmp_path / "p", 12)
    assert list_photograph_files(folder) == [f"{number}.png" for number in range(12)]


def test_a_file_that_is_no_image_is_named(tmp_path):
    folder = blank(tmp_path / "p", 3)
    (folder / "1.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="1.png is not an image that can be read"):
        find_poses(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_missing_package_is_told_how_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(poses, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'gscompleter\[poses\]'"):
        find_poses(blank(tmp_path / "p", 3), tmp_path / "out")


def test_copies_stand_upright_and_know_their_focal_length(tmp_path):
    image = Image.new("RGB", (2000, 1000), "red")
    image.paste("blue", (0, 0, 1000, 1000))
    exif = image.getexif()
    exif[ORIENTATION] = 6  # stored lying on its left side: its left is the top
    exif.get_ifd(0x8769)[FOCAL_35] = 43
    image.save(tmp_path / "a.jpg", exif=exif)
    copy = write_upright(tmp_path, "a.jpg", tmp_path)
    assert (copy.width, copy.height) == (800, MAX_COPY_SIDE)
    assert copy.focal == pytest.approx(43 / 43.2666 * (800**2 + 1600**2) ** 0.5)
    with Image.open(tmp_path / "images" / "a.jpg") as written:
        assert written.size == (800, MAX_COPY_SIDE)
        assert written.getexif().get(ORIENTATION, 1) == 1
        assert written.getpixel((400, 100))[2] > 200  # blue above


def test_an_upright_small_photograph_is_copied_byte_for_byte(tmp_path):
    Image.new("RGB", (64, 48), "red").save(tmp_path / "a.jpg")
    write_upright(tmp_path, "a.jpg", tmp_path)
    assert (tmp_path / "images/a.jpg").read_bytes() == (tmp_path / "a.jpg").read_bytes()


def test_other_formats_become_png(tmp_path):
    Image.new("RGBA", (64, 48), "red").save(tmp_path / "a.tif")
    copy = write_upright(tmp_path, "a.tif", tmp_path)
    assert copy.name == "a.tif.png"
    assert copy.source == "a.tif"
    with Image.open(tmp_path / "images" / copy.name) as written:
        assert (written.format, written.mode) == ("PNG", "RGB")


def test_names_that_colmap_cannot_list_are_changed(tmp_path):
    for name in ("a b.png", "a_b.png"):
        Image.new("RGB", (64, 48), "red").save(tmp_path / name)
    assert write_upright(tmp_path, "a b.png", tmp_path).name == "a_b.png"
    with pytest.raises(InputError, match="would be called a_b.png"):
        write_upright(tmp_path, "a_b.png", tmp_path)


def test_masks_hidden_files_and_our_own_results_are_no_photographs(tmp_path):
    folder = blank(tmp_path / "p", 3)
    for name in ("masks", "images_2", "depth", ".cache", "out"):
        blank(folder / name, 1)
    (folder / "out" / "summary.json").write_text("{}")
    Image.new("RGB", (64, 48)).save(folder / ".hidden.png")
    assert list_photograph_files(folder) == ["0.png", "1.png", "2.png"]


# `test_placing.py` runs COLMAP, and `test_the_next_run_keeps_what_was_found` keeps cameras.
@pytest.mark.slow
def test_photographs_alone_are_completed_and_their_cameras_kept(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    given, out = photographs(tmp_path / "room"), tmp_path / "out"
    words = ["complete", given, "--context", 0, 2, "--out", out, "--resolution", 48, 48, "--quiet"]
    assert run(monkeypatch, *words, "--target", 4) == 0
    assert (out / "completed.ply").exists()
    assert (out / "colmap" / "sparse" / "0" / "cameras.bin").exists()
    assert run(monkeypatch, *words, "--target", 4) == 2  # nothing is replaced unasked

    (out / "colmap").rename(tmp_path / "colmap")
    shutil.rmtree(out)
    out.mkdir()
    (tmp_path / "colmap").rename(out / "colmap")
    monkeypatch.setattr(poses, "MAPPING_PROCESS", "nobody")
    words = [*words, "--target", 4, "--dry-run"]
    assert run(monkeypatch, *words) == 0  # with the cameras that are there


def test_names_are_sorted_as_people_count():
    assert sorted(["10.jpg", "9.jpg", "b.jpg"], key=make_sort_key) == ["9.jpg", "10.jpg", "b.jpg"]


@pytest.mark.slow
def test_forty_real_photographs_are_all_placed(shared, tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    found = find_poses(shared / "data" / "fox" / "images", tmp_path / "fox")
    assert found.num_registered == 40
    assert found.error < 0.5


@pytest.mark.slow
def test_of_two_scenes_in_a_folder_the_larger_is_kept(shared, tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    sources = [*list_photographs(shared, "fox", 12), *list_photographs(shared, "hololens_room", 8)]
    names = [f"{letter}.jpg" for letter in string.ascii_lowercase[: len(sources)]]
    (tmp_path / "both").mkdir()
    for name, source in zip(names, sources, strict=True):
        with Image.open(source) as image:
            image.thumbnail((320, 320))
            image.save(tmp_path / "both" / name, quality=92)
    found = find_poses(tmp_path / "both", tmp_path / "out")
    assert found.missing == names[12:]


def list_photographs(shared: Path, scene: str, count: int) -> list[Path]:
    return sorted((shared / "data" / scene / "images").iterdir())[:count]

"""Lines and refusals while photographs are opened."""

import json
import zipfile
from pathlib import Path

import pytest
from PIL import Image

from command import run
from exact_room import make_cameras, write_photographs, write_transforms
from gscompleter.apps.command_line.named_splat import names_splat
from gscompleter.apps.inputs.named_photographs import (
    check_target_files,
    read_targets,
    refuse_missing_photographs,
)
from gscompleter.apps.inputs.opening import describe_cameras_above, refuse_splat_as_photographs
from gscompleter.data.formats import open_photographs
from gscompleter.data.sfm.poses import has_photographs, list_all_photographs
from gscompleter.splats.formats import save_splat
from gscompleter.system.errors import InputError
from pose_files import write_camera_list
from scenes import random_gaussians

CAMERAS = make_cameras(4, width=64, height=48, focal=52.0)


def test_photographs_whose_folder_has_cameras_say_so(tmp_path, monkeypatch):
    scene = write_transforms(tmp_path / "scene", CAMERAS)
    (line,) = describe_cameras_above(scene / "images")
    assert f"{scene} has cameras of these photographs (nerfstudio)" in line
    assert describe_cameras_above(scene) == []
    monkeypatch.chdir(scene / "images")
    assert describe_cameras_above(Path()) == [line]
    write_photographs(tmp_path / "plain" / "images", CAMERAS)
    assert describe_cameras_above(tmp_path / "plain" / "images") == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--context", "photo_001", "photo_001.png"), "names photograph 1 (photo_001.png) twice"),
        (("--context", "photo_009.png"), "There is no photograph 'photo_009.png'"),
        (("--context", 9), "There is no frame 9"),
        (("--target", "photo_009.png"), "'photo_009.png' is no target: name a photograph"),
        (("--target", "missing.json"), "'missing.json' is no target: name a photograph"),
    ],
)
def test_photographs_that_are_not_there_are_refused(tmp_path, monkeypatch, capsys, words, said):
    scene = write_transforms(tmp_path / "scene", CAMERAS)
    assert run(monkeypatch, "complete", scene, *words, "--out", tmp_path / "out") == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["--context", "--target"])
def test_a_name_that_no_file_has_is_refused_before_cameras_are_searched_for(
    tmp_path, monkeypatch, capsys, option
):
    write_photographs(tmp_path / "plain", CAMERAS)
    words = (option, "photo_009.png", "photo_001.png")
    assert run(monkeypatch, "complete", tmp_path / "plain", *words, "--out", tmp_path / "out") == 2
    said = f"There is no photograph 'photo_009.png' among the {len(CAMERAS)} of"
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("word", ["photo 1 #a.png", "photo_1__a.png", "photos\\photo 1 #a.PNG"])
def test_a_photograph_whose_copy_has_another_name_is_found_by_both(tmp_path, word):
    write_photographs(tmp_path / "plain", CAMERAS, ["photo 1 #a.png", "b.png", "c.png", "d.png"])
    refuse_missing_photographs(tmp_path / "plain", [word], 0)
    # As `poses` names the copies for COLMAP.
    names = ["photo_1__a.png", "b.png", "c.png", "d.png"]
    copies = open_photographs(write_transforms(tmp_path / "copies", CAMERAS, names))
    assert copies.frame(copies.find_frame(word.split("\\")[-1])).name == names[0]


def test_a_number_is_a_photograph_whatever_the_working_folder_holds(tmp_path, monkeypatch):
    photographs = open_photographs(write_transforms(tmp_path / "scene", CAMERAS))
    (tmp_path / "1").mkdir()
    monkeypatch.chdir(tmp_path)
    (target,) = read_targets(photographs, ["1"], None, has_splat=False)
    assert target.frame == 1


def test_a_target_that_several_photographs_are_called_is_not_unknown(tmp_path):
    names = [f"images/{side}/{number}.png" for side in ("left", "right") for number in "01"]
    photographs = open_photographs(write_transforms(tmp_path / "scene", CAMERAS, names))
    with pytest.raises(InputError, match="2 photographs of .* are called 0.png: .*left/0.png"):
        read_targets(photographs, ["0.png"], None, has_splat=False)
    (target,) = read_targets(photographs, ["right/0.png"], None, has_splat=False)
    assert target.frame == 2


def test_photographs_without_cameras_may_be_targets_by_their_files(tmp_path):
    write_photographs(tmp_path, CAMERAS)
    image = next(tmp_path.glob("*.png"))
    check_target_files([image.name, str(image), "2"], None)
    with pytest.raises(InputError, match="is no target: name a photograph with its ending"):
        check_target_files(["nowhere.json"], None)


def test_photographs_are_named_by_file_in_options_lines_and_results(tmp_path, monkeypatch, capsys):
    scene = write_transforms(tmp_path / "scene", CAMERAS)
    words = ("--context", "photo_000", scene / "images/photo_002.png", "--target", "PHOTO_003.png")
    place = ("--resolution", 48, 64, "--out", tmp_path / "out")
    assert run(monkeypatch, "complete", scene, *words, *place) == 0
    captured = capsys.readouterr()
    assert "from photographs 0 (photo_000.png), 2 (photo_002.png) for photograph 3" in captured.err
    assert "context 2 (photo_002.png)" in captured.out
    assert "target 1: photograph 3 (photo_003.png)" in captured.out
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert [row["file"] for row in summary["context"]] == ["photo_000.png", "photo_002.png"]
    assert [row["file"] for row in summary["held_out"]] == ["photo_001.png"]
    (target,) = summary["targets"]
    assert target["file"] == "photo_003.png"
    assert target["anchor_file"] in ("photo_000.png", "photo_002.png")
    page = (tmp_path / "out/report.html").read_text()
    for text in (
        "Target 1: photograph 3 (photo_003.png)",
        "Photograph 2 (photo_002.png)",
        "photograph 1 (photo_001.png)",
    ):
        assert text in page


@pytest.mark.slow
def test_photographs_that_are_missing_are_named_also_in_the_report(tmp_path, monkeypatch, capsys):
    scene, out = write_transforms(tmp_path / "scene", CAMERAS), tmp_path / "out"
    (scene / "images" / "photo_002.png").unlink()
    assert run(monkeypatch, "complete", scene, "--target", 2, "--out", out) == 0
    told = (
        "1 of 4 photographs are missing, and their cameras can only be targets: "
        "images/photo_002.png."
    )
    said = capsys.readouterr().err
    assert told in said
    assert "nerfstudio, 3 of 4 photographs." in said
    assert json.loads((out / "summary.json").read_text())["scene"]["notes"] == [told]
    assert told in (out / "report.html").read_text()


def write_packed(folder):
    """Write an unpacked .sog of a few Gaussians, whose tables are images."""
    save_splat(folder.with_suffix(".sog"), random_gaussians(40))
    with zipfile.ZipFile(folder.with_suffix(".sog")) as archive:
        archive.extractall(folder)
    return folder


def test_an_unpacked_sog_is_a_splat_and_no_folder_of_photographs(tmp_path, monkeypatch, capsys):
    folder = write_packed(tmp_path / "scene")
    assert len(list(folder.glob("*.webp"))) >= 4
    assert names_splat(folder)
    assert not has_photographs(folder)
    out = ("--out", tmp_path / "out")
    assert run(monkeypatch, "poses", folder, *out) == 2
    assert "There are 0 photographs" in capsys.readouterr().err
    assert run(monkeypatch, "clean", folder, "--scene", folder.with_suffix(".sog"), *out) == 2
    assert "is a folder of Gaussians, which goes to --scene" in capsys.readouterr().err
    # Beside photographs, its tables are none of them.
    write_photographs(tmp_path, CAMERAS)
    assert list_all_photographs(tmp_path) == [f"photo_{number:03d}.png" for number in range(4)]


def test_a_file_of_cameras_that_is_named_as_a_splat_is_none(tmp_path):
    """The names of files of an unpacked .sog end in meta.json, and so may others."""
    scene = write_transforms(tmp_path / "scene", CAMERAS)
    file = (scene / "transforms.json").rename(scene / "my_meta.json")
    assert not names_splat(file)
    refuse_splat_as_photographs(file)
    assert names_splat(write_packed(tmp_path / "packed") / "meta.json")


def test_a_streamed_scene_is_named_where_photographs_are_expected(tmp_path, monkeypatch, capsys):
    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "lod-meta.json").write_text('{"lodLevels": 2}')
    write_packed(scene / "0_0")
    assert run(monkeypatch, "complete", scene, "--out", tmp_path / "out") == 2
    assert (
        "is a streamed scene (lod-meta.json) in several levels of detail" in capsys.readouterr().err
    )


def test_the_model_folder_of_a_trainer_is_a_splat_unless_it_has_photographs(tmp_path):
    folder = tmp_path / "model"
    (folder / "point_cloud/iteration_7").mkdir(parents=True)
    save_splat(folder / "point_cloud/iteration_7/point_cloud.ply", random_gaussians(4))
    write_camera_list(folder / "cameras.json")
    write_photographs(folder / "train/ours_7/renders", CAMERAS)
    assert names_splat(folder)
    write_photographs(folder / "images", CAMERAS)
    assert not names_splat(folder)


def test_depth_that_is_not_used_is_named_where_the_scene_is_opened(tmp_path, monkeypatch, capsys):
    scene = write_transforms(tmp_path / "scene", CAMERAS)
    (scene / "depths").mkdir()
    (scene / "depths" / "0.png").write_bytes(b"")
    words = ("complete", scene, "--context", 0, 1, "--target", 3, "--dry-run", "--out")
    assert run(monkeypatch, *words, tmp_path / "out") == 0
    opened = next(line for line in capsys.readouterr().err.splitlines() if "Opened:" in line)
    assert opened.endswith("nerfstudio, 4 of 4 photographs; not used: depths (1 files of depth).")


def test_cameras_without_a_photograph_count_as_no_photographs(tmp_path, monkeypatch, capsys):
    scene = write_transforms(tmp_path / "scene", CAMERAS)
    file = scene / "transforms.json"
    content = json.loads(file.read_text())
    del content["frames"][3]["file_path"]
    file.write_text(json.dumps(content))
    (scene / "images" / "photo_002.png").unlink()
    words = ("complete", scene, "--target", 3, "--dry-run", "--out", tmp_path / "out")
    assert run(monkeypatch, *words) == 0
    said = capsys.readouterr().err
    assert "nerfstudio, 2 of 3 photographs, cameras without one: 1" in said
    assert "1 of 3 photographs are missing" in said


def test_a_mask_of_the_target_hides_what_it_hides(tmp_path, monkeypatch, capsys):
    scene = write_transforms(tmp_path / "scene", CAMERAS)
    camera = CAMERAS[3]
    mask = Image.new("L", (camera.width, camera.height), 255)
    mask.paste(0, (0, 0, camera.width // 2, camera.height))
    (scene / "masks").mkdir()
    mask.save(scene / "masks" / "photo_003.png")
    words = ("complete", scene, "--target", 3, "--dry-run", "--out", tmp_path / "out")
    assert run(monkeypatch, *words) == 0
    assert "what they hide, up to 50.0 % of a photograph, is neither" in capsys.readouterr().err

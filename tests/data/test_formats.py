"""All input formats give the same views, and errors are reported in a sentence."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from chunk_files import SIZE, VIEWS, example, pixels_of, row_of, save_chunk, save_dataset
from command import run
from gscompleter import InputError
from gscompleter.data.formats import SCENE_FORMATS, open_photographs, refuse_scenes_below
from gscompleter.data.photographs import Photographs, Resolution
from gscompleter.data.real_estate import read_camera_file
from gscompleter.data.scene import write_cameras
from gscompleter.evaluation.cases import open_clips, read_cases
from gscompleter.types import View
from pose_files import write_colmap_binary, write_photographs


def save_camera_file(path: Path, frames: str | None = None, views: list[View] = VIEWS) -> Path:
    """Write a RealEstate10K camera file, with its photographs in the folder `frames` beside it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["https://www.youtube.com/watch?v=room"]
    for number, view in enumerate(views):
        numbers = " ".join(f"{value:.9f}" for value in row_of(view).tolist())
        lines.append(f"{33366 * number} {numbers}")
        if frames is not None:
            folder = path.parent / frames
            folder.mkdir(exist_ok=True)
            Image.fromarray(pixels_of(view)).save(folder / f"{33366 * number}.png")
    path.write_text("\n".join(lines) + "\n")
    return path


def save_scene(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{number}.png" for number in range(len(VIEWS))]
    for name, view in zip(names, VIEWS, strict=True):
        Image.fromarray(pixels_of(view)).save(folder / name)
    write_cameras(folder / "transforms.json", [view.camera for view in VIEWS], names)
    return folder


@pytest.mark.parametrize("resolution", [None, (32, 48)])
def test_all_formats_give_the_same_views(tmp_path, resolution):
    chunk = save_chunk(tmp_path / "chunks" / "000000.torch", example(form="PNG"))
    beside = save_camera_file(tmp_path / "beside" / "room.txt", ".")
    within = save_camera_file(tmp_path / "within" / "room.txt", "room")
    scene = save_scene(tmp_path / "room")
    clips = [next(open_clips(path)) for path in (scene, chunk, beside, within)]
    truth = clips[0].views([1, 4], resolution)
    for clip in clips:
        assert isinstance(clip, Photographs)
        assert (clip.name, len(clip), clip.find_skip_reason()) == ("room", 5, None)
        for view, true in zip(clip.views([1, 4], resolution), truth, strict=True):
            assert view.frame == true.frame
            assert torch.equal(view.image, true.image)
            assert torch.allclose(view.camera.c2w, true.camera.c2w, atol=1e-6)
            assert torch.allclose(view.camera.K, true.camera.K, atol=1e-4)


def test_a_folder_of_scenes_or_camera_files_is_opened_in_order(tmp_path):
    for name in ("q", "p"):
        save_scene(tmp_path / "scenes" / name)
        save_camera_file(tmp_path / "files" / f"{name}.txt")
    (tmp_path / "files" / "README.txt").write_text("Camera files.")
    assert [clip.name for clip in open_clips(tmp_path / "scenes")] == ["p", "q"]
    assert [clip.name for clip in open_clips(tmp_path / "files")] == ["p", "q"]
    assert next(open_clips(tmp_path / "scenes" / "p" / "transforms.json")).name == "p"


def test_a_data_set_of_chunks_is_opened_by_its_folder_or_index(tmp_path):
    root = save_dataset(tmp_path)
    for path in (root, root / "test", root / "test" / "index.json"):
        assert [clip.name for clip in open_clips(path)] == ["a", "b", "c"]


def test_what_is_no_clip_is_told_what_would_be_one(tmp_path):
    (tmp_path / "a.json").write_text("{}")
    (tmp_path / "a.txt").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    for name in ("a.txt", "empty"):
        with pytest.raises(InputError, match=f"no posed photographs in .*{name}; name .* nerfst"):
            list(open_clips(tmp_path / name))
    with pytest.raises(InputError, match="a.json lists no frames"):
        next(open_clips(tmp_path / "a.json"))
    with pytest.raises(InputError, match="There is no .*missing; name .* nerfstudio"):
        list(open_clips(tmp_path / "missing"))
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(InputError, match="is not JSON"):
        next(open_clips(tmp_path / "a.json"))


def test_a_missing_photograph_is_named_when_asked_for(tmp_path):
    clip = read_camera_file(save_camera_file(tmp_path / "room.txt", "room"))
    (tmp_path / "room" / "66732.png").unlink()
    assert len(clip.views([0, 1, 3])) == 3
    with pytest.raises(InputError, match=r"image of frame 2 of .*room.txt is missing; put .*66732"):
        clip.views([2])
    with pytest.raises(InputError, match="no frame 5 in .*room.txt"):
        clip.views([5])


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("1 2 3", "Frame 1 of .*room.txt is not a line of RealEstate10K"),
        ("x" + " 1" * 18, "Frame 1 of .*room.txt is not a line"),
        ("../5" + " 1" * 18, "Frame 1 of .*room.txt is not a line"),
        ("1" + " one" * 18, "Frame 1 of .*room.txt is not a line"),
    ],
)
def test_a_camera_file_that_is_wrong_is_named(tmp_path, line, sentence):
    path = save_camera_file(tmp_path / "room.txt", views=VIEWS[:1])
    path.write_text(path.read_text() + line)
    with pytest.raises(InputError, match=sentence):
        read_camera_file(path)


def test_a_camera_file_without_frames_is_named(tmp_path):
    (tmp_path / "room.txt").write_text("https://www.youtube.com/watch?v=room\n\n")
    with pytest.raises(InputError, match="room.txt lists no frames"):
        read_camera_file(tmp_path / "room.txt")
    (tmp_path / "room.txt").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(InputError, match="room.txt lists no frames"):
        read_camera_file(tmp_path / "room.txt")


# One scene.


def complete(monkeypatch, scene: Path, out: Path, *more: object) -> int:
    """Run `complete` for frame 2 of a scene and return its exit code."""
    where = ("--context", 0, 1, "--target", 2, "--out", out, "--quiet")
    return run(monkeypatch, "complete", scene, *where, *more)


@pytest.mark.slow
def test_a_chunk_and_a_camera_file_are_completed_like_a_folder(tmp_path, monkeypatch):
    """Every format gives the same photographs, so that the same command gives the same scene."""
    places = {
        "nerfstudio": save_scene(tmp_path / "room"),
        "chunks": save_chunk(tmp_path / "chunks" / "0.torch", example(form="PNG")),
        "real-estate-10k": save_camera_file(tmp_path / "files" / "room.txt", "room"),
    }
    assert set(places) <= set(SCENE_FORMATS)
    summaries = []
    for format, place in places.items():
        out = tmp_path / f"out-{format}"
        assert complete(monkeypatch, place, out, "--format", format) == 0
        summaries.append(json.loads((out / "summary.json").read_text()))
    for summary in summaries:
        (target,) = summary["targets"]
        assert target["psnr_after"] == pytest.approx(summaries[0]["targets"][0]["psnr_after"], 1e-2)


def test_a_forced_format_and_several_scenes_get_a_sentence(tmp_path, monkeypatch, capsys):
    scene, out = save_scene(tmp_path / "room"), tmp_path / "out"
    assert complete(monkeypatch, scene, out, "--format", "chunks") == 2
    assert "There are no photographs in the format chunks in" in capsys.readouterr().err
    assert complete(monkeypatch, scene, out, "--format", "colmapp") == 2
    said = capsys.readouterr().err
    assert "no format 'colmapp'; choose one of chunks, dgp, nerfstudio, colmap, " in said
    assert complete(monkeypatch, save_dataset(tmp_path / "data"), out) == 2
    assert "holds several scenes, such as a and b" in capsys.readouterr().err
    assert not out.exists()


def test_scenes_below_a_folder_are_named(tmp_path, monkeypatch, capsys):
    parent, out = tmp_path / "parent", tmp_path / "out"
    for name in ("a", "group/b", "out"):
        write_colmap_binary(write_photographs(parent / name / "images").parent / "sparse" / "0")
    (parent / "out" / "summary.json").write_text("{}")  # a result of ours
    assert run(monkeypatch, "complete", parent, "--out", out, "--quiet") == 2
    said = capsys.readouterr().err
    assert "is no scene itself, but holds 2 scene(s) below it: a, group/b; name one of them" in said
    assert len(said) < 300
    with pytest.raises(InputError, match=r"holds 2 scene\(s\) below it: a, group/b"):
        open_photographs(parent)
    assert not out.exists()


def test_several_folders_of_photographs_without_cameras_are_named(tmp_path):
    for name in "abcdef":
        write_photographs(tmp_path / name / "images")
    with pytest.raises(InputError, match=r"6 scene\(s\) below it: a, b, c, d and 2 more; name one"):
        open_photographs(tmp_path)


def test_photographs_beside_a_scene_are_completed_by_themselves(tmp_path):
    write_colmap_binary(write_photographs(tmp_path / "old" / "images").parent / "sparse" / "0")
    write_photographs(tmp_path)
    refuse_scenes_below(tmp_path)
    with pytest.raises(InputError, match="There are no posed photographs"):
        open_photographs(tmp_path)


def test_opening_reads_cameras_only(tmp_path):
    scene = save_scene(tmp_path / "room")
    for image in scene.glob("*.png"):
        image.write_bytes(b"not an image")
    photographs = open_photographs(scene)
    assert isinstance(photographs, Photographs)
    assert [f.name for f in photographs.frames] == [f"{number}.png" for number in range(5)]
    with pytest.raises(InputError, match=r"2.png is not an image"):
        photographs.views([2])


def test_a_frame_without_its_photograph_has_a_camera_where_its_size_is_known(tmp_path):
    scene = save_scene(tmp_path / "room")
    (scene / "1.png").unlink()
    photographs = open_photographs(scene)
    assert [photographs.frame(number).has_photograph() for number in (0, 1)] == [True, False]
    assert torch.allclose(photographs.camera(1).c2w, VIEWS[1].camera.c2w, atol=1e-6)
    stored = open_photographs(save_camera_file(tmp_path / "room.txt"))
    with pytest.raises(InputError, match="size of frame 1 of .*room.txt is not known"):
        stored.camera(1)


def test_masks_say_what_to_ignore_at_the_resolution_of_the_photograph(tmp_path):
    scene = save_scene(tmp_path / "room")
    shown = np.full((SIZE, SIZE), 255, np.uint8)
    shown[:, : SIZE // 4] = 0
    Image.fromarray(shown).save(scene / "mask.png")
    content = json.loads((scene / "transforms.json").read_text())
    content["frames"][0]["mask_path"] = "mask.png"
    (scene / "transforms.json").write_text(json.dumps(content))
    photographs = open_photographs(scene)

    def ignored(frame: int, resolution: Resolution = None) -> torch.Tensor | None:
        return photographs.views([frame], resolution)[0].ignore_mask

    assert torch.equal(ignored(0), torch.from_numpy(shown == 0))
    # 64 x 64 becomes 32 x 32, of which eight columns are cropped on either side: the mask's half.
    assert not ignored(0, (32, 16)).any()
    assert ignored(0, (32, 32)).sum() == 32 * 8
    assert ignored(1) is None


def test_copies_of_other_folders_are_no_photographs_of_this_one(tmp_path):
    """Only `images` has downscaled copies beside it; `room_2` is another scene."""
    scene = save_scene(tmp_path / "room")
    save_scene(tmp_path / "room_2")
    (scene / "1.png").unlink()
    assert not open_photographs(scene).frame(1).has_photograph()


@pytest.mark.parametrize(
    "change",
    [
        {"resolution": [32]},
        {"resolution": [32.5, 32]},
        {"cases": [{"scene": 3, "context": [0, 1], "target": 2}]},
        {"cases": [{"scene": "p", "context": "01", "target": 2}]},
        {"cases": [{"scene": "p", "context": [0, 1], "target": "2"}]},
        {"cases": [{"scene": "p", "context": [0, 1], "target": 2, "near": "a"}]},
        {"cases": "x" * 100_000},
    ],
)
def test_a_file_of_cases_that_is_wrong_is_named_in_short(tmp_path, change):
    rows = [{"scene": "p", "context": [0, 1], "target": 2}]
    content = {"resolution": [32, 32], "cases": rows, **change}
    (tmp_path / "cases.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="cases.json is no file of cases") as error:
        read_cases(tmp_path / "cases.json")
    assert len(str(error.value)) < 500


def test_a_real_chunk_is_one_scene(shared):
    chunk = open_photographs(shared / "formats" / "re10k" / "000000.torch")
    assert (chunk.name, len(chunk), chunk.origin.any()) == ("0d4de33c6888a754", 93, False)
    assert chunk.camera(5, (256, 256)).width == 256


# The scene of the test before is near zero as well.
@pytest.mark.slow
def test_no_real_scene_is_told_from_a_local_origin(shared):
    for clip in open_clips(shared / "data"):
        assert not clip.origin.any(), clip.name

"""The one door: every format gives the same views, and what is wrong is said."""

import json
from pathlib import Path

import pytest
import torch
from PIL import Image

from chunk_files import SIZE, VIEWS, example, pixels_of, row_of, save_chunk, save_dataset
from gscompleter import InputError
from gscompleter.data.datasets import open_clips
from gscompleter.data.photographs import PosedPhotographs
from gscompleter.data.real_estate import read_camera_file
from gscompleter.data.scene import write_cameras
from gscompleter.types import View


def save_camera_file(path: Path, frames: str | None = None, views: list[View] = VIEWS) -> Path:
    """A RealEstate10K camera file; its photographs lie in the folder `frames` beside it."""
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
        assert isinstance(clip, PosedPhotographs)
        assert (clip.name, len(clip), clip.reason_to_skip((SIZE, SIZE))) == ("room", 5, None)
        for view, true in zip(clip.views([1, 4], resolution), truth, strict=True):
            assert view.frame == true.frame
            assert torch.equal(view.image, true.image)
            assert torch.allclose(view.camera.c2w, true.camera.c2w, atol=1e-6)
            assert torch.allclose(view.camera.K, true.camera.K, atol=1e-4)
        assert "64 × 64 and not 9 × 9" in (clip.reason_to_skip((9, 9)) or "")


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


def test_cases_are_opened_with_the_planes_that_enclose_theirs(tmp_path):
    save_scene(tmp_path / "p")
    save_scene(tmp_path / "q")
    rows = [
        {"scene": "q", "context": [0, 1], "target": 2, "near": 1.0, "far": 9.0},
        {"scene": "p", "context": [0, 1], "target": 2, "near": 1.0, "far": 9.0},
        {"scene": "q", "context": [1, 2], "target": 3, "near": 0.5, "far": 8.0},
        {"scene": "p", "context": [1, 2], "target": 3},
    ]
    (tmp_path / "cases.json").write_text(json.dumps({"resolution": [32, 32], "cases": rows}))
    for path in (tmp_path, tmp_path / "cases.json"):
        q, p = open_clips(path)
        assert (q.name, p.name) == ("q", "p")
        (camera,) = [view.camera for view in q.views([0])]
        assert (camera.near, camera.far) == (0.5, 9.0)
        assert p.views([0])[0].camera.near is None


def test_what_is_no_clip_is_told_what_would_be_one(tmp_path):
    (tmp_path / "a.json").write_text("{}")
    (tmp_path / "a.png").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    for name in ("a.png", "empty"):
        with pytest.raises(InputError, match=f"no posed photographs in .*{name}; name .* nerfst"):
            open_clips(tmp_path / name)
    with pytest.raises(InputError, match="a.json lists no frames"):
        next(open_clips(tmp_path / "a.json"))
    with pytest.raises(InputError, match="There is no .*missing; name .* nerfstudio"):
        open_clips(tmp_path / "missing")
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(InputError, match="is not JSON"):
        open_clips(tmp_path / "a.json")


def test_a_missing_photograph_is_named_when_asked_for(tmp_path):
    clip = read_camera_file(save_camera_file(tmp_path / "room.txt", "room"))
    (tmp_path / "room" / "66732.png").unlink()
    assert len(clip.views([0, 1, 3])) == 3
    with pytest.raises(InputError, match=r"image of frame 2 of .*room.txt is missing; put .*66732"):
        clip.views([2])
    assert clip.reason_to_skip((SIZE, SIZE)) == "frame 2: its image is missing"
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
    with pytest.raises(InputError, match="room.txt is not a text file"):
        read_camera_file(tmp_path / "room.txt")

"""Evaluation data: every format gives the same views, and what is wrong is said."""

import gc
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from chunk_files import SIZE, VIEWS, as_tensor, example, file_bytes, pixels_of, row_of, save_chunk
from gscompleter import InputError
from gscompleter.data.chunks import open_chunks
from gscompleter.data.clips import Clip, Skipped, usable
from gscompleter.data.folders import open_clips, real_estate_clip, scene_clip
from gscompleter.data.scene import write_cameras
from gscompleter.geometry import project
from gscompleter.runs.protocols import (
    EvaluationIndex,
    Extrapolation,
    Split,
    StressTest,
    index_of,
    n_k_index,
    parse_protocol,
    read_evaluation_index,
    write_evaluation_index,
)
from gscompleter.runs.tasks import neighbours, tasks_of
from gscompleter.types import View


def save_dataset(root: Path) -> Path:
    """Three scenes in two chunks, as the test half of a data set."""
    save_chunk(root / "test" / "000000.torch", example("a"), example("b"))
    save_chunk(root / "test" / "000001.torch", example("c"))
    index = {"a": "000000.torch", "b": "000000.torch", "c": "000001.torch"}
    (root / "test" / "index.json").write_text(json.dumps(index))
    return root


class Frames:
    """A clip that has numbers only."""

    def __init__(self, name: str, count: int) -> None:
        self.name, self.count = name, count

    def __len__(self) -> int:
        return self.count

    def views(self, frames, resolution=None) -> list[View]:
        return [VIEWS[frame % len(VIEWS)] for frame in frames]

    def reason_to_skip(self, size=None) -> str | None:
        return None


# Chunks.


def test_a_chunk_gives_back_the_views_it_was_made_of(tmp_path):
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", example(form="PNG")))
    assert isinstance(clip, Clip)
    assert (clip.name, len(clip)) == ("room", 5)
    for number in (3, 0):
        (view,) = clip.views([number])
        truth = VIEWS[number]
        assert view.frame == number
        assert np.array_equal(pixels_of(view), pixels_of(truth))
        assert torch.allclose(view.camera.c2w, truth.camera.c2w, atol=1e-6)
        assert torch.allclose(view.camera.K, truth.camera.K, atol=1e-4)


def test_clips_that_are_held_keep_one_chunk_in_memory(tmp_path):
    noise = torch.randint(0, 256, (100_000,), dtype=torch.uint8)
    for number in range(4):
        one = {**example(str(number)), "images": [noise.clone() for _ in VIEWS]}
        save_chunk(tmp_path / f"{number:06}.torch", one)
    del one, noise
    clips = list(open_chunks(tmp_path))
    gc.collect()
    held = sum(
        value.numel()
        for value in gc.get_objects()
        if type(value) is torch.Tensor and value.dtype == torch.uint8
    )
    assert [clip.name for clip in clips] == ["0", "1", "2", "3"]
    assert held < 2 * len(VIEWS) * 100_000


def test_jpeg_bytes_are_photographs_too(tmp_path):
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", example(form="JPEG")))
    (view,) = clip.views([2])
    assert (view.image - VIEWS[2].image).abs().mean() < 0.02


def test_the_stored_transform_is_world_to_camera(tmp_path):
    # The camera stands at (1, 2, 3) and looks along the world's x axis.
    R = torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    one = example()
    row = torch.cat([R, -R @ torch.tensor([[1.0], [2.0], [3.0]])], dim=1).flatten()
    one["cameras"][0, 6:] = row
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", one))
    (view,) = clip.views([0])
    assert torch.allclose(view.camera.center, torch.tensor([1.0, 2.0, 3.0]))
    assert torch.allclose(view.camera.forward, torch.tensor([1.0, 0.0, 0.0]))


@pytest.mark.parametrize("resolution", [(32, 32), (48, 64), (64, 40), (90, 90), (17, 53)])
def test_a_point_is_seen_at_the_same_place_of_a_resized_and_cropped_image(tmp_path, resolution):
    rng = np.random.default_rng(0)
    wide = rng.integers(0, 256, (72, 128, 3), dtype=np.uint8)
    one = example()
    one["images"] = [as_tensor(file_bytes(wide))] * 5
    one["cameras"][:, :4] = torch.tensor([0.6, 1.1, 0.47, 0.52])
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", one))
    (full,), (small,) = clip.views([1]), clip.views([1], resolution)
    assert small.image.shape == (*resolution, 3)
    # The point in camera axes, then the definition of the stored intrinsics.
    point = torch.tensor([0.3, -0.2, 4.0])
    x, y, z = (clip.cameras[1, 6:].reshape(3, 4) @ torch.cat([point, torch.ones(1)])).tolist()
    u, v = 128 * (0.6 * x / z + 0.47), 72 * (1.1 * y / z + 0.52)
    assert project(point, full.camera)[0].tolist() == pytest.approx([u, v], abs=1e-4)
    scale = max(resolution[0] / 72, resolution[1] / 128)
    w, h = round(128 * scale), round(72 * scale)
    left, top = (w - resolution[1]) // 2, (h - resolution[0]) // 2
    seen = project(point, small.camera)[0].tolist()
    assert seen == pytest.approx([u * w / 128 - left, v * h / 72 - top], abs=1e-4)


def test_re10k_photographs_become_256_pixels_as_in_the_papers(tmp_path):
    one = example()
    one["images"] = [as_tensor(file_bytes(np.zeros((360, 640, 3), np.uint8)))] * 5
    one["cameras"][:, :4] = torch.tensor([0.5, 0.9, 0.5, 0.5])
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", one))
    (view,) = clip.views([0], (256, 256))
    # 360 x 640 becomes 256 x 455, of which 99 columns on the left are cropped.
    K = torch.tensor([[0.5 * 455, 0, 227.5 - 99], [0, 0.9 * 256, 128], [0, 0, 1]])
    assert torch.allclose(view.camera.K, K)


@pytest.mark.parametrize("inside", ["", "test", "test/000000.torch"])
def test_a_data_set_can_be_named_at_every_level(tmp_path, inside):
    root = save_dataset(tmp_path / "data")
    names = [clip.name for clip in open_chunks(root / inside)]
    assert names == (["a", "b"] if inside.endswith("torch") else ["a", "b", "c"])


def test_a_folder_of_chunks_needs_no_index(tmp_path):
    root = save_dataset(tmp_path / "data")
    (root / "test" / "index.json").unlink()
    assert [clip.name for clip in open_chunks(root / "test")] == ["a", "b", "c"]
    assert open_chunks(root).clip("c").name == "c"


def test_one_scene_is_found_through_the_index(tmp_path):
    root = save_dataset(tmp_path / "data")
    (root / "test" / "000000.torch").write_bytes(b"never read")
    assert open_chunks(root).clip("c").name == "c"


def test_chunks_are_read_one_at_a_time(tmp_path):
    root = save_dataset(tmp_path / "data")
    (root / "test" / "000001.torch").write_bytes(b"damaged")
    clips = iter(open_chunks(root))
    assert [next(clips).name, next(clips).name] == ["a", "b"]
    with pytest.raises(InputError, match="000001.torch is truncated"):
        next(clips)


def test_images_are_decoded_only_when_asked_for(tmp_path):
    one = example()
    one["images"][3] = as_tensor(b"no image")
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", one))
    assert len(clip.views([0, 1, 2, 4])) == 4
    with pytest.raises(InputError, match="Frame 3 of the scene room of .*torch is not an image"):
        clip.views([3])


# What benchmarks leave out.


def skip_reason(tmp_path: Path, change) -> str | None:
    one = example()
    change(one["cameras"])
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", one))
    return clip.reason_to_skip()


def set_to(frame, column, value):
    def change(cameras):
        cameras[frame, column] = value

    return change


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (set_to(0, 0, 0.9), None),
        (set_to(2, 0, 0.4), "frame 2: its opening angle of 102.7° is above 100°"),
        (set_to(1, 1, 0.4), "frame 1: its opening angle of 102.7° is above 100°"),
        (set_to(0, 9, 1001.0), "frame 0: its translation of 1001 is above 1000"),
        (set_to(0, 9, -1100.0), "frame 0: its translation of 1100 is above 1000"),
        (set_to(4, 7, float("nan")), "frame 4: its camera holds NaN or infinity"),
        (set_to(4, 2, float("inf")), "frame 4: its camera holds NaN or infinity"),
        (set_to(4, 0, -0.5), "frame 4: its focal length -0.5 is not positive"),
        (set_to(0, slice(6, 9), 0.0), "frame 0: its rotation has the determinant 0 and not 1"),
        (set_to(0, 6, -1.0), "frame 0: its rotation has the determinant -1 and not 1"),
        (set_to(0, 7, 0.5), "frame 0: its rotation is sheared"),
    ],
)
def test_what_benchmarks_leave_out_has_a_reason(tmp_path, change, reason):
    found = skip_reason(tmp_path, change)
    assert found is None if reason is None else re.fullmatch(reason, found)


def test_the_size_of_images_is_checked_only_where_asked(tmp_path):
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", example()))
    assert clip.reason_to_skip() is None
    assert clip.reason_to_skip((64, 64)) is None
    assert clip.reason_to_skip((360, 640)) == "frame 0: its image is 64 × 64 and not 360 × 640"


def test_what_is_left_out_is_recorded(tmp_path):
    wide = example("wide")
    wide["cameras"][0, 0] = 0.3
    path = save_chunk(tmp_path / "000000.torch", example("a"), wide, example("b"))
    skipped: list[Skipped] = []
    assert [clip.name for clip in usable(open_chunks(path), skipped)] == ["a", "b"]
    assert [(s.name, "opening angle" in s.reason) for s in skipped] == [("wide", True)]


def test_a_camera_that_is_none_gives_no_view(tmp_path):
    one = example()
    one["cameras"][1, 6:] = float("nan")
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", one))
    with pytest.raises(InputError, match="Frame 1 of the scene room of .* holds NaN"):
        clip.views([1])


# Damaged chunks.


def without(key):
    return {k: v for k, v in example().items() if k != key}


@pytest.mark.parametrize(
    ("bad", "sentence"),
    [
        (without("key"), "Scene 0 of .*000000.torch has no `key`"),
        (without("cameras"), "scene room of .*000000.torch has no `cameras`"),
        (without("images"), "scene room of .*000000.torch has no `images`"),
        ({**example(), "key": 3}, "Scene 0 of .* has no `key`"),
        ([1, 2], "Scene 0 of .* is no dict but list"),
        ({**example(), "cameras": torch.zeros(5, 12)}, r"room of .* float32 of shape \[5, 12\]"),
        ({**example(), "cameras": torch.zeros(90)}, r"room of .* float32 of shape \[90\]"),
        ({**example(), "cameras": torch.zeros(5, 18).long()}, "room of .* are int64 of shape"),
        ({**example(), "cameras": [1.0]}, "room of .* of type list"),
        ({**example(), "cameras": torch.zeros(4, 18)}, "room of .* 5 images and 4 cameras"),
        ({**example(), "images": []}, "`images` of the scene room of .* are no list with images"),
        ({**example(), "images": torch.zeros(5)}, "`images` of the scene room of .* are no list"),
        (
            {**example(), "images": [torch.zeros(2, 2)] * 5},
            r"Image 0 of the scene room of .* is float32 of shape \[2, 2\]",
        ),
        ({**example(), "images": ["x"] * 5}, "Image 0 of the scene room of .* is of type str"),
    ],
)
def test_a_scene_that_is_wrong_is_named(tmp_path, bad, sentence):
    path = save_chunk(tmp_path / "000000.torch", bad)
    with pytest.raises(InputError, match=sentence):
        list(open_chunks(path))


def test_a_truncated_image_is_named(tmp_path):
    one = example()
    one["images"][2] = one["images"][2][:-400]
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", one))
    with pytest.raises(InputError, match="Frame 2 of the scene room of .*000000.torch is damaged"):
        clip.views([2])


@pytest.mark.parametrize("frame", [-1, 5])
def test_a_frame_that_does_not_exist_is_named(tmp_path, frame):
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", example()))
    with pytest.raises(InputError, match=f"no frame {frame} in the scene room .* 0 to 4"):
        clip.views([0, frame])
    with pytest.raises(InputError, match="resolution 0 × 8 is impossible"):
        clip.views([0], (0, 8))


class Trap:
    """What would run on loading, were it allowed to."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("zipped", [True, False])
def test_pickled_objects_are_refused_and_never_run(tmp_path, zipped):
    sprung = tmp_path / "sprung"
    bad = {**example(), "url": Trap(sprung)}
    torch.save([bad], tmp_path / "x.torch", _use_new_zipfile_serialization=zipped)
    with pytest.raises(InputError, match="x.torch holds pickled Python objects, which are refused"):
        list(open_chunks(tmp_path / "x.torch"))
    assert not sprung.exists()


def test_files_that_are_no_chunks_are_named(tmp_path):
    whole = save_chunk(tmp_path / "whole.torch", example()).read_bytes()
    cuts = {f"cut{n}.torch": whole[:n] for n in (0, 1, 100, len(whole) // 2, len(whole) - 10)}
    for name, data in {**cuts, "text.torch": b"hello world"}.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=f"{name} is truncated or no file of torch.save"):
            list(open_chunks(tmp_path / name))
    (tmp_path / "p.torch").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
    with pytest.raises(InputError, match="p.torch is a git-lfs pointer"):
        list(open_chunks(tmp_path / "p.torch"))
    torch.save({"a": 1}, tmp_path / "dict.torch")
    with pytest.raises(InputError, match="a list of scenes is needed, and it holds dict"):
        list(open_chunks(tmp_path / "dict.torch"))
    torch.save([], tmp_path / "empty.torch")
    with pytest.raises(InputError, match="a list of scenes is needed, and it holds none"):
        list(open_chunks(tmp_path / "empty.torch"))


def test_an_index_that_disagrees_with_the_chunks_is_named(tmp_path):
    root = save_dataset(tmp_path / "data")
    path = root / "test" / "index.json"
    with pytest.raises(InputError, match=r"no scene z in .*index.json, which lists 3"):
        open_chunks(root).clip("z")
    listed = json.loads(path.read_text())
    path.write_text(json.dumps({**listed, "z": "000001.torch"}))
    with pytest.raises(InputError, match=r"index.json says that the scene z is in .*000001.torch"):
        list(open_chunks(root))
    path.write_text(json.dumps({"a": "000000.torch"}))
    with pytest.raises(InputError, match=r"000000.torch holds the scene b, which is absent from"):
        list(open_chunks(root))
    path.write_text(json.dumps({"a": "000007.torch"}))
    with pytest.raises(InputError, match=r"There is no chunk .*000007.torch"):
        list(open_chunks(root))
    path.unlink()
    with pytest.raises(InputError, match="no scene z in the 2 chunks"):
        open_chunks(root).clip("z")


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"a": 1}', "\x00"])
def test_an_index_that_is_none_is_named(tmp_path, text):
    (tmp_path / "index.json").write_text(text)
    with pytest.raises(InputError, match="index.json is n"):
        open_chunks(tmp_path)


def test_a_folder_without_chunks_is_named(tmp_path):
    with pytest.raises(InputError, match="There are no chunks in"):
        open_chunks(tmp_path)


# Folders.


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
        assert isinstance(clip, Clip)
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
    for name in ("a.json", "a.png", "empty"):
        with pytest.raises(InputError, match=f"no clips in .*{name}; name a folder with a trans"):
            open_clips(tmp_path / name)
    with pytest.raises(InputError, match="There is no .*missing; name a folder"):
        open_clips(tmp_path / "missing")
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(InputError, match="is not JSON"):
        open_clips(tmp_path / "a.json")


def test_a_missing_photograph_is_named_when_asked_for(tmp_path):
    clip = real_estate_clip(save_camera_file(tmp_path / "room.txt", "room"))
    (tmp_path / "room" / "66732.png").unlink()
    assert len(clip.views([0, 1, 3])) == 3
    with pytest.raises(InputError, match=r"image of frame 2 of .*room.txt is missing; .*66732.png"):
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
        real_estate_clip(path)


def test_a_camera_file_without_frames_is_named(tmp_path):
    (tmp_path / "room.txt").write_text("https://www.youtube.com/watch?v=room\n\n")
    with pytest.raises(InputError, match="room.txt lists no frames"):
        real_estate_clip(tmp_path / "room.txt")
    (tmp_path / "room.txt").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(InputError, match="room.txt is not a text file"):
        real_estate_clip(tmp_path / "room.txt")


# Protocols.


def test_two_frames_are_extrapolated_to_a_third_in_both_directions():
    index = n_k_index([Frames("a", 24), Frames("b", 21), Frames("c", 20)], 10, stride=2)
    there = [((n, n + 10), (n + 20,)) for n in (0, 2)]
    back = [((n + 20, n + 10), (n,)) for n in (0, 2)]
    found = [(split.context, split.targets) for split in index.scenes["a"]]
    assert found == [there[0], back[0], there[1], back[1]]
    assert len(index.scenes["b"]) == 2
    assert index.skipped == ("c",)
    assert index.name == "n-10-stride-2"


def test_without_a_stride_no_two_starts_share_a_frame():
    splits = Extrapolation(3).splits(Frames("a", 50))
    used = [sorted({*split.context, *split.targets}) for split in splits[::2]]
    assert used == [[n, n + 3, n + 6] for n in range(0, 44, 7)]


def test_the_stress_test_needs_a_hundred_frames():
    assert StressTest().splits(Frames("a", 100)) == (Split((0, 30), (99,)),)
    assert StressTest().splits(Frames("a", 99)) == ()


@pytest.mark.parametrize("text", ["n-10", "n-30-stride-5", "stress"])
def test_a_protocol_is_called_what_it_was_asked_for_as(text):
    assert parse_protocol(text).name == text
    assert parse_protocol(text) == parse_protocol(text)


@pytest.mark.parametrize("text", ["n-", "n-x", "n--1", "n-1.5", "m-10", "", "n-١", "missing.json"])
def test_what_is_no_protocol_is_told_what_would_be_one(text):
    with pytest.raises(InputError, match="There is no protocol .* n-K .* stress"):
        parse_protocol(text)


@pytest.mark.parametrize("text", ["n-0", "n-5-stride-0"])
def test_an_extrapolation_over_nothing_is_refused(text):
    with pytest.raises(InputError, match="at least 1"):
        parse_protocol(text)


def test_neighbours_exist_and_are_not_context():
    assert neighbours(5, (0, 1), 10) == (4, 6)
    assert neighbours(2, (0, 1), 10) == (3,)
    assert neighbours(9, (0, 1), 10) == (8,)
    assert neighbours(0, (2, 1), 10) == ()


def test_a_case_has_one_target_and_loads_its_views():
    index = EvaluationIndex("x", {"a": (Split((0, 2), (3, 4)),)})
    first, second = tasks_of(index, Frames("a", 5))
    assert (first.scene, first.name, first.targets) == ("a", "a 0+2>3", (3,))
    assert (first.neighbours, second.neighbours) == ((4,), (3,))
    assert second.targets == (4,)
    assert first.load(first.context) == [VIEWS[0], VIEWS[2]]
    assert tasks_of(index, Frames("b", 5)) == []
    with pytest.raises(InputError, match="The protocol x asks for frame 4 of a, which has 4"):
        tasks_of(index, Frames("a", 4))


def test_an_index_is_read_back_as_it_was_written(tmp_path):
    clips = [Frames("a", 64), Frames('odd "ü" name', 30), Frames("short", 3)]
    index = n_k_index(clips, 10, 4)
    write_evaluation_index(tmp_path / "index.json", index)
    assert read_evaluation_index(tmp_path / "index.json") == index
    assert parse_protocol(str(tmp_path / "index.json")) == index
    again = index_of(index, clips)
    write_evaluation_index(tmp_path / "again.json", again)
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "index.json").read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["again.json", "index.json"]
    content = json.loads((tmp_path / "index.json").read_text())
    assert (content["version"], content["protocol"]) == (1, "n-10-stride-4")


def test_an_index_of_no_clips_is_an_index(tmp_path):
    index = n_k_index([], 10)
    write_evaluation_index(tmp_path / "index.json", index)
    assert read_evaluation_index(tmp_path / "index.json") == index


def test_two_clips_of_one_name_are_refused():
    with pytest.raises(InputError, match="Two clips are called a"):
        n_k_index([Frames("a", 30), Frames("a", 30)], 10)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("{", "is not JSON"),
        ("[]", "is no evaluation index"),
        ('{"s": 3}', "entry of the scene s in .* is 3"),
        ('{"s": []}', "entry of the scene s in"),
        ('{"s": {"target": [1]}}', "`context` of the scene s in .* is None"),
        ('{"s": {"context": [0, 1]}}', "`target` of the scene s in .* is None"),
        ('{"s": {"context": [], "target": [1]}}', "`context` of the scene s"),
        ('{"s": {"context": [0, -1], "target": [1]}}', "`context` of the scene s"),
        ('{"s": {"context": [0, true], "target": [1]}}', "`context` of the scene s"),
        ('{"s": {"context": [0], "target": [1.5]}}', "`target` of the scene s"),
        ('{"version": 2, "protocol": "x", "scenes": {}}', "is of version 2 and version 1 can"),
        ('{"version": 1, "scenes": {}}', "`protocol` and `scenes` are needed"),
    ],
)
def test_an_evaluation_index_that_is_wrong_is_named(tmp_path, content, sentence):
    (tmp_path / "index.json").write_text(content)
    with pytest.raises(InputError, match=sentence):
        read_evaluation_index(tmp_path / "index.json")


def test_an_evaluation_index_that_is_missing_is_named(tmp_path):
    with pytest.raises(InputError, match="index.json cannot be read: No such file"):
        read_evaluation_index(tmp_path / "index.json")


def test_cases_of_a_chunk_load_photographs_at_a_resolution(tmp_path):
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", example()))
    there, back = tasks_of(parse_protocol("n-2"), clip, (32, 32))
    assert (there.name, back.name) == ("room 0+2>4", "room 4+2>0")
    (target,) = back.load(back.targets)
    assert target.image.shape == (32, 32, 3)


# The real files.


def test_a_real_chunk_agrees_with_its_camera_file_and_its_photographs(shared):
    folder = shared / "formats" / "re10k"
    (clip,) = open_clips(folder / "000000.torch")
    assert (clip.name, len(clip)) == ("0d4de33c6888a754", 93)
    assert clip.reason_to_skip((360, 640)) is None
    cameras = real_estate_clip(folder / "0d4de33c6888a754.head.txt")
    assert np.allclose(cameras.cameras, clip.cameras[: len(cameras)].numpy(), atol=1e-7)
    view, far = clip.views([0, 92], (256, 256))
    assert view.image.shape == far.image.shape == (256, 256, 3)
    assert 0.05 < view.image.mean() < 0.95
    viewmat = view.camera.viewmat[:3].flatten()
    assert torch.allclose(viewmat, clip.cameras[0, 6:], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "scenes", "skipped", "first"),
    [
        ("evaluation_index_re10k", 6474, 720, ("5aca87f95a9412c6", (58, 133), (84, 102, 129))),
        ("evaluation_index_acid", 1595, 253, ("675a09ccbf601dff", (7, 54), (10, 20, 49))),
        ("dl3dv_start_0_distance_10_ctx_2v_tgt_4v", 140, 0, (None, (0, 9), (1, 3, 5, 7))),
    ],
)
def test_published_indices_are_read_unchanged(shared, tmp_path, name, scenes, skipped, first):
    index = read_evaluation_index(shared / "formats" / "evaluation_index" / f"{name}.json")
    assert (index.name, len(index.scenes), len(index.skipped)) == (name, scenes, skipped)
    scene, splits = next(iter(index.scenes.items()))
    assert first[0] in (None, scene)
    assert splits == (Split(first[1], first[2]),)
    write_evaluation_index(tmp_path / "ours.json", index)
    assert read_evaluation_index(tmp_path / "ours.json") == index


def test_the_scenes_of_the_development_cases_are_clips(shared):
    clips = list(open_clips(shared / "data"))
    assert len({clip.name for clip in clips}) == len(clips) > 1
    clip = next(clip for clip in clips if clip.name == "re10k_0d4de33c")
    assert len(clip) == len(scene_clip(shared / "data" / "re10k_0d4de33c"))
    assert clip.reason_to_skip() is None
    (case, *_) = tasks_of(parse_protocol("n-4"), clip, (64, 64))
    assert [view.frame for view in case.load(case.context)] == [0, 4]

"""pixelSplat chunks: views survive a round trip, and errors name what is wrong."""

import gc
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from chunk_files import (
    VIEWS,
    as_tensor,
    example,
    file_bytes,
    pixels_of,
    save_chunk,
    save_dataset,
)
from gscompleter import InputError
from gscompleter.data.formats import open_photographs
from gscompleter.data.photographs import AuthorsCrop, Photographs
from gscompleter.data.real_estate import open_chunks, read_camera_file
from gscompleter.evaluation.cases import SkippedScene, filter_usable, open_clips
from gscompleter.numerics.geometry import project
from gscompleter.types import View


def test_a_chunk_gives_back_the_views_it_was_made_of(tmp_path):
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", example(form="PNG")))
    assert isinstance(clip, Photographs)
    assert (clip.name, len(clip)) == ("room", 5)
    for number in (3, 0):
        (view,) = clip.views([number])
        truth = VIEWS[number]
        assert view.frame == number
        assert np.array_equal(pixels_of(view), pixels_of(truth))
        assert torch.allclose(view.camera.c2w, truth.camera.c2w, atol=1e-6)
        assert torch.allclose(view.camera.K, truth.camera.K, atol=1e-4)


def count_image_bytes() -> int:
    """Count the bytes of all images in memory."""
    gc.collect()
    tensors = [value for value in gc.get_objects() if type(value) is torch.Tensor]
    return sum(tensor.numel() for tensor in tensors if tensor.dtype == torch.uint8)


def test_clips_that_are_held_keep_one_chunk_in_memory(tmp_path):
    before = count_image_bytes()
    noise = torch.randint(0, 256, (100_000,), dtype=torch.uint8)
    for number in range(4):
        one = {**example(str(number)), "images": [noise.clone() for _ in VIEWS]}
        save_chunk(tmp_path / f"{number:06}.torch", one)
    del one, noise
    clips = list(open_chunks(tmp_path))
    assert [clip.name for clip in clips] == ["0", "1", "2", "3"]
    assert count_image_bytes() - before < 2 * len(VIEWS) * 100_000


def test_jpeg_bytes_are_photographs_too(tmp_path):
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", example(form="JPEG")))
    (view,) = clip.views([2])
    assert (view.image - VIEWS[2].image).abs().mean() < 0.02


def test_the_stored_transform_is_world_to_camera(tmp_path):
    # The camera is at (1, 2, 3) and points along the world's x axis.
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
    x, y, z = (one["cameras"][1, 6:].reshape(3, 4) @ torch.cat([point, torch.ones(1)])).tolist()
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


def crop_wide(tmp_path: Path, crop: AuthorsCrop, height: int, width: int) -> View:
    """Crop a photograph of this size whose principal point is not central."""
    columns = np.tile(np.arange(width, dtype=np.uint8), (height, 1))
    one = example()
    one["images"] = [as_tensor(file_bytes(np.stack([columns] * 3, axis=-1)))] * 5
    one["cameras"][:, :4] = torch.tensor([0.5, 0.9, 0.47, 0.52])
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", one))
    (view,) = clip.views([0], crop)
    return view


def test_the_authors_crop_keeps_the_principal_point_as_a_fraction(tmp_path):
    """36 x 64 becomes 26 x 46, of which 20 columns are cut."""
    camera = crop_wide(tmp_path, AuthorsCrop(26, 26, is_resized=True), 36, 64).camera
    K = torch.tensor([[0.5 * 46, 0, 0.47 * 26], [0, 0.9 * 26, 0.52 * 26], [0, 0, 1]])
    assert torch.allclose(camera.K, K)


def test_the_authors_crop_of_dl3dv_resizes_nothing(tmp_path):
    """The middle 11 x 32 of 27 x 48 stay as they are, from row and column 8 on."""
    view = crop_wide(tmp_path, AuthorsCrop(11, 32, is_resized=False), 27, 48)
    K = torch.tensor([[0.5 * 48, 0, 0.47 * 32], [0, 0.9 * 27, 0.52 * 11], [0, 0, 1]])
    assert torch.allclose(view.camera.K, K)
    assert pixels_of(view)[5, :, 0].tolist() == list(range(8, 40))


def test_an_image_smaller_than_the_authors_crop_is_refused(tmp_path):
    with pytest.raises(InputError, match="48 × 27 pixels is smaller than its crop of 64 × 16"):
        crop_wide(tmp_path, AuthorsCrop(16, 64, is_resized=False), 27, 48)


@pytest.mark.parametrize("inside", ["", "test", "test/000000.torch"])
def test_a_data_set_can_be_named_at_every_level(tmp_path, inside):
    root = save_dataset(tmp_path / "data")
    names = [clip.name for clip in open_chunks(root / inside)]
    assert names == (["a", "b"] if inside.endswith("torch") else ["a", "b", "c"])


def test_a_folder_of_chunks_needs_no_index(tmp_path):
    root = save_dataset(tmp_path / "data")
    (root / "test" / "index.json").unlink()
    assert [clip.name for clip in open_chunks(root / "test")] == ["a", "b", "c"]
    assert [clip.name for clip in open_chunks(root)] == ["a", "b", "c"]


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
    return clip.find_skip_reason()


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
        (set_to(4, 7, float("nan")), "frame 4: its pose holds NaN or infinity"),
        (set_to(4, 9, 1e30), "frame 4: its pose holds 1e[+]30, which is above 1e[+]09"),
        (set_to(4, 2, float("inf")), "frame 4: its principal point lies inf image sizes .*"),
        (set_to(4, 0, float("nan")), "frame 4: its focal length is nan times .*"),
        (set_to(4, 0, -0.5), "frame 4: its focal length is -0.5 times the size of the image, .*"),
        (set_to(4, slice(0, 2), 0.0), "frame 4: its focal length is 0 times .*"),
        (set_to(0, slice(6, 9), 0.0), "frame 0: its pose is not a rigid transform .*"),
        (set_to(0, 6, -1.0), "frame 0: its pose is a reflection .*"),
        (set_to(0, 7, 0.5), "frame 0: its pose is not a rigid transform .*"),
    ],
)
def test_what_benchmarks_leave_out_has_a_reason(tmp_path, change, reason):
    found = skip_reason(tmp_path, change)
    assert found is None if reason is None else re.fullmatch(reason, found)


def test_what_is_left_out_is_recorded(tmp_path):
    wide = example("wide")
    wide["cameras"][0, 0] = 0.3
    path = save_chunk(tmp_path / "000000.torch", example("a"), wide, example("b"))
    skipped: list[SkippedScene] = []
    assert [clip.name for clip in filter_usable(open_chunks(path), skipped)] == ["a", "b"]
    assert [(s.name, "opening angle" in s.reason) for s in skipped] == [("wide", True)]


def test_an_invalid_pose_gives_no_view(tmp_path):
    one = example()
    one["cameras"][1, 6:] = float("nan")
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", one))
    with pytest.raises(InputError, match="Frame 1 of the scene room of .* holds NaN"):
        clip.views([1])


# Damaged chunks.


NO_CAMERAS = r"`cameras` of the scene room of .*000000.torch are no floats of shape \[n, 18\]"
NO_IMAGES = r"`images` of the scene room of .*000000.torch are no list of uint8 tensors"


def without(key):
    return {k: v for k, v in example().items() if k != key}


@pytest.mark.parametrize(
    ("bad", "sentence"),
    [
        (without("key"), "Scene 0 of .*000000.torch has no `key`"),
        (without("cameras"), NO_CAMERAS),
        (without("images"), NO_IMAGES),
        ({**example(), "key": 3}, "Scene 0 of .* has no `key`"),
        ([1, 2], "Scene 0 of .* has no `key`"),
        ({**example(), "cameras": torch.zeros(5, 12)}, NO_CAMERAS),
        ({**example(), "cameras": torch.zeros(90)}, NO_CAMERAS),
        ({**example(), "cameras": torch.zeros(5, 18).long()}, NO_CAMERAS),
        ({**example(), "cameras": [1.0]}, NO_CAMERAS),
        ({**example(), "cameras": torch.zeros(4, 18)}, "for each of 4 cameras"),
        ({**example(), "cameras": torch.zeros(5, 18).to_sparse()}, NO_CAMERAS),
        ({**example(), "cameras": torch.zeros(5, 18, device="meta")}, NO_CAMERAS),
        ({**example(), "images": [torch.zeros(9).byte().to_sparse()] * 5}, NO_IMAGES),
        ({**example(), "images": []}, NO_IMAGES),
        ({**example(), "images": torch.zeros(5)}, NO_IMAGES),
        ({**example(), "images": [torch.zeros(2, 2)] * 5}, NO_IMAGES),
        ({**example(), "images": ["x"] * 5}, NO_IMAGES),
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
    with pytest.raises(
        InputError, match="Frame 2 of the scene room of .*000000.torch is not an image"
    ):
        clip.views([2])


@pytest.mark.parametrize("frame", [-1, 5])
def test_a_frame_that_does_not_exist_is_named(tmp_path, frame):
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", example()))
    with pytest.raises(InputError, match=f"no frame {frame} in the scene room .* 0 to 4"):
        clip.views([0, frame])
    with pytest.raises(InputError, match="resolution 0 × 8 is impossible"):
        clip.views([0], (0, 8))


class Trap:
    """Object that would run code when it is loaded."""

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
        with pytest.raises(InputError, match=f"{name} is truncated, no file of torch.save, or too"):
            list(open_chunks(tmp_path / name))
    (tmp_path / "p.torch").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
    with pytest.raises(InputError, match="p.torch is a git-lfs pointer"):
        list(open_chunks(tmp_path / "p.torch"))
    torch.save({"a": 1}, tmp_path / "dict.torch")
    with pytest.raises(InputError, match="a list of scenes is needed, and it holds dict"):
        list(open_chunks(tmp_path / "dict.torch"))
    torch.save([], tmp_path / "empty.torch")
    with pytest.raises(InputError, match="a list of scenes is needed, and it holds list"):
        list(open_chunks(tmp_path / "empty.torch"))


def test_a_missing_chunk_of_an_index_is_named(tmp_path):
    root = save_dataset(tmp_path / "data")
    (root / "test" / "index.json").write_text(json.dumps({"a": "000007.torch"}))
    with pytest.raises(InputError, match=r"000007.torch cannot be read: No such file"):
        list(open_chunks(root))


def test_a_scene_that_its_chunk_lacks_is_named(tmp_path):
    root = save_dataset(tmp_path / "data")
    index = json.loads((root / "test" / "index.json").read_text())
    (root / "test" / "index.json").write_text(json.dumps({**index, "d": "000001.torch"}))
    clips = open_chunks(root)
    assert [next(clips).name, next(clips).name] == ["a", "b"]
    with pytest.raises(InputError, match=r"index.json lists d in .*000001.torch, which lacks it"):
        next(clips)


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"a": 1}', "\x00"])
def test_an_index_that_is_none_is_named(tmp_path, text):
    (tmp_path / "index.json").write_text(text)
    with pytest.raises(InputError, match="index.json is n"):
        open_chunks(tmp_path)


def test_a_folder_without_chunks_is_named(tmp_path):
    with pytest.raises(InputError, match="no photographs in the format chunks in"):
        open_photographs(tmp_path, "chunks")


def test_a_real_chunk_agrees_with_its_camera_file_and_its_photographs(shared):
    folder = shared / "formats" / "re10k"
    (clip,) = open_clips(folder / "000000.torch")
    assert (clip.name, len(clip)) == ("0d4de33c6888a754", 93)
    assert clip.find_skip_reason() is None
    listed = read_camera_file(folder / "0d4de33c6888a754.head.txt")
    for ours, theirs in zip(listed.frames, clip.frames, strict=False):
        assert np.allclose(ours.c2w, theirs.c2w, atol=1e-7)
        assert np.allclose(ours.intrinsics.focal, theirs.intrinsics.focal, atol=1e-7)
    view, far = clip.views([0, 92], (256, 256))
    assert view.image.shape == far.image.shape == (256, 256, 3)
    assert 0.05 < view.image.mean() < 0.95

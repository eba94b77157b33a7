"""Photographs as users bring them: paths of other machines, names, EXIF, formats, broken poses."""

from __future__ import annotations

import json
import shutil
import struct
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image, ImageOps, features

from exact_room import make_cameras, make_pose, write_colmap, write_photographs, write_transforms
from gscompleter import InputError, load_camera, load_cameras, load_views
from gscompleter.data.file_names import list_endings
from gscompleter.data.formats import open_photographs
from gscompleter.system.files import image_opening
from gscompleter.system.files.image import (
    ORIENTATION,
    read_colors_and_alpha,
    read_mask,
    read_pixels,
    turn_upright,
)

WIDTH, HEIGHT = 64, 48
CAMERAS = make_cameras(4, width=WIDTH, height=HEIGHT, focal=52.0)
NAMES = [f"images/photo_{number:03d}.png" for number in range(4)]
WINDOWS = {
    "relative": [name.replace("/", "\\") for name in NAMES],
    "dotted": [".\\" + name.replace("/", "\\") for name in NAMES],
    "drive": ["C:\\Users\\me\\scan\\" + name.replace("/", "\\") for name in NAMES],
    "share": ["\\\\nas\\scan\\" + name.replace("/", "\\") for name in NAMES],
    "slashes": ["D:/scan/" + name for name in NAMES],
    "unix": ["/home/other/scan/" + name for name in NAMES],
    "without ending": ["/home/other/scan/" + name.removesuffix(".png") for name in NAMES],
    "other case": ["E:\\scan\\Images\\" + Path(name).name.upper() for name in NAMES],
}


def change(scene: Path, **fields: object) -> None:
    """Change the first frame of a transforms.json."""
    content = json.loads((scene / "transforms.json").read_text())
    content["frames"][0] |= fields
    (scene / "transforms.json").write_text(json.dumps(content))


@pytest.mark.parametrize("kind", WINDOWS)
def test_paths_of_another_machine_are_found_by_their_ends_and_said(tmp_path, kind):
    scene = write_transforms(tmp_path / "scan", CAMERAS, NAMES, paths=WINDOWS[kind])
    photographs = open_photographs(scene)
    for view, camera in zip(photographs.views(range(4)), CAMERAS, strict=True):
        assert np.array_equal((view.image * 255).round().numpy(), camera.photograph)
    assert [frame.file_name for frame in photographs.frames] == [Path(n).name for n in NAMES]
    (note,) = photographs.notes
    assert "4 of 4 paths" in note
    assert NAMES[0] in note


def test_the_longest_end_of_a_path_that_exists_counts(tmp_path):
    scene = write_transforms(tmp_path, CAMERAS, NAMES, paths=WINDOWS["drive"])
    (scene / "photo_000.png").write_bytes(b"another one")
    assert open_photographs(scene).frame(0).image == scene / NAMES[0]
    # In whichever folder it lies, though `images` is looked into first.
    (scene / "photos").mkdir()
    shutil.copyfile(scene / NAMES[0], scene / "photos" / "photo_000.png")
    change(scene, file_path="D:\\x\\photos\\photo_000.png")
    images = [frame.image for frame in open_photographs(scene).frames]
    assert scene / "photos" / "photo_000.png" in images
    assert list_endings("C:\\a\\b.png") == ["a/b.png", "b.png"]
    assert list_endings("../a/b.png") == ["../a/b.png"]


def test_other_files_that_a_scene_names_are_found_in_the_same_way(tmp_path):
    scene = write_transforms(
        tmp_path, CAMERAS, NAMES, fields={"ply_file_path": "Z:\\x\\Points.ply"}
    )
    (scene / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n0 0 3\n"
    )
    depth = np.full((HEIGHT, WIDTH), 2000, np.uint16)
    (scene / "depth").mkdir()
    Image.fromarray(depth).save(scene / "depth/d0.png")
    change(scene, depth_file_path="Q:\\scan\\depth\\d0.png")
    photographs = open_photographs(scene)
    assert photographs.points().tolist() == [[0, 0, 3]]
    assert (photographs.views([0])[0].depth == 2).all()


def test_a_relative_path_that_is_missing_is_not_searched_for_elsewhere(tmp_path):
    scene = write_transforms(tmp_path, CAMERAS, NAMES)
    (scene / NAMES[0]).rename(scene / "photo_000.png")
    assert not open_photographs(scene).frame(0).has_photograph()


def test_names_of_colmap_may_be_paths_of_another_machine(tmp_path):
    scene = write_colmap(tmp_path, CAMERAS, n_points=20)
    file = scene / "sparse/0/images.txt"
    file.write_text(file.read_text().replace("photo_", "C:\\scan\\images\\photo_"))
    photographs = open_photographs(scene)
    assert len(photographs) == 4
    assert "4 of 4 paths" in photographs.notes[0]
    assert [frame.name for frame in photographs.frames] == [Path(name).name for name in NAMES]


def test_names_of_colmap_may_be_absolute_paths_that_exist(tmp_path):
    scene = write_colmap(tmp_path / "scene", CAMERAS, n_points=20)
    (scene / "images").rename(tmp_path / "photos")
    file = scene / "sparse/0/images.txt"
    file.write_text(file.read_text().replace("photo_", f"{tmp_path}/photos/photo_"))
    photographs = open_photographs(scene)
    assert photographs.notes == ()
    assert photographs.frame(0).image == tmp_path / "photos/photo_000.png"


@pytest.mark.parametrize("path", [".", "/", "..", "a/", "\\", "C:"])
def test_odd_paths_are_missing_photographs(tmp_path, path):
    scene = write_transforms(tmp_path, CAMERAS, NAMES)
    change(scene, file_path=path)
    photographs = open_photographs(scene)
    assert sum(frame.has_photograph() for frame in photographs.frames) == 3
    assert photographs.find_frame("photo_002.png") in range(4)


def test_names_that_differ_in_case_only_are_two_photographs(tmp_path):
    names = ["images/a.png", "images/A.png", "images/B.png", "images/b.png"]
    if not _has_case(tmp_path):
        pytest.skip("this file system does not tell cases apart")
    scene = write_transforms(tmp_path, CAMERAS, names)
    photographs = open_photographs(scene)
    for number, frame in enumerate(photographs.frames):
        camera = CAMERAS[names.index(frame.name)]
        (view,) = photographs.views([number])
        assert np.array_equal((view.image * 255).round().numpy(), camera.photograph)
    assert photographs.frame(photographs.find_frame("a.png")).name == "images/a.png"
    with pytest.raises(InputError, match="2 photographs of .* are called B"):
        photographs.find_frame("B")


def _has_case(folder: Path) -> bool:
    (folder / "case").touch()
    return not (folder / "CASE").exists()


def test_photographs_are_found_by_name_or_number(tmp_path):
    photographs = open_photographs(write_transforms(tmp_path, CAMERAS, NAMES))
    for word in ("photo_002.png", "photo_002", "PHOTO_002.PNG", "images/photo_002.png", 2):
        assert photographs.find_frame(word) == 2
    assert photographs.find_frame(str(tmp_path / NAMES[2])) == 2
    assert photographs.find_frame("images\\photo_002.png") == 2
    for word in ("photo", "photo_02", "002.png", "", "jpg"):
        with pytest.raises(InputError, match="There is no photograph"):
            photographs.find_frame(word)


def test_a_photograph_is_found_by_its_file_where_the_cameras_leave_its_ending_out(tmp_path):
    """As Inria's cameras.json does, whose names are all that an error could tell."""
    names = [f"images/20240212_{number}.jpg" for number in range(4)]
    photographs = open_photographs(write_transforms(tmp_path, CAMERAS, names))
    frames = tuple(replace(f, name=f.name.removesuffix(".jpg")) for f in photographs.frames)
    bare = replace(photographs, frames=frames)
    for word in ("20240212_2.jpg", "20240212_2", "20240212_2.JPG", "images/20240212_2.jpg"):
        assert bare.find_frame(word) == photographs.find_frame("20240212_2.jpg")
    with pytest.raises(InputError, match="There is no photograph"):
        bare.find_frame("20240212_9.jpg")


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_portraits_whose_cameras_are_upright_are_turned(tmp_path, orientation):
    """Phones store them lying, with a tag; w and h are those of the upright photograph."""
    cameras = make_cameras(2, width=HEIGHT, height=WIDTH, focal=52.0)
    scene = write_transforms(tmp_path, cameras, NAMES[:2])
    for name, camera in zip(NAMES, cameras, strict=False):
        inverse = {6: 8, 8: 6}.get(orientation, orientation)
        stored = Image.fromarray(turn_upright(camera.photograph, inverse))
        exif = stored.getexif()
        exif[ORIENTATION] = orientation
        stored.save(scene / name, exif=exif)
    for view, camera in zip(open_photographs(scene).views([0, 1]), cameras, strict=True):
        assert np.array_equal((view.image * 255).round().numpy(), camera.photograph)
        assert (view.camera.width, view.camera.height) == (HEIGHT, WIDTH)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientations_are_those_of_pillow(orientation):
    image = Image.fromarray(CAMERAS[0].photograph)
    image.getexif()[ORIENTATION] = orientation
    expected = np.asarray(ImageOps.exif_transpose(image))
    assert np.array_equal(turn_upright(CAMERAS[0].photograph, orientation), expected)


def test_an_orientation_is_ignored_where_the_camera_is_that_of_the_stored_pixels(tmp_path):
    scene = write_transforms(tmp_path, CAMERAS, NAMES)
    stored = Image.open(scene / NAMES[0])
    exif = stored.getexif()
    exif[ORIENTATION] = 6
    stored.save(scene / NAMES[0], exif=exif)
    (view,) = open_photographs(scene).views([0])
    assert np.array_equal((view.image * 255).round().numpy(), CAMERAS[0].photograph)


@pytest.mark.parametrize("write", [write_colmap, write_transforms])
@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (WIDTH, WIDTH), (WIDTH, HEIGHT - 8)])
def test_a_photograph_of_another_shape_than_its_camera_is_refused(tmp_path, write, size):
    scene = write(tmp_path, CAMERAS)
    Image.new("RGB", size).save(scene / NAMES[0])
    with pytest.raises(InputError, match=r"photo_000.* which is another aspect ratio"):
        open_photographs(scene).views([0])


def test_a_photograph_of_another_size_but_the_same_shape_is_read(tmp_path):
    scene = write_colmap(tmp_path, CAMERAS)
    Image.new("RGB", (WIDTH // 8, HEIGHT // 8)).save(scene / NAMES[0])
    Image.new("RGB", (31, 24)).save(scene / NAMES[1])  # half the width, rounded down
    first, second = open_photographs(scene).views([0, 1])
    assert (first.camera.width, second.camera.width) == (8, 31)


def test_a_camera_with_a_nan_pose_is_said_and_the_others_keep_their_numbers(tmp_path):
    scene = write_transforms(tmp_path / "nerfstudio", CAMERAS, NAMES)
    change(scene, transform_matrix=np.full((4, 4), np.nan).tolist())
    model = write_colmap(tmp_path / "colmap", CAMERAS)
    file = model / "sparse/0/images.txt"
    lines = file.read_text().splitlines()
    lines[0] = " ".join(["1", *["nan"] * 7, "1", "photo_000.png"])
    file.write_text("\n".join(lines) + "\n")
    for folder in (scene, model):
        photographs = open_photographs(folder)
        assert [frame.file_name for frame in photographs.frames] == [
            f"photo_{number:03d}.png" for number in range(4)
        ]
        (note,) = photographs.notes
        assert "1 of 4 cameras" in note
        assert "photo_000.png; the others keep their numbers" in note
        # A number is that of its file, and one that cannot be used is refused by both its names.
        (view,) = photographs.views([2])
        assert np.array_equal((view.image * 255).round().numpy(), CAMERAS[2].photograph)
        for name in (0, "photo_000.png"):
            with pytest.raises(InputError, match=r"photo_000.*its pose holds NaN"):
                photographs.views([name])
        assert [view.frame for view in load_views(folder)] == [1, 2, 3]


def test_photographs_are_named_by_number_or_file_in_python(tmp_path):
    scene = write_transforms(tmp_path, CAMERAS, NAMES)
    named = load_views(scene, ["photo_001.png", "images/photo_003.png", 2])
    assert [view.frame for view in named] == [1, 3, 2]
    camera = load_camera(scene, "PHOTO_002")
    assert torch.equal(camera.c2w, load_camera(scene, 2).c2w)
    with pytest.raises(InputError, match=r"no photograph 'photo_009.png' .* such as photo_000.png"):
        load_views(scene, ["photo_009.png"])
    with pytest.raises(InputError, match="list of numbers or names"):
        load_views(scene, "photo_001.png")


def test_a_scene_without_a_finite_pose_is_refused(tmp_path):
    scene = write_transforms(tmp_path, CAMERAS[:1], NAMES[:1])
    change(scene, transform_matrix=np.full((4, 4), np.inf).tolist())
    with pytest.raises(InputError):
        open_photographs(scene)
    change(scene, transform_matrix=np.full((4, 4), np.nan).tolist())
    with pytest.raises(InputError, match=r"all 1 cameras .* hold NaN or infinity .*photo_000"):
        open_photographs(scene)


def write_brand(path: Path, brand: bytes) -> Path:
    """Write a file that begins as one of an ISO container, with nothing more."""
    path.write_bytes(b"\0\0\0\x18ftyp" + brand + b"\0\0\0\0mif1" + brand + b"\0" * 64)
    return path


def test_heic_is_refused_by_name_without_its_reader(tmp_path, monkeypatch):
    monkeypatch.setattr(image_opening, "find_spec", lambda name: None)
    path = write_brand(tmp_path / "IMG_1.HEIC", b"heic")
    with pytest.raises(InputError, match=r"IMG_1.HEIC is HEIC.*gscompleter\[heic\].*sips"):
        read_pixels(path)
    with pytest.raises(InputError, match="is HEIC"):
        open_photographs(path)


def test_avif_is_refused_by_name_without_its_reader(tmp_path, monkeypatch):
    monkeypatch.setattr(features, "check", lambda name: False)
    with pytest.raises(InputError, match="a.avif is AVIF.*pip install -U pillow"):
        read_pixels(write_brand(tmp_path / "a.avif", b"avif"))


def test_a_damaged_container_is_refused(tmp_path):
    for name, brand in (("a.avif", b"avif"), ("a.heic", b"heic"), ("a.png", b"mp42")):
        with pytest.raises(InputError):
            read_pixels(write_brand(tmp_path / name, brand))


def make_wide_png(pixels: np.ndarray, transparent: bytes) -> bytes:
    """Write pixels of 16 bits, channels in the order of OpenCV, with a transparent colour."""
    png = cv2.imencode(".png", pixels)[1].tobytes()
    checksum = zlib.crc32(b"tRNS" + transparent)
    chunk = struct.pack(">I4s", len(transparent), b"tRNS") + transparent
    # Behind the signature of 8 bytes and the header of 25.
    return png[:33] + chunk + struct.pack(">I", checksum) + png[33:]


def test_a_transparent_colour_of_16_bits_hides_that_colour_alone():
    grey = np.full((4, 4), 30000, np.uint16)
    grey[0] = 65535
    rgb = np.full((4, 4, 3), 30000, np.uint16)
    rgb[0] = (3, 2, 65535)
    for pixels, transparent in (
        (grey, struct.pack(">H", 65535)),
        (rgb, struct.pack(">HHH", 65535, 2, 3)),
    ):
        png = make_wide_png(pixels, transparent)
        colors, alpha = read_colors_and_alpha(png, "wide")
        assert alpha is not None
        assert (alpha[0] == 0).all()
        assert (alpha[1:] == 255).all()
        assert (np.abs(colors[1:].astype(int) - 117) <= 1).all()
        shown = read_pixels(png, "wide")
        assert (shown[0] == 0).all()
        assert (shown[1:] == colors[1:]).all()


@pytest.mark.parametrize(("bits", "row"), [(1, 0b0101_0101), (2, 0b00_01_10_11), (4, 0b0001_1111)])
def test_a_transparent_grey_of_few_bits_hides_that_grey(bits, row):
    """Programs that make a PNG small store a few greys in 1, 2 or 4 bits each."""
    count = 8 // bits
    header = struct.pack(">IIBBBBB", count, 1, bits, 0, 0, 0, 0)
    chunks = (
        (b"IHDR", header),
        (b"tRNS", struct.pack(">H", 1)),
        (b"IDAT", zlib.compress(bytes([0, row]))),
        (b"IEND", b""),
    )
    png = b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
    colors, alpha = read_colors_and_alpha(png, "small")
    greys = [(row >> shift) % 2**bits for shift in range(8 - bits, -1, -bits)]
    assert colors[0, :, 0].tolist() == [grey * 255 // (2**bits - 1) for grey in greys]
    assert alpha is not None
    assert alpha[0].tolist() == [0 if grey == 1 else 255 for grey in greys]


def test_floats_are_no_colours_and_no_mask_with_nan(tmp_path):
    pixels = np.zeros((8, 8), np.float32)
    pixels[:4] = 1
    Image.fromarray(pixels).save(tmp_path / "mask.tiff")
    assert np.array_equal(read_mask(tmp_path / "mask.tiff"), pixels == 0)
    with pytest.raises(InputError, match="floating-point values, not colours"):
        read_pixels(tmp_path / "mask.tiff")
    for value in (np.nan, np.inf):
        pixels[0, 0] = value
        Image.fromarray(pixels).save(tmp_path / "mask.tiff")
        with pytest.raises(InputError, match="holds NaN or infinity"):
            read_mask(tmp_path / "mask.tiff")


@pytest.mark.skipif(not features.check("avif"), reason="Pillow without AVIF")
def test_avif_is_read(tmp_path):
    Image.fromarray(CAMERAS[0].photograph).save(tmp_path / "a.avif", quality=95)
    difference = read_pixels(tmp_path / "a.avif").astype(int) - CAMERAS[0].photograph
    assert np.abs(difference).mean() < 8


def test_heic_is_read_with_pillow_heif(tmp_path):
    heif = pytest.importorskip("pillow_heif", reason="needs gscompleter[heic]")
    heif.from_pillow(Image.fromarray(CAMERAS[0].photograph)).save(tmp_path / "a.HEIC", quality=95)
    difference = read_pixels(tmp_path / "a.HEIC").astype(int) - CAMERAS[0].photograph
    assert np.abs(difference).mean() < 8
    assert len(open_photographs(tmp_path)) == 1


def test_raw_photographs_are_refused_by_name(tmp_path):
    (tmp_path / "IMG_1.DNG").write_bytes(b"II*\0")
    with pytest.raises(InputError, match=r"holds the photograph IMG_1.DNG, .*export JPEG"):
        open_photographs(tmp_path)


def write_camera_path(path: Path, **fields: object) -> Path:
    """Write a camera path of nerfstudio along the cameras."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    fov = np.degrees(2 * np.arctan(HEIGHT / 2 / 52.0))
    poses = [camera.c2w @ flip for camera in CAMERAS]
    content = {
        "camera_type": "perspective",
        "render_width": WIDTH,
        "render_height": HEIGHT,
        "camera_path": [
            {"camera_to_world": pose.flatten().tolist(), "fov": fov, "aspect": WIDTH / HEIGHT}
            for pose in poses
        ],
        "fps": 24,
        **fields,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def test_a_camera_path_of_nerfstudio_is_a_file_of_cameras(tmp_path):
    cameras = load_cameras(write_camera_path(tmp_path / "camera_path.json"))
    for camera, expected in zip(cameras, CAMERAS, strict=True):
        assert torch.allclose(camera.c2w, torch.from_numpy(expected.c2w).float(), atol=1e-6)
        assert torch.allclose(camera.K[[0, 1], [0, 1]], torch.tensor([52.0, 52.0]), atol=1e-3)
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)


@pytest.mark.parametrize("applied_scale", [None, 3.0])
def test_a_camera_path_leads_back_from_the_frame_of_training(tmp_path, applied_scale):
    """The run scaled and moved COLMAP's world, which the transforms.json had rotated before."""
    applied = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
    moved = make_pose([0.2, -0.1, 0.4], yaw=20, pitch=5)
    # As nerfstudio's dataparser composes them: its scale has that of the export as a factor.
    saved = moved @ np.vstack([applied, [0, 0, 0, 1]])
    run = {"transform": saved[:3].tolist(), "scale": 0.25 * (applied_scale or 1.0)}
    path = write_camera_path(tmp_path / "camera_paths/a.json")
    content = json.loads(path.read_text())
    for entry in content["camera_path"]:
        pose = moved @ np.array(entry["camera_to_world"]).reshape(4, 4)
        pose[:3, 3] *= 0.25
        entry["camera_to_world"] = pose.flatten().tolist()
    path.write_text(json.dumps(content))
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(run))
    export = {"applied_transform": applied.tolist(), "applied_scale": applied_scale, "frames": []}
    (tmp_path / "transforms.json").write_text(json.dumps(export))
    for camera, expected in zip(load_cameras(path), CAMERAS, strict=True):
        assert torch.allclose(camera.c2w, torch.from_numpy(expected.c2w).float(), atol=1e-5)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"camera_type": "fisheye"}, "of the type fisheye"),
        ({"camera_path": []}, "holds no camera"),
        ({"render_width": None}, "render_width"),
        ({"camera_path": [{"camera_to_world": [0] * 16}]}, "fov"),
        ({"camera_path": [{"camera_to_world": [1, 2], "fov": 50}]}, "no list of 16"),
    ],
)
def test_a_camera_path_that_cannot_be_read_is_refused(tmp_path, fields, said):
    with pytest.raises(InputError, match=said):
        load_cameras(write_camera_path(tmp_path / "camera_path.json", **fields))


@pytest.mark.skipif(sys.platform == "win32", reason="a path of Windows exists there")
def test_a_photograph_outside_of_the_scene_is_read_by_its_absolute_path(tmp_path):
    write_photographs(tmp_path / "photos", CAMERAS)
    paths = [str(tmp_path / "photos" / f"photo_{number:03d}.png") for number in range(4)]
    scene = write_transforms(tmp_path / "scene", CAMERAS, NAMES, paths=paths)
    photographs = open_photographs(scene)
    assert photographs.notes == ()
    assert photographs.frame(0).image == Path(paths[0])

"""COLMAP models: every layout, both encodings, every lens, and damaged files."""

import re
import shutil
import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from command import run
from gscompleter import InputError, load_cameras
from gscompleter.data.cameras import Distortion, distort
from gscompleter.data.colmap import (
    CAMERA_MODEL_NAMES,
    CAMERA_MODELS,
    MAX_NAME,
    _list_roots,
    build_intrinsics,
    read_images,
)
from gscompleter.data.formats import open_photographs
from gscompleter.data.points import add_depth_range
from gscompleter.system.files.image import write_image
from gscompleter.types import Camera, View
from pose_files import (
    CAMERAS,
    NAMES,
    SIZE,
    VIEWS,
    surface_points,
    write_colmap_binary,
    write_colmap_text,
    write_photographs,
)
from room_checks import check_room, write_cloud
from scenes import Room, camera_at, cast, view_of

LAYOUTS = [
    ("sparse/0", "images"),
    ("sparse", "images"),
    ("colmap/sparse/0", "images"),
    ("distorted/sparse/0", "input"),
    ("distorted/sparse/0", "distorted/images"),
    ("", "images"),
    ("", ""),
    ("Sparse/0", "Images"),
    ("sparse/0", "images_2"),
    ("sparse/0", "input"),
]


@pytest.mark.parametrize(("model", "images"), LAYOUTS)
def test_every_layout_opens(tmp_path, model, images):
    scene = tmp_path / "room"
    write_photographs(scene / images)
    write_colmap_binary(scene / model)
    photographs = open_photographs(scene)
    assert photographs.name == "room"
    check_room(photographs)


def test_the_folder_of_a_model_and_its_images_file_open_too(tmp_path):
    scene = tmp_path / "room"
    write_photographs(scene / "images")
    model = write_colmap_text(scene / "sparse" / "0")
    for path in (scene / "sparse", model, model / "images.txt"):
        photographs = open_photographs(path)
        assert photographs.name == "room"
        check_room(photographs)


@pytest.mark.parametrize("parent", ["scenes", "colmap", "Sparse"])
@pytest.mark.parametrize("images", ["images", ""])
@pytest.mark.parametrize("model", ["", "sparse/0", "0"])
def test_a_scene_may_be_called_by_a_number(tmp_path, parent, images, model):
    """The model of scene 360 does not reach for the photographs beside the folder 360."""
    write_photographs(tmp_path / "images", views=VIEWS[::-1])
    write_photographs(tmp_path / parent / "images", views=VIEWS[::-1])
    scene = tmp_path / parent / "360"
    write_photographs(scene / images)
    write_colmap_binary(scene / model)
    given = [scene, *([scene / model] if model == "sparse/0" else [])]
    for path in given:
        photographs = open_photographs(path)
        assert photographs.name == "360"
        check_room(photographs)
    # One that is missing is left out.
    (scene / images / NAMES[-1]).unlink()
    for path in given:
        check_room(open_photographs(path), range(len(NAMES) - 1))


def test_the_images_file_that_is_named_is_read(tmp_path):
    """A user's choice of lines of images.txt counts, also where images.bin lies beside it."""
    write_photographs(tmp_path / "images")
    model = write_colmap_binary(tmp_path / "sparse")
    lines = (write_colmap_text(model) / "images.txt").read_text().splitlines()
    (model / "images.txt").write_text("\n".join(lines[:5]))
    check_room(open_photographs(model / "images.txt"), [0, 1])
    assert len(load_cameras(model / "images.txt")) == 2
    check_room(open_photographs(tmp_path))


def test_a_model_at_the_top_of_the_file_system_ends_the_search():
    assert _list_roots(Path("/sparse/0"), Path("/sparse/0"))[-1] == Path("/")


def test_names_of_files_may_be_written_in_any_case(tmp_path):
    model = write_colmap_text(tmp_path / "room" / "SPARSE" / "0")
    for name in ("cameras", "images", "points3D"):
        (model / f"{name}.txt").rename(model / f"{name.title()}.TXT")
    write_photographs(tmp_path / "room" / "Images", [name.upper() for name in NAMES])
    photographs = open_photographs(tmp_path / "room")
    check_room(photographs)
    assert photographs.points() is not None


def test_photographs_of_a_lens_do_not_come_from_those_without_it(tmp_path):
    """`images` beside `distorted` are undistorted, and belong to another model."""
    scene = tmp_path / "room"
    write_photographs(scene / "input")
    write_photographs(scene / "images", views=VIEWS[::-1])
    write_colmap_binary(scene / "distorted" / "sparse" / "0")
    check_room(open_photographs(scene))


def test_images_lie_in_subfolders_with_slashes_of_either_kind(tmp_path):
    names = [f"left/{name}" if number % 2 else f"right/{name}" for number, name in enumerate(NAMES)]
    write_photographs(tmp_path / "images", names)
    for write in (write_colmap_binary, write_colmap_text):
        model = tmp_path / "sparse"
        shutil.rmtree(model, ignore_errors=True)
        write(model, [name.replace("/", "\\") for name in names])
        photographs = open_photographs(tmp_path)
        assert [frame.name for frame in photographs.frames] == sorted(names)
        check_room(photographs, [1, 3, 0, 2, 4])


def test_names_with_spaces_and_of_any_encoding_are_found(tmp_path):
    names = ["a b.png", "ä.png", "1 2 3.png", "c.png", "0 0.png"]
    write_photographs(tmp_path / "images", names)
    for write in (write_colmap_binary, write_colmap_text):
        shutil.rmtree(tmp_path / "sparse", ignore_errors=True)
        write(tmp_path / "sparse", names)
        check_room(open_photographs(tmp_path), [4, 2, 0, 3, 1])


def test_names_without_endings_may_look_like_features(tmp_path):
    """Lines of features are triples, too, and end in a whole number."""
    names = ["IMG 0 0", "IMG 1 2", "a b c 3 4 5", "d -1 6", "e"]
    write_photographs(tmp_path / "images", [f"{name}.png" for name in names])
    for features in ("1 2 -1", "1.5 2 -1 " * 4):
        write_colmap_text(tmp_path / "sparse", names, features)
        check_room(open_photographs(tmp_path))


def test_names_of_three_numbers_are_no_features(tmp_path):
    names = ["1 2 3", "2024 05 01", "2024 05 02", "2024 05 03", "7 8 9 10 11 12"]
    write_photographs(tmp_path / "images", [f"{name}.png" for name in names])
    for features in ("", "1 2 -1", "1.5 2 -1 " * 4, "0 0 -1 " * 4, "0 0 0 " * 4):
        write_colmap_text(tmp_path / "sparse", names, features)
        check_room(open_photographs(tmp_path))
    # The first camera is that of the scene's axes, whose pose COLMAP writes in whole numbers.
    path = tmp_path / "sparse" / "images.txt"
    text, count = re.subn(r"\n1 .* 7 1 2 3\n", "\n1 1 0 0 0 0 0 0 7 1 2 3\n", path.read_text())
    assert count == 1
    path.write_text(text)
    check_room(open_photographs(tmp_path))


def test_the_longest_name_of_a_binary_file_is_read(tmp_path):
    for length in (MAX_NAME - 1, MAX_NAME):
        path = write_colmap_binary(tmp_path, ["a" * length, "b"]) / "images.bin"
        assert [len(image.name) for image in read_images(path)] == [length, 1]
    write_colmap_binary(tmp_path, ["a" * (MAX_NAME + 1), "b"])
    with pytest.raises(InputError, match="is empty, truncated"):
        read_images(path)


def test_intrinsics_follow_the_size_on_the_disk(tmp_path):
    """The camera file has twice or half the size, and the view does not change."""
    for factor in (2.0, 0.5):
        scene = tmp_path / f"{factor}"
        write_photographs(scene / "images")
        size, parameters = int(SIZE * factor), [0.9 * SIZE * factor] * 2 + [SIZE * factor / 2] * 2
        write_colmap_binary(scene / "sparse", parameters=parameters, size=(size, size))
        check_room(open_photographs(scene))


def test_missing_photographs_are_left_out_and_named(tmp_path, monkeypatch, capsys):
    write_photographs(tmp_path / "images")
    write_colmap_binary(tmp_path / "sparse")
    (tmp_path / "images" / "1.png").unlink()
    (tmp_path / "images" / "3.png").unlink()
    photographs = open_photographs(tmp_path)
    check_room(photographs, [0, 2, 4])
    (note,) = photographs.notes
    assert "2 of 5 photographs of" in note
    assert "are missing and left out: 1.png, 3.png" in note
    out = tmp_path.with_name(f"{tmp_path.name}-out")
    where = ("--context", 0, 1, "--target", 2, "--out", out)
    assert run(monkeypatch, "complete", tmp_path, *where, "--dry-run") == 0
    said = "".join(capsys.readouterr().err.split())
    assert "".join(note.split()) in said


def test_without_any_photograph_it_is_said_where_they_belong(tmp_path):
    write_colmap_binary(tmp_path / "sparse")
    with pytest.raises(InputError, match=r"None of the 5 .* folder `images` .* such as 0.png"):
        open_photographs(tmp_path)


def test_of_several_models_the_largest_is_opened(tmp_path):
    write_photographs(tmp_path / "images")
    write_colmap_binary(tmp_path / "sparse" / "0", NAMES[:2])
    write_colmap_text(tmp_path / "sparse" / "1")
    write_colmap_binary(tmp_path / "sparse" / "2", NAMES[:3])
    photographs = open_photographs(tmp_path)
    check_room(photographs)
    (note,) = photographs.notes
    assert "3 models lie in" in note
    assert "sparse: 1 with 5 images is used" in note


def test_of_a_model_and_others_in_its_folder_the_largest_is_opened(tmp_path):
    write_photographs(tmp_path / "images")
    home = write_colmap_text(tmp_path / "sparse")
    write_colmap_binary(home / "0", NAMES[:2])
    photographs = open_photographs(tmp_path)
    check_room(photographs)
    (note,) = photographs.notes
    assert note.startswith(
        f"2 models lie in {home}: the one in the folder itself with 5 images is used;"
    )


@pytest.mark.linux
def test_names_of_folders_split_no_sentence(tmp_path):
    scene = tmp_path / "a\nroom"
    write_photographs(scene / "images", NAMES[:1], VIEWS[:1])
    for model in "01":
        write_colmap_binary(scene / "sparse" / model)
    notes = open_photographs(scene).notes
    assert len(notes) == 2
    assert not any("\n" in note for note in notes)


def test_photographs_are_used_as_they_are_stored_and_that_is_said(tmp_path):
    write_photographs(tmp_path / "images")
    write_colmap_binary(tmp_path / "sparse")
    turned = Image.Exif()
    turned[0x0112] = 6
    for name in NAMES:
        Image.open(tmp_path / "images" / name).save(tmp_path / "images" / name, exif=turned)
    photographs = open_photographs(tmp_path)
    check_room(photographs)
    (note,) = photographs.notes
    assert "used as they are stored" in note
    (tmp_path / "images" / "0.png").write_bytes(b"no image")
    assert open_photographs(tmp_path).notes == ()


@pytest.mark.parametrize("features", ["1 2 -1 3 4 7", "", "\n", "#", "\n1 2 -1\n", "1 2 -1 " * 4])
def test_lines_of_features_may_be_empty_or_absent(tmp_path, features):
    write_photographs(tmp_path / "images")
    model = write_colmap_text(tmp_path / "sparse", features=features)
    check_room(open_photographs(tmp_path))
    # The last one is lost where an editor trims the end of the file.
    content = (model / "images.txt").read_text()
    (model / "images.txt").write_text(content.rstrip())
    check_room(open_photographs(tmp_path))


def test_lines_of_windows_are_lines(tmp_path):
    write_photographs(tmp_path / "images")
    model = write_colmap_text(tmp_path / "sparse")
    for path in model.glob("*.txt"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    photographs = open_photographs(tmp_path)
    check_room(photographs)
    assert photographs.points() is not None


def test_files_of_rigs_and_frames_change_nothing(tmp_path):
    write_photographs(tmp_path / "images")
    model = write_colmap_binary(tmp_path / "sparse" / "0")
    for name in ("rigs.bin", "frames.bin"):
        (model / name).write_bytes(b"\xff" * 100)
    check_room(open_photographs(tmp_path))


@pytest.mark.parametrize("write", [write_colmap_binary, write_colmap_text])
def test_points_lie_on_the_surfaces(tmp_path, write):
    write_photographs(tmp_path / "images")
    write(tmp_path / "sparse")
    points = open_photographs(tmp_path).points()
    assert points is not None
    assert torch.allclose(points.double(), torch.from_numpy(surface_points()), atol=1e-5)


def test_points_may_lie_in_a_ply_or_be_absent(tmp_path):
    write_photographs(tmp_path / "images")
    model = write_colmap_binary(tmp_path / "sparse")
    (model / "points3D.bin").unlink()
    assert open_photographs(tmp_path).points() is None
    write_cloud(model / "points3D.ply", surface_points())
    points = open_photographs(tmp_path).points()
    assert points is not None
    assert len(points) == len(surface_points())


FAR = np.array([5e6, 0.0, 0.0])


def test_points_are_told_from_the_origin_of_the_cameras(tmp_path):
    write_photographs(tmp_path / "images")
    model = write_colmap_binary(tmp_path / "sparse", points=surface_points() + FAR)
    content = bytearray((model / "images.bin").read_bytes())
    position = 8
    for camera, name in zip(CAMERAS, NAMES, strict=True):
        rotation = camera.c2w[:3, :3].double().numpy()
        center = camera.center.double().numpy() + FAR
        struct.pack_into("<3d", content, position + 36, *(-rotation.T @ center))
        position += 64 + len(name) + 1 + 8 + 48
    (model / "images.bin").write_bytes(content)
    photographs = open_photographs(tmp_path)
    points = photographs.points()
    assert points is not None
    offset = photographs.origin - FAR
    assert np.abs(offset).max() < 1
    assert np.allclose(points.double(), surface_points() - offset, atol=1e-5)


# Lenses.


LENS_SIZE = 160
LENS_NUMBERS = {
    "k1": -0.1,
    "k2": 0.04,
    "k3": -0.01,
    "k4": 0.005,
    "p1": 0.004,
    "p2": -0.006,
    "d1": 0.05,
    "d2": -0.02,
    "d3": 0.01,
    "s1": 0.005,
    "s3": -0.004,
    "k": -0.15,
    "omega": 0.9,
    "alpha": 0.55,
    "beta": 1.1,
    **dict.fromkeys(("f", "fx", "fy"), 0.9 * LENS_SIZE),
    **dict.fromkeys(("cx", "cy"), LENS_SIZE / 2),
}
"""A value for each parameter of COLMAP's models."""


@dataclass(frozen=True)
class BentCamera(Camera):
    """A camera with lens distortion."""

    lens: Distortion = Distortion()

    def z_rays(self):
        x = (torch.arange(self.width, dtype=torch.float64) + 0.5 - self.width / 2) / self.K[0, 0]
        bent = torch.stack(torch.meshgrid(x, x, indexing="xy"), dim=-1).numpy()
        straight = bent.copy()
        for _ in range(100):
            straight += bent - distort(straight, self.lens)
        rays = np.concatenate([straight, np.ones((*straight.shape[:2], 1))], axis=-1)
        return torch.from_numpy(rays).float() @ self.c2w[:3, :3].T


@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_photographs_of_every_lens_show_the_room_without_it(tmp_path, model):
    size = (LENS_SIZE, LENS_SIZE)
    parameters = [LENS_NUMBERS[name] for name in CAMERA_MODELS[model].parameters.split()]
    lens = build_intrinsics(CAMERA_MODELS[model], size, parameters, "the camera").distortion
    straight = camera_at(size=LENS_SIZE)
    photograph, _ = cast(Room(), BentCamera(straight.c2w, straight.K, *size, lens=lens))
    (tmp_path / "images").mkdir()
    write_image(tmp_path / "images" / "0.png", photograph)
    write_colmap_binary(tmp_path / "sparse", ["0.png"], model, parameters, size)
    (view,) = open_photographs(tmp_path).views([0])
    seen = view_of(Room(), view.camera).image
    error = (view.image - seen).abs().mean()
    assert error < 0.01
    if lens:
        assert (photograph - seen).abs().mean() > 3 * error


@pytest.mark.parametrize(
    ("number", "name", "advice"),
    [
        (11, "RAD_TAN_THIN_PRISM_FISHEYE", "`colmap image_undistorter`"),
        (17, "EQUIRECTANGULAR", "split the panoramas into perspective images"),
        (99, "99", "`colmap image_undistorter`"),
    ],
)
def test_a_lens_that_is_not_known_is_refused_with_what_to_do(tmp_path, number, name, advice):
    write_photographs(tmp_path / "images")
    model = write_colmap_binary(tmp_path / "sparse")
    content = bytearray((model / "cameras.bin").read_bytes())
    struct.pack_into("<i", content, 12, number)
    (model / "cameras.bin").write_bytes(content)
    with pytest.raises(InputError, match=f"camera model {name} of camera 7 .* {advice}") as binary:
        open_photographs(tmp_path)
    if name != str(number):
        for file in model.iterdir():
            file.unlink()
        write_colmap_text(model)
        (model / "cameras.txt").write_text(f"7 {name} 64 32 64 32")
        with pytest.raises(InputError) as text:
            open_photographs(tmp_path)
        assert str(text.value) == str(binary.value).replace("cameras.bin", "cameras.txt")


def test_all_camera_models_of_colmap_are_known_by_name():
    """Also those that are not read."""
    pycolmap = pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    names = {int(model): name for name, model in pycolmap.CameraModelId.__members__.items()}
    assert names.pop(-1) == "INVALID"
    assert names.items() <= CAMERA_MODEL_NAMES.items()


# Damage.


def packed(path: Path, form: str, offset: int, *values: float) -> None:
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, offset, *values)
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("name", "form", "offset", "value", "sentence"),
    [
        ("cameras.bin", "<Q", 0, 10**18, "is empty, truncated or"),
        ("cameras.bin", "<Q", 0, 2**64 - 1, "is empty, truncated or"),
        ("cameras.bin", "<I", 8, 8, "taken by camera 7, which is not in the cameras file"),
        ("cameras.bin", "<Q", 16, 10**12, "The size of camera 7"),
        ("cameras.bin", "<Q", 24, 0, "The size of camera 7"),
        ("cameras.bin", "<d", 32, float("nan"), "parameter fx of camera 7 .* is nan"),
        ("cameras.bin", "<d", 32, 0.0, "focal length is 0 times the size"),
        ("images.bin", "<Q", 0, 2**63, "is empty, truncated or"),
        ("images.bin", "<Q", 0, 0, "lists no images"),
        ("images.bin", "<Q", 78, 2**61, "is empty, truncated or"),
        ("images.bin", "<d", 44, 1e300, "above 1e"),
        ("points3D.bin", "<Q", 0, 10**15, "is empty, truncated or"),
        ("points3D.bin", "<Q", 51, 10**15, "is empty, truncated or"),
    ],
)
def test_binary_files_are_believed_as_far_as_they_go(tmp_path, name, form, offset, value, sentence):
    write_photographs(tmp_path / "images")
    model = write_colmap_binary(tmp_path / "sparse")
    packed(model / name, form, offset, value)
    with pytest.raises(InputError, match=sentence) as error:
        photographs = open_photographs(tmp_path)
        photographs.views([0])
        photographs.points()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("values", [[float("inf")], [0.0] * 4], ids=["infinite", "no rotation"])
def test_a_camera_with_an_impossible_rotation_is_left_out(tmp_path, values):
    write_photographs(tmp_path / "images")
    model = write_colmap_binary(tmp_path / "sparse")
    packed(model / "images.bin", f"<{len(values)}d", 12, *values)
    photographs = open_photographs(tmp_path)
    assert len(photographs.posed) == len(NAMES) - 1
    assert any("NaN" in note for note in photographs.notes)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_truncated_and_empty_files_are_refused(tmp_path, name):
    write_photographs(tmp_path / "images")
    model = write_colmap_binary(tmp_path / "sparse")
    whole = (model / name).read_bytes()
    # The last ones end within and before the pairs of the last track.
    for length in (0, 3, 20, len(whole) // 2, *(len(whole) - cut for cut in (16, 8, 1))):
        (model / name).write_bytes(whole[:length])
        with pytest.raises(InputError, match=f"{name} is empty, truncated"):
            open_photographs(tmp_path).points()


@pytest.mark.parametrize(
    ("name", "line", "sentence"),
    [
        ("cameras.txt", "7 PINHOLE 64", "line 1 of .*cameras.txt is '7 PINHOLE 64', where CAM"),
        ("cameras.txt", "7 PINHOLE 64 64 50 50 32", "model of camera 7 .* 4 parameters .* 3 are"),
        ("cameras.txt", "7 PANORAMA 64 64 50", "camera model PANORAMA of camera 7"),
        ("cameras.txt", "7 PINHOLE 64 64 50 x 32 32", "line 1 of .*cameras.txt"),
        ("cameras.txt", "7 PINHOLE 64 64 50 1e400 32 32", "parameter fy of camera 7 .* is inf"),
        ("cameras.txt", "", "taken by camera 7, which is not in"),
        ("images.txt", "1 1 0 0 0 0 0 0", "line 1 of .*images.txt .* IMAGE_ID"),
        ("images.txt", "1 1 0 0 0 0 zero 0 7 0.png", "line 1 of .*images.txt"),
        ("images.txt", "", "lists no images"),
        (
            "images.txt",
            "1 1 0 0 0 0 0 0 7 0.png\n\n2 1 0 0 0 1 0 0 7 0.png",
            "lists an image twice",
        ),
        ("images.txt", "1 0 0 0 0 0 0 0 7 0.png", "poses of all 1 cameras .* hold NaN"),
        ("points3D.txt", "1 2", "line 1 of .*points3D.txt .* POINT3D_ID"),
        ("points3D.txt", "1 2 3 four 5", "line 1 of .*points3D.txt"),
    ],
)
def test_a_damaged_line_is_named(tmp_path, name, line, sentence):
    write_photographs(tmp_path / "images")
    model = write_colmap_text(tmp_path / "sparse")
    (model / name).write_text(line + "\n")
    with pytest.raises(InputError, match=sentence) as error:
        photographs = open_photographs(tmp_path)
        photographs.views([0])
        photographs.points()
    assert "\n" not in str(error.value)


def test_masks_and_photographs_of_a_lens_are_undistorted_together(tmp_path):
    """A masked object of the photograph is masked in the undistorted one."""
    parameters = [0.9 * SIZE, SIZE / 2, SIZE / 2, -0.2]
    write_colmap_binary(tmp_path / "sparse", ["0.png"], "SIMPLE_RADIAL", parameters)
    dark = np.zeros((SIZE, SIZE), np.uint8)
    dark[20:40, 10:50] = 255
    for folder, name in (("images", "0.png"), ("masks", "0.png.png")):
        (tmp_path / folder).mkdir()
        Image.fromarray(dark).save(tmp_path / folder / name)
    photographs = open_photographs(tmp_path)
    (view,) = photographs.views([0])
    # Hidden pixels have the colours of what is around them.
    (whole,) = photographs.leave_out_masks().views([0])
    mask = view.ignore_mask
    assert mask is not None
    assert ((whole.image.mean(-1) < 0.5) != mask).float().mean() < 0.03
    assert view.image.mean(-1).min() > 0.5


def epipolar_error(first: View, second: View) -> float:
    """Return the median distance of SIFT matches from their epipolar lines, in pixels."""
    sift = cv2.SIFT_create(2000)
    grey = [(view.image.mean(-1) * 255).to(torch.uint8).numpy() for view in (first, second)]
    (keys, ours), (others, theirs) = (sift.detectAndCompute(image, None) for image in grey)
    pairs = [
        a for a, b in cv2.BFMatcher().knnMatch(ours, theirs, k=2) if a.distance < b.distance / 2
    ]
    # OpenCV puts the centre of the top-left pixel at (0, 0).
    p = np.array([[*keys[pair.queryIdx].pt, 0.5] for pair in pairs]) + 0.5
    q = np.array([[*others[pair.trainIdx].pt, 0.5] for pair in pairs]) + 0.5
    K1, K2, c2w1, c2w2 = (
        value.double().numpy()
        for value in (first.camera.K, second.camera.K, first.camera.c2w, second.camera.c2w)
    )
    relative = np.linalg.inv(c2w2) @ c2w1
    essential = np.cross(relative[:3, 3], relative[:3, :3].T).T
    lines = p @ (np.linalg.inv(K2).T @ essential @ np.linalg.inv(K1)).T
    distances = np.abs((lines * q).sum(-1)) / np.linalg.norm(lines[:, :2], axis=-1)
    return float(np.median(distances))


# `check_room` compares cameras of synthetic scenes.
@pytest.mark.slow
def test_features_of_a_real_scene_lie_on_the_epipolar_lines_of_every_file(shared):
    fox = shared / "splats" / "fox"
    if not fox.is_dir():
        pytest.skip(f"needs {fox}")
    places = (fox, fox / "distorted", fox / "cameras.json", shared / "data" / "fox")
    for path in places:
        assert epipolar_error(*open_photographs(path).views([0, 2])) < 0.4, path


def test_points_of_a_real_scene_enclose_it(shared):
    fox = shared / "splats" / "fox"
    if not fox.is_dir():
        pytest.skip(f"needs {fox}")
    photographs = add_depth_range(open_photographs(fox), [0, 4])
    assert (photographs.near, photographs.far) == (pytest.approx(2.3, 0.1), pytest.approx(17, 0.1))

"""Data sets of depth cameras, of multi-view stereo and of surfaces: depth, masks, and mistakes."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gscompleter import InputError
from gscompleter.data.formats import open_photographs
from gscompleter.data.multi_view_stereo import open_idr
from measured_photographs import give_depths
from pose_files import SIZE, VIEWS, idr, mvsnet, replica, scannet


@pytest.mark.parametrize(("write", "unit"), [(scannet, 1e-3), (replica, 1e-4), (mvsnet, 1e-6)])
def test_depth_is_read_in_the_unit_of_the_poses(tmp_path, write, unit):
    photographs = open_photographs(write(tmp_path))
    assert photographs.unused == ()
    (view,) = photographs.views([2])
    assert (view.depth - VIEWS[2].depth).abs().max() < unit
    (given,) = give_depths(photographs, [2])
    assert (given.given_depth > 0).float().mean() > 0.5


def test_photographs_without_tracking_keep_their_numbers(tmp_path):
    scannet(tmp_path)
    (tmp_path / "pose/1.txt").write_text("-inf -inf -inf -inf\n" * 4)
    (tmp_path / "pose/3.txt").unlink()
    photographs = open_photographs(tmp_path)
    assert photographs.posed == [0, 2, 4]
    assert any("1 of 5 cameras" in note for note in photographs.notes)
    with pytest.raises(InputError, match="it has no pose; name another one"):
        photographs.views(["3.png"])


def test_the_numbers_of_scannet_are_in_order(tmp_path):
    scannet(tmp_path)
    for folder, ending in (("color", "png"), ("pose", "txt"), ("depth", "png")):
        (tmp_path / folder / f"1.{ending}").rename(tmp_path / folder / f"10.{ending}")
    names = [frame.file_name for frame in open_photographs(tmp_path).frames]
    assert names == [f"color/{number}.png" for number in (0, 2, 3, 4, 10)]


def test_masks_of_idr_are_read_and_the_object_stays(tmp_path):
    idr(tmp_path)
    mask = Image.new("L", (SIZE, SIZE), 255)
    mask.paste(0, (0, 0, SIZE, SIZE // 4))
    (tmp_path / "mask").mkdir()
    mask.save(tmp_path / "mask" / "000001.png")
    (view,) = open_photographs(tmp_path).views([1])
    assert view.ignore_mask.float().mean() == 0.25


@pytest.mark.parametrize(("write", "name"), [(idr, "cameras_sphere.npz"), (replica, "traj.txt")])
def test_the_file_of_all_poses_stands_for_its_folder(tmp_path, monkeypatch, write, name):
    folder = write(tmp_path / "scene")
    whole, named = open_photographs(folder), open_photographs(folder / name)
    monkeypatch.chdir(folder)
    beside = open_photographs(Path(name))
    for photographs in (named, beside):
        assert (photographs.name, photographs.format) == ("scene", whole.format)
        assert [one.file_name for one in photographs.frames] == [
            one.file_name for one in whole.frames
        ]
        assert torch.equal(photographs.camera(1).c2w, whole.camera(1).c2w)


def test_one_of_two_files_of_cameras_is_opened_by_its_name(tmp_path):
    idr(tmp_path)
    (tmp_path / "cameras.npz").write_bytes(b"PK")
    assert len(open_photographs(tmp_path / "cameras_sphere.npz")) == len(VIEWS)
    with pytest.raises(InputError, match=r"cameras\.npz is no archive of matrices"):
        open_photographs(tmp_path / "cameras.npz")


def test_real_cameras_of_dtu_are_read(shared, tmp_path):
    file = shared / "formats" / "idr_dtu" / "cameras_sphere.npz"
    if not file.is_file():
        pytest.skip(f"needs {file}")
    (tmp_path / "cameras_sphere.npz").write_bytes(file.read_bytes())
    (tmp_path / "image").mkdir()
    for number in range(3):
        Image.new("RGB", (1600, 1200)).save(tmp_path / "image" / f"{number:06d}.png")
    (photographs,) = open_idr(tmp_path)
    with np.load(file) as matrices:
        scale = matrices["scale_mat_0"]
    for number in range(3):
        camera = photographs.camera(number)
        # The centre of the sphere around the object is seen near the middle of the image.
        middle = np.append(scale[:3, 3], 1.0)
        x, y, z = (
            camera.K.double().numpy() @ np.linalg.inv(camera.c2w.double().numpy())[:3] @ middle
        )
        assert z > 300
        assert 400 < x / z < 1200
        assert 300 < y / z < 900
        assert 2800 < camera.K[0, 0] < 3000


def cut(path: Path, count: int) -> None:
    """Cut the last bytes of a file off."""
    path.write_bytes(path.read_bytes()[:-count])


def spoil_zip(path: Path) -> None:
    """Replace the first matrix by one of too many numbers."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("world_mat_0.npy", b"\0" * 10**7)


WRONG = {
    "a pose of words": (
        scannet,
        lambda f: (f / "pose/1.txt").write_text("a b"),
        r"pose/1\.txt holds other text than numbers",
    ),
    "half a lens": (
        scannet,
        lambda f: (f / "intrinsic/intrinsic_color.txt").write_text("1 2"),
        "intrinsic_color.txt holds 2 numbers, and 4 × 4 numbers are needed",
    ),
    "an infinite lens": (
        scannet,
        lambda f: (f / "intrinsic/intrinsic_color.txt").write_text("inf " * 16),
        "inf",
    ),
    "a trajectory without poses": (
        replica,
        lambda f: (f / "traj.txt").write_text("\n"),
        r"traj\.txt is empty",
    ),
    "half a row": (
        replica,
        lambda f: (f / "traj.txt").write_text("1 " * 24),
        "holds 24 numbers, and rows of 16 numbers are needed",
    ),
    "a huge number": (
        replica,
        lambda f: (f / "traj.txt").write_text("1e30 " * 16),
        r"holds a number of 1e\+30, and 1e\+12 is the largest",
    ),
    "a pose too few": (
        replica,
        lambda f: (f / "traj.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n"),
        "has 1 poses, and .* 5 photographs",
    ),
    "no scale": (replica, lambda f: (f / "cam_params.json").write_text("{}"), "camera"),
    "half a camera": (mvsnet, lambda f: cut(f / "cams/00000001_cam.txt", 130), "00000001_cam"),
    "half a depth map": (
        mvsnet,
        lambda f: cut(f / "rendered_depth_maps/00000001.pfm", 9),
        "is no depth map",
    ),
    "no archive": (idr, lambda f: cut(f / "cameras_sphere.npz", 40), "no archive of matrices"),
    "a large matrix": (idr, lambda f: spoil_zip(f / "cameras_sphere.npz"), "no archive of matrice"),
    "a camera too many": (
        idr,
        lambda f: (f / "image/000004.png").unlink(),
        "has 5 cameras, and .* 4 photographs",
    ),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_mistake_is_a_sentence(tmp_path, kind):
    write, spoil, sentence = WRONG[kind]
    spoil(write(tmp_path))
    with pytest.raises(InputError, match=sentence) as error:
        open_photographs(tmp_path).views(range(5))
    assert "\n" not in str(error.value)

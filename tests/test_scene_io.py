"""Scene folders: what is read is exactly what was meant, and what is wrong is said."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gscompleter import InputError, load_camera, load_cameras, load_views
from gscompleter.geometry import inside, project, sample, unproject
from gscompleter.io.files import output_folder
from gscompleter.io.scene import write_cameras
from scenes import camera_at

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_scene(folder: Path, images: dict[str, np.ndarray], **extra) -> Path:
    """A scene of identity poses, 1 m apart, with fl 50 px."""
    folder.mkdir(exist_ok=True)
    frames = []
    for number, (name, pixels) in enumerate(images.items()):
        Image.fromarray(pixels).save(folder / name)
        pose = np.eye(4)
        pose[0, 3] = number
        frames.append({"file_path": name, "transform_matrix": (pose @ OPENGL).tolist()})
    h, w = next(iter(images.values())).shape[:2]
    content = {"fl_x": 50.0, "fl_y": 50.0, "cx": w / 2, "cy": h / 2, "w": w, "h": h}
    (folder / "transforms.json").write_text(json.dumps({**content, **extra, "frames": frames}))
    return folder


def noise(h: int = 40, w: int = 60, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (h, w, 3), dtype=np.uint8)


def test_opengl_poses_become_opencv_ones(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise(), "b.png": noise(seed=1)})
    views = load_views(scene)
    assert torch.allclose(views[1].camera.c2w[:3, :3], torch.eye(3))
    assert views[1].camera.center.tolist() == [1.0, 0.0, 0.0]
    assert np.array_equal((views[1].image * 255).round().numpy(), noise(seed=1))


def test_frames_are_numbered_in_the_order_of_their_sorted_paths(tmp_path):
    scene = write_scene(tmp_path / "s", {"z.png": noise(seed=3), "a.png": noise(seed=4)})
    (first,) = load_views(scene, [0])
    assert first.frame == 0
    assert np.array_equal((first.image * 255).round().numpy(), noise(seed=4))


def test_resizing_to_cover_and_cropping_keep_the_intrinsics_exact(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise(40, 60)})
    (view,) = load_views(scene, resolution=(20, 20))
    camera = view.camera
    assert view.image.shape == (20, 20, 3)
    # 40 x 60 is halved to 20 x 30; five columns are cropped on either side.
    assert (camera.K[0, 0], camera.K[1, 1]) == (25.0, 25.0)
    assert (camera.K[0, 2], camera.K[1, 2]) == (10.0, 10.0)
    assert load_camera(scene, 0, (20, 20)).K.tolist() == camera.K.tolist()


def test_intrinsics_follow_the_size_of_the_photograph(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise(40, 60)}, w=120, h=80)
    camera = load_views(scene)[0].camera
    assert camera.K[0, 0] == 25.0


def test_distortion_is_removed_and_straight_lines_become_straight(tmp_path):
    """A fisheye-like bend of a grid: after undistortion the grid's columns are columns again."""
    h, w, f, k1 = 120, 160, 100.0, -0.2
    y, x = np.mgrid[0:h, 0:w] + 0.5
    # For each distorted pixel find the straight one by fixed-point iteration.
    u, v = (x - w / 2) / f, (y - h / 2) / f
    a, b = u.copy(), v.copy()
    for _ in range(50):
        factor = 1 + k1 * (a * a + b * b)
        a, b = u / factor, v / factor
    bars = (np.floor((a * f + w / 2) / 10) % 2 * 255).astype(np.uint8)
    scene = write_scene(tmp_path / "s", {"a.png": np.stack([bars] * 3, -1)}, fl_x=f, fl_y=f, k1=k1)
    content = json.loads((scene / "transforms.json").read_text())
    content["camera_model"] = "OPENCV"
    (scene / "transforms.json").write_text(json.dumps(content))
    (view,) = load_views(scene)
    grey = view.image.mean(-1)
    inner = grey[10:-10, 10:-10]
    # Straight bars: a column is of one colour, but for those at the edges of the bars.
    raw = torch.from_numpy(bars / 255.0)[10:-10, 10:-10]
    assert inner.std(dim=0).mean() < 0.3 * raw.std(dim=0).mean()


def test_depth_maps_are_read_in_scene_units(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise()})
    Image.fromarray(np.full((40, 60), 2500, np.uint16)).save(scene / "d.png")
    content = json.loads((scene / "transforms.json").read_text())
    content["frames"][0]["depth_file_path"] = "d.png"
    content["depth_unit_scale_factor"] = 0.001
    (scene / "transforms.json").write_text(json.dumps(content))
    (view,) = load_views(scene, resolution=(20, 20))
    assert torch.allclose(view.depth, torch.full((20, 20), 2.5))


def test_cameras_are_written_and_read_back_bit_for_bit(tmp_path):
    cameras = [camera_at(0.3, 0.1, yaw=20), camera_at(-1.7, yaw=-33)]
    write_cameras(tmp_path / "targets.json", cameras)
    for ours, theirs in zip(cameras, load_cameras(tmp_path / "targets.json"), strict=True):
        assert torch.allclose(ours.c2w, theirs.c2w, atol=1e-6)
        assert torch.equal(ours.K, theirs.K)
        assert (ours.width, ours.height) == (theirs.width, theirs.height)


def test_near_and_far_are_put_on_every_camera(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise()})
    camera = load_views(scene, near=0.5, far=9.0)[0].camera
    assert (camera.near, camera.far) == (0.5, 9.0)


@pytest.mark.parametrize(
    ("near", "far"), [(5.0, 1.0), (0.0, 1.0), (-1.0, 1.0), (math.nan, 1.0), (1.0, math.nan)]
)
def test_an_impossible_depth_range_is_refused(tmp_path, near, far):
    scene = write_scene(tmp_path / "s", {"a.png": noise()})
    with pytest.raises(InputError):
        load_views(scene, near=near, far=far)


def changed(scene: Path, change) -> Path:
    content = json.loads((scene / "transforms.json").read_text())
    change(content)
    (scene / "transforms.json").write_text(json.dumps(content))
    return scene


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda c: c.pop("frames"), "frames"),
        (lambda c: c["frames"][0].pop("transform_matrix"), "transform_matrix"),
        (lambda c: c["frames"][0].update(transform_matrix=[[1, 2], [3, 4]]), "transform_matrix"),
        (lambda c: c.update(w=0), "w"),
        (lambda c: c.update(fl_x="wide"), "fl_x"),
        (lambda c: c.update(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
    ],
)
def test_a_wrong_transforms_json_is_refused(tmp_path, change, sentence):
    scene = changed(write_scene(tmp_path / "s", {"a.png": noise()}), change)
    with pytest.raises(InputError, match=sentence):
        load_views(scene)


def test_a_folder_without_a_json_and_one_that_is_no_json_are_refused(tmp_path):
    with pytest.raises(InputError, match="transforms.json"):
        load_views(tmp_path)
    (tmp_path / "transforms.json").write_text("{")
    with pytest.raises(InputError, match="JSON"):
        load_views(tmp_path)


def test_an_output_folder_appears_whole_or_not_at_all(tmp_path):
    out = tmp_path / "deep" / "out"
    with pytest.raises(RuntimeError), output_folder(out) as folder:
        (folder / "a.txt").write_text("half")
        raise RuntimeError
    assert not (tmp_path / "deep").exists()
    with output_folder(out) as folder:
        (folder / "a.txt").write_text("whole")
    assert (out / "a.txt").read_text() == "whole"
    with pytest.raises(InputError, match="not empty"), output_folder(out):
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError), output_folder(tmp_path / "file" / "out"):
        pass


SCENES = ("re10k_0d4de33c", "open3d_rgbd", "fox", "fountain_p11", "kitti_city", "hololens_room")


@pytest.mark.parametrize("name", SCENES)
def test_real_scenes_load(shared, name):
    for view in load_views(shared / "data" / name, [0, 2], (256, 256)):
        assert view.image.shape == (256, 256, 3)
        assert 0.05 < view.image.mean() < 0.95


@pytest.mark.parametrize(("name", "frames"), [("open3d_rgbd", [0, 2]), ("hololens_room", [0, 1])])
def test_true_depth_carries_pixels_from_one_photograph_to_the_next(shared, name, frames):
    """Axes, intrinsics and depth are right together or not at all."""
    a, b = load_views(shared / "data" / name, frames, (256, 256))
    pixels, z = project(unproject(a.depth, a.camera), b.camera)
    seen = (a.depth > 0) & inside(pixels, z, b.camera)
    error = (sample(b.image, pixels) - a.image).abs().mean(-1)[seen].median()
    unmoved = (b.image - a.image).abs().mean(-1)[seen].median()
    assert seen.float().mean() > 0.3
    assert error < 0.06
    assert error < 0.8 * unmoved

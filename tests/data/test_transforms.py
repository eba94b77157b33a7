"""`transforms.json` scenes: values are read exactly, and errors name what is wrong."""

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gscompleter import InputError, load_camera, load_cameras, load_views
from gscompleter.data.formats import open_photographs
from gscompleter.data.scene import write_cameras
from gscompleter.numerics.geometry import is_inside, project, sample, unproject
from gscompleter.system.files.output_folder import open_output_folder
from scenes import camera_at

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_scene(folder: Path, images: dict[str, np.ndarray], **extra) -> Path:
    """Write a scene of identity poses, 1 m apart, with a focal length of 50 px."""
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
        (lambda c: c.update(camera_model="FISHEYE624"), "'FISHEYE624' .* undistort the images"),
        (
            lambda c: c.update(camera_model="EQUIRECTANGULAR"),
            "'EQUIRECTANGULAR' .* split the panoramas into perspective images",
        ),
    ],
)
def test_a_wrong_transforms_json_is_refused(tmp_path, change, sentence):
    scene = changed(write_scene(tmp_path / "s", {"a.png": noise()}), change)
    with pytest.raises(InputError, match=sentence):
        load_views(scene)


def test_a_folder_without_a_json_and_one_that_is_no_json_are_refused(tmp_path):
    with pytest.raises(InputError, match="nerfstudio"):
        load_views(tmp_path)
    (tmp_path / "transforms.json").write_text("{")
    with pytest.raises(InputError, match="JSON"):
        load_views(tmp_path)


def test_an_output_folder_appears_whole_or_not_at_all(tmp_path):
    out = tmp_path / "deep" / "out"
    with pytest.raises(RuntimeError), open_output_folder(out) as folder:
        (folder / "a.txt").write_text("half")
        raise RuntimeError
    assert not (tmp_path / "deep").exists()
    with open_output_folder(out) as folder:
        (folder / "a.txt").write_text("whole")
    assert (out / "a.txt").read_text() == "whole"
    with pytest.raises(InputError, match="not empty"), open_output_folder(out):
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError), open_output_folder(tmp_path / "file" / "out"):
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
    seen = (a.depth > 0) & is_inside(pixels, z, b.camera)
    error = (sample(b.image, pixels) - a.image).abs().mean(-1)[seen].median()
    unmoved = (b.image - a.image).abs().mean(-1)[seen].median()
    assert seen.float().mean() > 0.3
    assert error < 0.06
    assert error < 0.8 * unmoved


def turned(degrees: float) -> np.ndarray:
    """Return a camera-to-world matrix rotated about the vertical axis, in nerfstudio's axes."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, 0, s, 0.3], [0, 1, 0, -0.2], [-s, 0, c, 2.0], [0, 0, 0, 1]])


def scaled_pose() -> np.ndarray:
    return turned(20) @ np.diag([1.01, 1.01, 1.01, 1])


def sheared_pose() -> np.ndarray:
    shear = np.eye(4)
    shear[0, 1] = 0.1
    return turned(20) @ shear


def projective_pose() -> np.ndarray:
    pose = turned(20)
    pose[3, 0] = 0.5
    return pose


@pytest.mark.parametrize(
    ("pose", "sentence"),
    [
        (scaled_pose(), "not a rigid transform but scaled"),
        (sheared_pose(), "not a rigid transform but scaled, sheared"),
        (projective_pose(), "projective"),
        (turned(20) @ np.diag([-1, 1, 1, 1]), "reflection"),
        (np.full((4, 4), math.nan), "NaN"),
        (np.zeros((4, 4)), "not a rigid transform"),
        (np.eye(3), "no list of 3 × 4 or 4 × 4 numbers"),
        ("identity", "no list of 3 × 4 or 4 × 4 numbers"),
        ([[1, 0, 0, 0], [0, 1], [0, 0, 1, 0]], "no list of 3 × 4 or 4 × 4 numbers"),
    ],
)
def test_a_pose_that_is_no_rigid_transform_is_refused(tmp_path, pose, sentence):
    scene = write_scene(tmp_path / "s", {"a.png": noise()})
    matrix = pose.tolist() if isinstance(pose, np.ndarray) else pose
    changed(scene, lambda c: c["frames"][0].update(transform_matrix=matrix))
    with pytest.raises(InputError, match=sentence) as error:
        load_views(scene)
    assert "a.png" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_pose_of_three_rows_is_one_of_four(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise()})
    changed(scene, lambda c: c["frames"][0].update(transform_matrix=turned(30).tolist()))
    four = load_camera(scene, 0).c2w
    changed(scene, lambda c: c["frames"][0].update(transform_matrix=turned(30)[:3].tolist()))
    assert torch.equal(load_camera(scene, 0).c2w, four)
    # A turn by 30 degrees about nerfstudio's y, which points up, is one by -30 about ours.
    assert torch.allclose(four[:3, 2], torch.tensor([-0.5, 0.0, -math.sqrt(0.75)]))


def test_a_slightly_inexact_rotation_becomes_exact(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise()})
    pose = turned(30)
    pose[:3, :3] *= 1.0003
    changed(scene, lambda c: c["frames"][0].update(transform_matrix=pose.tolist()))
    c2w = load_camera(scene, 0).c2w.double().numpy()
    assert np.allclose(c2w[:3, :3], (turned(30) @ OPENGL)[:3, :3], atol=1e-7)
    assert np.allclose(c2w[:3, 3], [0.3, -0.2, 2.0])


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda c: c.update(frames=[]), "lists no frames"),
        (lambda c: c.update(frames={"a": 1}), "lists no frames"),
        (lambda c: c.update(frames=["a.png"]), "`transform_matrix` of frame 0"),
        (lambda c: c.update(fl_x=0), "`fl_x` .* is 0; a number from"),
        (lambda c: c.update(fl_y=-3.0), "`fl_y` .* is -3.0; a number from"),
        (lambda c: c.update(fl_x=math.nan), "`fl_x` .* is nan; a number from"),
        (lambda c: c["frames"][0].update(fl_x=0), "`fl_x` of frame a.png"),
        (lambda c: (c.pop("fl_x"), c.pop("fl_y")), "focal length .* missing"),
        (lambda c: c.update(cx="middle"), "`cx`"),
        (lambda c: c.update(h=-40), "`h` .* is -40; a number from 1 to 16384"),
        (lambda c: c.update(w=60.5), "whole numbers"),
        (lambda c: c.update(k1=0.1, k4=0.2), "k4"),
        (lambda c: c.update(depth_unit_scale_factor=0), "depth_unit_scale_factor"),
        (lambda c: c["frames"][0].update(file_path=7), "file_path"),
        (lambda c: c["frames"][0].pop("file_path"), "image of frame 0 .* missing"),
        (
            lambda c: c["frames"][0].update(file_path="gone.png"),
            "image of frame gone.png .* missing",
        ),
        (lambda c: c["frames"][0].update(depth_file_path="gone.png"), "gone.png cannot be read"),
        (lambda c: c["frames"][0].update(depth_file_path="a.png"), "is no depth map"),
        (lambda c: c["frames"][0].update(depth_file_path="transforms.json"), "is not an image"),
        (lambda c: c["frames"][0].update(file_path="transforms.json"), "not an image"),
    ],
)
def test_every_impossible_entry_has_its_sentence(tmp_path, change, sentence):
    scene = changed(write_scene(tmp_path / "s", {"a.png": noise()}), change)
    with pytest.raises(InputError, match=sentence) as error:
        load_views(scene)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", ["[]", "null", "3", '"frames"', "{", "", "\x00\xff"])
def test_what_is_no_object_in_json_is_refused(tmp_path, content):
    (tmp_path / "transforms.json").write_text(content, encoding="latin-1")
    with pytest.raises(InputError, match="JSON|object"):
        load_views(tmp_path)


def test_a_scene_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="There is no .*nowhere; name"):
        load_views(tmp_path / "nowhere")
    with pytest.raises(InputError, match="nowhere.json cannot be read: No such file"):
        load_cameras(tmp_path / "nowhere.json")


@pytest.mark.parametrize("number", [2, 99, -1])
def test_a_frame_out_of_range_is_refused_with_the_range(tmp_path, number):
    scene = write_scene(tmp_path / "s", {"a.png": noise(), "b.png": noise()})
    with pytest.raises(InputError, match=f"no frame {number} .* numbered 0 to 1"):
        load_views(scene, [0, number])
    with pytest.raises(InputError, match=f"no frame {number} "):
        load_camera(scene, number)


@pytest.mark.parametrize("resolution", [(0, 20), (20, 0), (-1, 20)])
def test_an_impossible_resolution_is_refused(tmp_path, resolution):
    scene = write_scene(tmp_path / "s", {"a.png": noise()})
    with pytest.raises(InputError, match="resolution"):
        load_views(scene, resolution=resolution)


def test_a_resolution_may_be_a_whole_number_of_numpy(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise()})
    (wanted,) = load_views(scene, resolution=8)
    (view,) = load_views(scene, resolution=np.int64(8))
    assert torch.equal(view.image, wanted.image)


def test_one_frame_needs_no_choice_and_several_do(tmp_path):
    one = write_scene(tmp_path / "one", {"a.png": noise()})
    assert torch.equal(load_camera(one / "transforms.json").c2w, load_camera(one, 0).c2w)
    two = write_scene(tmp_path / "two", {"a.png": noise(), "b.png": noise()})
    with pytest.raises(InputError, match="2 frames; choose one, from 0 to 1"):
        load_camera(two)


def test_a_truncated_photograph_is_refused(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise()})
    whole = (scene / "a.png").read_bytes()
    (scene / "a.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="a.png is not an image"):
        load_views(scene)


def test_only_the_frames_asked_for_are_read(tmp_path):
    scene = write_scene(tmp_path / "s", {f"{i}.png": noise(seed=i) for i in range(4)})
    for unread in ("1.png", "2.png"):
        (scene / unread).unlink()
    views = load_views(scene, [3, 0])
    assert [view.frame for view in views] == [3, 0]
    assert torch.equal(views[1].image, load_views(scene, [0])[0].image)


def test_a_camera_needs_no_photograph_where_its_size_is_given(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise()})
    with_photograph = load_camera(scene, 0, (20, 20))
    (scene / "a.png").unlink()
    assert torch.equal(load_camera(scene, 0, (20, 20)).K, with_photograph.K)
    changed(scene, lambda c: (c.pop("w"), c.pop("h")))
    with pytest.raises(InputError, match="size of frame a.png .* not known"):
        load_camera(scene, 0)


def test_a_list_of_cameras_keeps_its_order_and_needs_no_paths(tmp_path):
    cameras = [camera_at(x) for x in (0.3, -0.2, 0.1)]
    write_cameras(tmp_path / "c.json", cameras, ["z.png", "m.png", "a.png"])
    loaded = load_cameras(tmp_path / "c.json", near=0.5, far=9.0)
    assert [camera.center[0].item() for camera in loaded] == pytest.approx([0.3, -0.2, 0.1])
    assert (loaded[2].near, loaded[2].far) == (0.5, 9.0)
    write_cameras(tmp_path / "c.json", cameras)
    assert torch.equal(load_camera(tmp_path / "c.json", 1).c2w, cameras[1].c2w)


def test_poses_are_written_and_read_back_bit_for_bit(tmp_path):
    cameras = [camera_at(0.3, 0.1, yaw=yaw) for yaw in (-77, -5, 0, 20, 133)]
    write_cameras(tmp_path / "c.json", cameras)
    for ours, theirs in zip(cameras, load_cameras(tmp_path / "c.json"), strict=True):
        assert torch.equal(ours.c2w, theirs.c2w)


def test_an_opening_angle_stands_for_a_focal_length(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise(40, 60)})
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    changed(scene, lambda c: ([c.pop(key) for key in keys], c.update(camera_angle_x=math.pi / 2)))
    # Half of 60 pixels is seen under 45 degrees; pixels are square, and the centre is the middle.
    assert torch.allclose(
        load_camera(scene, 0).K, torch.tensor([[30.0, 0, 30], [0, 30, 20], [0, 0, 1]])
    )


def test_intrinsics_of_a_frame_win_over_those_of_the_scene(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise(), "b.png": noise()})
    changed(scene, lambda c: c["frames"][1].update(fl_x=70.0, cx=31.0))
    assert load_camera(scene, 0).K[0].tolist() == [50.0, 0.0, 30.0]
    assert load_camera(scene, 1).K[0].tolist() == [70.0, 0.0, 31.0]


def test_an_odd_crop_moves_the_principal_point_by_whole_pixels(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise(40, 61)})
    (view,) = load_views(scene, resolution=(20, 20))
    # 61 columns become round(30.5) = 30, of which five on the left are cropped.
    assert view.camera.K[0].tolist() == pytest.approx([50 * 30 / 61, 0, 15 - 5])


def test_paths_without_an_extension_are_found(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.jpg": noise(), "b.png": noise()})
    for frame, name in ((0, "a"), (1, "./b")):
        changed(scene, lambda c, f=frame, n=name: c["frames"][f].update(file_path=n))
    assert len(load_views(scene)) == 2


def test_downscaled_copies_take_the_place_of_photographs_that_are_not_there(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise(40, 60)})
    changed(scene, lambda c: c["frames"][0].update(file_path="images/a.png"))
    for factor in (8, 4):
        (scene / f"images_{factor}").mkdir()
        pixels = noise(40 // factor, 60 // factor, seed=factor)
        Image.fromarray(pixels).save(scene / f"images_{factor}" / "a.png")
    (view,) = load_views(scene)
    assert np.array_equal((view.image * 255).round().numpy(), noise(10, 15, seed=4))
    assert view.camera.K[0].tolist() == [12.5, 0.0, 7.5]


def image_of(tmp_path: Path, pixels: np.ndarray, mode: str | None = None) -> list[float]:
    """Return the top-left colour of an image saved and loaded as a scene of one frame."""
    scene = write_scene(tmp_path / "s", {"a.png": noise(*pixels.shape[:2])})
    image = Image.fromarray(pixels)
    (image if mode is None else image.convert(mode)).save(scene / "a.png")
    return load_views(scene)[0].image[0, 0].tolist()


def test_pictures_of_every_kind_become_colours(tmp_path):
    # An alpha of more than a half hides nothing: the colour is the one that was stored.
    faint = np.full((8, 9, 4), 51, np.uint8)
    faint[..., 3] = 204
    assert image_of(tmp_path, faint) == pytest.approx([0.2, 0.2, 0.2])
    assert image_of(tmp_path, np.full((8, 9), 51, np.uint8)) == pytest.approx([0.2] * 3)
    assert image_of(tmp_path, np.full((8, 9), 51 * 257, np.uint16)) == pytest.approx([0.2] * 3)
    assert image_of(tmp_path, np.full((8, 9, 3), 51, np.uint8), "P") == pytest.approx([0.2] * 3)


def with_depth(scene: Path, depth: np.ndarray) -> Path:
    """Add a depth map of the first frame, as an array file."""
    np.save(scene / "d.npy", depth)
    return changed(scene, lambda c: c["frames"][0].update(depth_file_path="d.npy"))


def test_a_depth_map_is_cropped_like_its_photograph_and_never_blended(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise(40, 60)})
    changed(scene, lambda c: c.update(depth_unit_scale_factor=1.0))
    columns = np.tile(np.arange(60, dtype=np.float32), (40, 1))
    columns[0, 10:] = np.nan
    (view,) = load_views(with_depth(scene, columns), resolution=(40, 20))
    assert torch.equal(view.depth[1], torch.arange(20.0, 40.0))
    assert torch.equal(view.depth[0], torch.zeros(20))
    (small,) = load_views(scene, resolution=(20, 20))
    assert set(small.depth[1].tolist()) <= set(map(float, range(10, 50)))


def test_a_smaller_depth_map_is_brought_to_the_size_of_the_photograph(tmp_path):
    scene = write_scene(tmp_path / "s", {"a.png": noise(40, 60)})
    (view,) = load_views(with_depth(scene, np.array([[1000, 3000]], np.uint16)))
    assert view.depth.shape == (40, 60)
    assert (view.depth[:, :30] == 1).all()
    assert (view.depth[:, 30:] == 3).all()


@pytest.mark.parametrize(
    "lens",
    [
        {"camera_model": "OPENCV", "k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002},
        {"camera_model": "SIMPLE_RADIAL", "k1": 0.2},
        {"camera_model": "OPENCV_FISHEYE", "k1": 0.02, "k4": -0.001},
        {"is_fisheye": True},
    ],
    ids=str,
)
def test_the_camera_alone_is_that_of_the_undistorted_photograph(tmp_path, lens):
    scene = write_scene(tmp_path / "s", {"a.png": noise(40, 60)}, **lens)
    (view,) = load_views(scene, resolution=(32, 32))
    camera = load_camera(scene, 0, (32, 32))
    assert torch.equal(view.camera.K, camera.K)
    straight = load_camera(write_scene(tmp_path / "p", {"a.png": noise()}), 0, (32, 32))
    assert camera.K[0, 0] != straight.K[0, 0]
    assert torch.allclose(camera.K[:2, 2], straight.K[:2, 2])


def test_undistortion_leaves_no_dark_border(tmp_path):
    white = np.full((60, 80, 3), 255, np.uint8)
    for k1 in (-0.3, 0.3):
        scene = write_scene(tmp_path / f"s{k1}", {"a.png": white}, k1=k1)
        assert (load_views(scene)[0].image == 1).all()


# `test_real_scenes_load` opens one scene of each kind.
@pytest.mark.slow
def test_every_real_scene_loads_completely(shared):
    for scene in sorted(path for path in (shared / "data").iterdir() if path.is_dir()):
        frames = range(len(open_photographs(scene)))
        views = load_views(scene, frames=frames, resolution=(64, 64), near=0.5, far=10.0)
        assert len(views) == len(frames)
        assert all(view.image.shape == (64, 64, 3) for view in views)
        for view in views:
            rotation = view.camera.c2w[:3, :3].double()
            assert (rotation.T @ rotation - torch.eye(3).double()).abs().max() < 1e-5


@pytest.mark.skipif(os.name == "nt", reason="names of files have no line breaks there")
def test_a_sentence_about_a_scene_stays_one_line_whatever_its_folder_is_called(tmp_path):
    scene = write_scene(tmp_path / "line\nbreak", {"a.png": noise(), "b.png": noise(seed=1)})
    with pytest.raises(InputError, match="line break") as caught:
        open_photographs(scene).frame(7)
    assert "\n" not in str(caught.value)

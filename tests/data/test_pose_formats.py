"""Every format of posed photographs gives the cameras that took them."""

import json
import shutil
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gscompleter import InputError, load_cameras, save_ply
from gscompleter.apps.inputs.captures import RenderRequest, find_cameras_beside
from gscompleter.apps.requests.scene import SceneRequest
from gscompleter.data.camera_files import is_in_splat_frame
from gscompleter.data.formats import SCENE_FORMATS, open_photographs
from gscompleter.data.points import MIN_RANGE_POINTS, add_depth_range, compute_depth_range
from gscompleter.data.scene import write_cameras
from gscompleter.data.transforms import read_dataparser_transforms
from gscompleter.render.loading import load_renderer
from gscompleter.types import Camera, make_observed
from pose_files import (
    CAMERAS,
    NAMES,
    PARAMETERS,
    SIZE,
    VIEWS,
    WRITERS,
    binary,
    camera_list,
    dgp,
    kitti,
    llff,
    splits,
    surface_points,
    transforms,
    write_camera_list,
    write_colmap_binary,
    write_colmap_text,
    write_photographs,
)
from room_checks import check, check_room, write_cloud
from scenes import Room, view_of


def test_a_photograph_that_is_listed_without_ending_has_the_name_of_its_file(tmp_path):
    write_camera_list(tmp_path / "cameras.json")
    write_photographs(tmp_path / "input", [name.replace(".png", ".jpg") for name in NAMES])
    photographs = open_photographs(tmp_path)
    assert [frame.name for frame in photographs.frames] == ["0", "1", "2", "3", "4"]
    assert [frame.file_name for frame in photographs.frames][:2] == ["0.jpg", "1.jpg"]
    for word in ("1.jpg", "input/1.jpg", "1", "1.JPG"):
        assert photographs.find_frame(word) == 1
    with pytest.raises(InputError, match=r"such as 0\.jpg"):
        photographs.find_frame("missing.jpg")


@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_shows_the_room_from_where_it_says(tmp_path, kind):
    name, write = WRITERS[kind]
    scene = write(tmp_path / "room")
    photographs = open_photographs(scene)
    check_room(photographs)
    assert (photographs.name, photographs.notes) == ("room", ())
    assert photographs.camera(2, (32, 48)).K[0, 0] == pytest.approx(0.9 * 48)
    check_room(open_photographs(scene, format=name))


def list_files_below(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob("*")) if path.is_file()]


@pytest.mark.parametrize("kind", WRITERS)
def test_hidden_files_of_macos_count_in_no_format(tmp_path, kind):
    scene = WRITERS[kind][1](tmp_path / "room")
    for path in list_files_below(tmp_path):
        path.with_name(f"._{path.name}").write_bytes(b"\0\5\x16\7")
    photographs = open_photographs(scene)
    assert len(photographs) == len(CAMERAS)
    assert (photographs.notes, photographs.unused) == ((), ())


@pytest.mark.parametrize("kind", WRITERS)
def test_files_that_are_links_are_of_the_scene_that_they_lie_in(tmp_path, kind):
    """As git-annex and DVC store them."""
    scene = WRITERS[kind][1](tmp_path / "room")
    for number, path in enumerate(list_files_below(tmp_path)):
        stored = tmp_path / "store" / str(number) / f"object-{path.name}"
        stored.parent.mkdir(parents=True)
        path.rename(stored)
        path.symlink_to(stored)
    photographs = open_photographs(scene)
    assert photographs.name == "room"
    assert len(photographs) == len(CAMERAS)


def test_cameras_are_found_beside_a_splat_that_is_a_link(tmp_path):
    stored = tmp_path / "store" / "object.ply"
    stored.parent.mkdir()
    stored.write_bytes(b"ply")
    (tmp_path / "room").mkdir()
    splat = tmp_path / "room" / "splat.ply"
    splat.symlink_to(stored)
    beside = write_camera_list(tmp_path / "room" / "cameras.json")
    assert find_cameras_beside(splat) == beside
    beside.rename(stored.with_name("cameras.json"))
    assert find_cameras_beside(splat) == stored.with_name("cameras.json")


def test_a_named_upward_direction_needs_no_cameras_beside_the_splat(tmp_path):
    rows = json.loads(write_camera_list(tmp_path / "cameras.json").read_text())
    (tmp_path / "cameras.json").write_text(json.dumps([{**row, "fx": -1} for row in rows]))
    scene = make_observed(
        torch.rand(100, 3, generator=torch.Generator().manual_seed(0)),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(100, 1),
        torch.ones(100, 3),
        torch.ones(100),
        torch.zeros(100, 1, 3),
    )
    save_ply(tmp_path / "splat.ply", scene)
    request = RenderRequest(reading=SceneRequest(tmp_path / "splat.ply"))
    renderer = load_renderer("cpu")
    with pytest.raises(InputError):
        request.find_up(scene, renderer)
    named = replace(request, up=(0.0, 0.0, 2.0)).find_up(scene, renderer)
    assert named.direction.tolist() == [0.0, 0.0, 1.0]


def test_every_format_is_tried_here_or_in_the_file_of_its_own():
    of_their_own = {"chunks", "real-estate-10k", "kitti-raw", "pandaset", "mmdet3d", "waymo"}
    of_their_own |= {"polycam", "record3d", "3d-scanner-app", "photograph"}
    assert {name for name, _ in WRITERS.values()} | of_their_own == set(SCENE_FORMATS)


# Cameras as targets.


def test_cameras_come_from_every_file_of_cameras(tmp_path):
    write_colmap_text(tmp_path / "text")
    write_colmap_binary(tmp_path / "binary")
    files = (
        write_camera_list(tmp_path / "cameras.json"),
        tmp_path / "text" / "images.txt",
        tmp_path / "binary" / "images.bin",
    )
    for path in files:
        for camera, truth in zip(load_cameras(path), CAMERAS, strict=True):
            check(camera, truth)
    (tmp_path / "text" / "cameras.txt").unlink()
    with pytest.raises(InputError, match="no cameras.txt or cameras.bin beside .*images.txt"):
        load_cameras(tmp_path / "text" / "images.txt")


def supersplat_pose(camera: Camera) -> dict:
    """Return a pose in SuperSplat's world, rotated by 180° about z."""
    turn = np.array([-1.0, -1.0, 1.0])
    position, forward = camera.center.double().numpy(), camera.c2w[:3, 2].double().numpy()
    return {
        "name": "camera_0",
        "frame": 0,
        "position": (position * turn).tolist(),
        "target": ((position + 3 * forward) * turn).tolist(),
        "fov": float(np.degrees(2 * np.arctan(0.5 / 0.9))),
    }


@pytest.mark.parametrize("name", ["poses.json", "document.json", "scene.ssproj"])
def test_poses_of_supersplat_show_the_room_upright(tmp_path, name):
    poses = [supersplat_pose(camera) for camera in CAMERAS]
    document = {"version": 0, "poseSets": [{"name": "set0", "poses": poses}], "splats": [{}]}
    content = json.dumps(poses if name == "poses.json" else document)
    path = tmp_path / name
    path.write_text(content)
    if name == "scene.ssproj":
        with zipfile.ZipFile(path, "w") as project:
            project.writestr("document.json", content)
            project.writestr("splat_0.ply", b"ply\n")
    assert is_in_splat_frame(path)
    for camera, view in zip(load_cameras(path, (SIZE, SIZE)), VIEWS, strict=True):
        check(camera, view.camera)
        assert (view_of(Room(), camera).image - view.image).abs().mean() < 0.003
    # The opening angle is that of the longer side.
    wide = load_cameras(path, (SIZE, 2 * SIZE))[0]
    assert wide.K[0, 0] == pytest.approx(0.9 * 2 * SIZE, rel=1e-4)
    with pytest.raises(InputError, match="have no image size; give a resolution"):
        load_cameras(path)


def test_a_project_that_cannot_be_read_is_a_sentence(tmp_path):
    path = tmp_path / "scene.ssproj"
    path.write_text("{}")
    with pytest.raises(InputError, match=r"scene\.ssproj is no project of SuperSplat"):
        load_cameras(path, (SIZE, SIZE))
    with zipfile.ZipFile(path, "w") as project:
        project.writestr("splat_0.ply", b"ply\n")
    with pytest.raises(InputError, match=r"scene\.ssproj is no project of SuperSplat"):
        load_cameras(path, (SIZE, SIZE))


def test_a_project_that_ends_within_its_cameras_is_a_sentence(tmp_path):
    """Python raises `EOFError` where the directory states more bytes than the file has."""
    path = tmp_path / "scene.ssproj"
    with zipfile.ZipFile(path, "w") as project:
        project.writestr("document.json", "{}")
    content = bytearray(path.read_bytes())
    place = content.rindex(b"PK\x01\x02") + 20
    struct.pack_into("<II", content, place, 9999, 9999)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"no project of SuperSplat \(it ends too early"):
        load_cameras(path, (SIZE, SIZE))


@pytest.mark.parametrize("document", [{"version": 0, "splats": []}, [], 3])
def test_a_project_without_poses_says_so(tmp_path, document):
    path = tmp_path / "scene.ssproj"
    with zipfile.ZipFile(path, "w") as project:
        project.writestr("document.json", json.dumps(document))
    with pytest.raises(InputError, match="holds no poses"):
        load_cameras(path, (SIZE, SIZE))


@pytest.mark.parametrize("resolution", [(0, 5), (20, -1)])
def test_poses_of_supersplat_refuse_an_impossible_resolution(tmp_path, resolution):
    path = tmp_path / "poses.json"
    path.write_text(json.dumps([supersplat_pose(CAMERAS[0])]))
    with pytest.raises(InputError, match=r"resolution .* is impossible"):
        load_cameras(path, resolution)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ([], "lists no cameras"),
        ([3], "`fx` of camera 0 .* missing"),
        ([{"position": [0, 0, 0]}], "`fx` of camera 0 .* missing"),
        ({"poseSets": []}, "holds no poses"),
        ({"poseSets": [{"poses": [3]}]}, "`position` of pose 0 .* 3 numbers"),
        ([{"position": [0, 0, 0], "target": [0, 0]}], "`target` of pose 0 .* 3 numbers"),
        ([{"position": [0, 0, 0], "target": [0, 9, 0]}], "NaN"),
        ([{"position": [0, 0, 0], "target": [0, 0, 1], "fov": 180}], "`fov` of pose 0"),
    ],
)
def test_a_wrong_file_of_cameras_has_its_sentence(tmp_path, content, sentence):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=sentence) as error:
        load_cameras(path, (SIZE, SIZE))
    assert "\n" not in str(error.value)


def changed_camera(tmp_path: Path, **values) -> Path:
    path = write_camera_list(tmp_path / "cameras.json")
    content = json.loads(path.read_text())
    content[0].update(values)
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "reflection"),
        ({"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "not a rigid transform"),
        ({"rotation": [1, 2, 3]}, "`rotation` of camera 0 .* 3 × 3 numbers"),
        ({"position": "here"}, "`position` of camera 0"),
        ({"position": [0, 0, 1e300]}, "above 1e"),
        ({"fx": -1}, "`fx` of camera 0"),
        ({"width": 1e9}, "`width` of camera 0"),
        ({"img_name": 7}, "`img_name` of camera 0"),
    ],
)
def test_an_impossible_camera_of_a_list_is_refused(tmp_path, values, sentence):
    with pytest.raises(InputError, match=sentence):
        load_cameras(changed_camera(tmp_path, **values))


@pytest.mark.parametrize("ending", ["", ".png"])
def test_a_list_may_name_photographs_that_lie_elsewhere_by_their_whole_path(tmp_path, ending):
    write_photographs(tmp_path / "camera")
    scene = write_camera_list(tmp_path / "room" / "cameras.json")
    content = json.loads(scene.read_text())
    for entry, name in zip(content, NAMES, strict=True):
        entry["img_name"] = str(tmp_path / "camera" / name).removesuffix(".png") + ending
    scene.write_text(json.dumps(content))
    photographs = open_photographs(scene)
    check_room(photographs, range(5))
    assert photographs.notes == ()

    # A mask of one of them lies beside the list, and no photograph is its own.
    (tmp_path / "room" / "masks").mkdir()
    Image.new("L", (SIZE, SIZE), 255).save(tmp_path / "room" / "masks" / "1.png")
    masks = [frame.mask for frame in open_photographs(scene).frames]
    assert masks == [None, tmp_path / "room" / "masks" / "1.png", None, None, None]


def test_photographs_of_a_list_that_are_missing_are_left_out_and_named(tmp_path):
    scene = camera_list(tmp_path / "room")
    (scene / "images" / "1.png").unlink()
    photographs = open_photographs(scene)
    check_room(photographs, [0, 2, 3, 4])
    (note,) = photographs.notes
    assert note.startswith("1 of 5 photographs of")
    assert "are missing and left out: 1" in note
    shutil.rmtree(scene / "images")
    with pytest.raises(InputError, match="None of the 5 photographs .* folder `images`"):
        open_photographs(scene)


# nerfstudio.


def test_a_whole_transforms_json_wins_over_its_parts(tmp_path):
    scene = splits(tmp_path / "room")
    write_cameras(scene / "transforms.json", CAMERAS[:2], NAMES[:2])
    check_room(open_photographs(scene), [0, 1])


def test_dl3dv_keeps_its_file_and_small_copies_in_a_folder_nerfstudio(tmp_path):
    home = tmp_path / "room" / "nerfstudio"
    write_photographs(home / "images_4")
    write_cameras(home / "transforms.json", CAMERAS, [f"images/{name}" for name in NAMES])
    content = json.loads((home / "transforms.json").read_text())
    for frame in content["frames"]:
        frame.update({k: 4 * frame[k] for k in ("w", "h", "fl_x", "fl_y", "cx", "cy")})
    (home / "transforms.json").write_text(json.dumps(content))
    photographs = open_photographs(tmp_path / "room")
    assert photographs.name == "room"
    check_room(photographs)


def test_points_of_nerfstudio_lie_in_the_frame_of_the_cameras(tmp_path):
    scene = transforms(tmp_path / "room")
    assert open_photographs(scene).points() is None
    write_cloud(scene / "sparse_pc.ply", surface_points())
    content = json.loads((scene / "transforms.json").read_text())
    content["ply_file_path"] = "sparse_pc.ply"
    content["applied_transform"] = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    (scene / "transforms.json").write_text(json.dumps(content))
    photographs = open_photographs(scene)
    check_room(photographs)
    points = photographs.points()
    assert points is not None
    assert torch.allclose(points.double(), torch.from_numpy(surface_points()), atol=1e-5)
    (scene / "sparse_pc.ply").write_text("ply\nformat ascii 1.0\nelement face 0\nend_header\n")
    with pytest.raises(InputError, match="is no point cloud"):
        open_photographs(scene).points()
    (scene / "sparse_pc.ply").unlink()
    assert open_photographs(scene).points() is None


def test_the_frame_of_a_nerfstudio_run_turns_shifts_and_scales(tmp_path):
    path = tmp_path / "dataparser_transforms.json"
    rows = [[0.0, -1.0, 0.0, 3.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    path.write_text(json.dumps({"transform": rows, "scale": 0.5}))
    trained_from_file = read_dataparser_transforms(path)
    # (1, 2, 4) is turned to (-2, 1, 4), shifted to (1, 1, 4), and halved.
    assert (trained_from_file @ [1, 2, 4, 1]).tolist() == [0.5, 0.5, 2.0, 1.0]
    for content in ([], {}, {"transform": rows}, {"transform": rows[:2], "scale": 1.0}):
        path.write_text(json.dumps(content))
        with pytest.raises(InputError, match="dataparser_transforms.json"):
            read_dataparser_transforms(path)
    path.write_text(json.dumps({"transform": (2 * np.array(rows)).tolist(), "scale": 1.0}))
    with pytest.raises(InputError, match="not a rigid transform"):
        read_dataparser_transforms(path)


# LLFF, KITTI, DGP.


def test_bounds_of_llff_enclose_the_scene_with_room(tmp_path):
    scene = llff(tmp_path / "room")
    camera = open_photographs(scene).camera(0)
    assert (camera.near, camera.far) == (0.5, 12.0)
    camera = open_photographs(scene, near=2.0).camera(0)
    assert (camera.near, camera.far) == (2.0, 12.0)


def test_rows_of_llff_need_as_many_photographs(tmp_path):
    scene = llff(tmp_path / "room")
    (scene / "images" / "3.png").rename(scene / "images_aside.png")
    with pytest.raises(InputError, match="has 5 rows, one per photograph"):
        open_photographs(scene)


@pytest.mark.parametrize(
    ("array", "sentence"),
    [
        (np.zeros((5, 15)), r"shape \[5, 15\], not 17"),
        (np.zeros((0, 17)), r"shape \[0, 17\]"),
        (np.zeros((5, 17), dtype=complex), "is no array of real numbers"),
        (np.zeros((5, 17)), "are no z-depths, nearest first"),
        (np.array([["a"]]), "is no array of real numbers"),
        (np.array([None]), "is no array of real numbers"),
    ],
)
def test_a_wrong_array_of_llff_is_refused(tmp_path, array, sentence):
    scene = llff(tmp_path / "room")
    np.save(scene / "poses_bounds.npy", array, allow_pickle=True)
    with pytest.raises(InputError, match=sentence):
        open_photographs(scene)


def test_an_array_of_llff_that_claims_more_than_its_file_is_refused(tmp_path):
    scene = llff(tmp_path / "room")
    content = (scene / "poses_bounds.npy").read_bytes()
    for claim in (b"(5000000000, 17)", b"(6, 17)"):
        (scene / "poses_bounds.npy").write_bytes(content.replace(b"(5, 17)" + b" " * 12, claim))
        if claim in (scene / "poses_bounds.npy").read_bytes():
            with pytest.raises(InputError, match="is no array of real numbers"):
                open_photographs(scene)


def test_a_sequence_of_kitti_is_found_in_the_folders_of_the_data_set(tmp_path):
    scene = kitti(tmp_path / "sequences" / "07", aside=0.54)
    (tmp_path / "poses").mkdir()
    (scene / "poses.txt").rename(tmp_path / "poses" / "07.txt")
    for path in (scene, tmp_path / "poses" / "07.txt"):
        photographs = open_photographs(path)
        assert photographs.name == "07"
        check_room(photographs)


def test_kitti_says_what_is_missing(tmp_path):
    scene = kitti(tmp_path / "room")
    shutil.move(scene / "image_2", scene / "pictures")
    with pytest.raises(InputError, match=r"image of frame 0 .* is missing; put it at .*image_2"):
        open_photographs(scene).views([0])
    (scene / "calib.txt").rename(scene / "other.txt")
    with pytest.raises(InputError, match="calib.txt cannot be read"):
        open_photographs(scene / "poses.txt")
    with pytest.raises(InputError, match="no posed photographs"):
        open_photographs(scene)


@pytest.mark.parametrize(
    ("file", "text", "sentence"),
    [
        ("poses.txt", "", "poses.txt holds no poses"),
        ("poses.txt", "1 2 3\n", "poses.txt has no line 0 of 12 numbers"),
        ("calib.txt", "", "calib.txt has no line 2 of 12 numbers"),
        ("calib.txt", "P2: 1 0 0 0 0 1 0 0 1 0 1 0\n", "not that of a rectified camera"),
    ],
)
def test_a_damaged_sequence_of_kitti_is_refused(tmp_path, file, text, sentence):
    scene = kitti(tmp_path / "room")
    (scene / file).write_text(text)
    with pytest.raises(InputError, match=sentence):
        open_photographs(scene)


@pytest.mark.parametrize(
    ("lens", "advice"),
    [("fisheye", "undistort the images"), ("equirectangular", "split the panoramas into persp")],
)
def test_lenses_of_dgp_that_are_not_read_are_refused_with_what_to_do(tmp_path, lens, advice):
    scene = dgp(tmp_path / "room")
    path = scene / "calibration" / "abc.json"
    content = json.loads(path.read_text())
    for entry in content["intrinsics"]:
        entry[lens] = 1
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=f"`{lens}`, which is not read; {advice}"):
        open_photographs(scene)


def test_dgp_says_what_is_missing(tmp_path):
    scene = dgp(tmp_path / "room")
    path = scene / "scene_1.json"
    content = json.loads(path.read_text())
    content["data"][1]["id"]["name"] = "CAMERA_09"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="camera CAMERA_09 of .* is not in the calibration"):
        open_photographs(scene)
    del content["data"][1]["id"]["name"]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="does not say which camera took it"):
        open_photographs(scene)
    (scene / "calibration" / "abc.json").unlink()
    with pytest.raises(InputError, match="calibration of .* is missing; put it at .*abc.json"):
        open_photographs(scene)
    del content["samples"][0]["calibration_key"]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="does not name its calibration"):
        open_photographs(scene)


def test_images_of_dgp_have_the_lens_of_their_own_sample(tmp_path):
    scene = dgp(tmp_path / "room")
    path = scene / "scene_1.json"
    content = json.loads(path.read_text())
    for number, datum in enumerate(content["data"]):
        datum["key"] = f"key{number}"
    keys = [datum["key"] for datum in content["data"]]
    # The last image is of no sample, and the lidar comes first.
    content["samples"] = [
        {"calibration_key": "abc", "datum_keys": keys[:3]},
        {"calibration_key": "zoomed", "datum_keys": keys[3:-1]},
    ]
    path.write_text(json.dumps(content))
    lenses = json.loads((scene / "calibration" / "abc.json").read_text())
    lenses["intrinsics"][1] |= {key: 2 * lenses["intrinsics"][1][key] for key in ("fx", "fy")}
    (scene / "calibration" / "zoomed.json").write_text(json.dumps(lenses))
    photographs = open_photographs(scene)
    focal = PARAMETERS[0]
    focals = [photographs.camera(frame).K[0, 0].item() for frame in range(len(photographs))]
    assert focals == pytest.approx([focal, focal, 2 * focal, 2 * focal, focal])
    (scene / "calibration" / "zoomed.json").unlink()
    with pytest.raises(InputError, match="calibration of .* is missing; put it at .*zoomed.json"):
        open_photographs(scene)


def test_a_lens_of_dgp_is_undistorted_or_refused(tmp_path):
    scene = dgp(tmp_path / "room")
    path = scene / "calibration" / "abc.json"
    lenses = json.loads(path.read_text())
    lens = lenses["intrinsics"][1]
    lens |= {"k1": -0.2, "k2": 0.05, "p1": 0.001, "k4": 0.01, "fisheye": 0, "w": 0.0}
    path.write_text(json.dumps(lenses))
    distortion = open_photographs(scene).frame(0).intrinsics.distortion
    assert distortion.radial == (-0.2, 0.05, 0.0)
    assert distortion.tangential == (0.001, 0.0)
    assert distortion.denominator == (0.01, 0.0, 0.0)
    lens["fisheye"] = 1
    path.write_text(json.dumps(lenses))
    with pytest.raises(InputError, match="camera CAMERA_01 .* has `fisheye`, which is not read"):
        open_photographs(scene)


def test_two_scene_files_of_dgp_in_a_folder_are_two_scenes(tmp_path):
    scene = dgp(tmp_path / "room")
    content = json.loads((scene / "scene_1.json").read_text())
    shorter = {**content, "data": content["data"][:3]}
    (scene / "scene_2.json").write_text(json.dumps(shorter))
    with pytest.raises(InputError, match="several scenes, such as scene_1 and scene_2"):
        open_photographs(scene)
    photographs = open_photographs(scene / "scene_2.json")
    assert (photographs.name, len(photographs)) == ("room", 2)


# Depth from sparse points.


def test_planes_enclose_the_points_in_sight():
    camera = CAMERAS[0]
    depths = torch.linspace(2.0, 4.0, MIN_RANGE_POINTS + 1)
    points = depths[:, None] * torch.tensor([0.1, 0.0, 1.0])
    # Points behind the camera and beside the image are ignored.
    behind, beside = torch.tensor([[0.0, 0, -9]]), torch.tensor([[50.0, 0, 9]])
    near, far = compute_depth_range(torch.cat([points, behind, beside]), [camera])
    assert (near, far) == (pytest.approx(0.5 * 2.02), pytest.approx(2 * 3.98))
    assert compute_depth_range(points[: MIN_RANGE_POINTS - 1], [camera]) is None
    assert compute_depth_range(points, []) is None


def test_planes_of_points_fill_in_what_is_not_given(tmp_path):
    scene = binary(tmp_path / "room")
    found = add_depth_range(open_photographs(scene), [0, 2])
    depths = torch.cat([VIEWS[number].depth.flatten() for number in (0, 2)])
    assert found.near is not None
    assert found.far is not None
    assert 0.25 * depths.min() < found.near < depths.min()
    assert depths.max() < found.far < 3 * depths.max()
    given = add_depth_range(open_photographs(scene, near=0.1), [0, 2])
    assert (given.near, given.far) == (0.1, found.far)
    beyond = add_depth_range(open_photographs(scene, near=1e3), [0, 2])
    assert (beyond.near, beyond.far) == (1e3, None)


def test_photographs_without_points_keep_their_planes(tmp_path):
    photographs = open_photographs(transforms(tmp_path / "room"))
    assert add_depth_range(photographs, [0, 1]) is photographs


# COLMAP masks and lists of both kinds.


def test_masks_lie_in_a_folder_beside_the_photographs(tmp_path):
    scene = binary(tmp_path / "room")
    shown = np.full((SIZE, SIZE), 255, np.uint8)
    shown[:, :16] = 0
    (scene / "masks").mkdir()
    Image.fromarray(shown).save(scene / "masks" / "0.png.png")
    Image.fromarray(shown).save(scene / "masks" / "1.png")
    photographs = open_photographs(scene)
    for number in (0, 1):
        (view,) = photographs.views([number])
        assert torch.equal(view.ignore_mask, torch.from_numpy(shown == 0))
    assert photographs.views([2])[0].ignore_mask is None

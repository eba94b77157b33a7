"""The add-on of Blender: its maths always, and all else in Blender itself where `bpy` is there."""

from __future__ import annotations

import importlib.util
import os
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

import gscompleter as gsc
import stand_in_bpy
from command import run
from gscompleter.apps.inputs.hole_kinds import read_marks
from gscompleter.data.scene import load_cameras, write_cameras
from gscompleter.numerics.geometry import is_inside, project
from paths import ROOT
from scenes import Room, camera_at, gaussians_of, view_of

ADD_ON = ROOT / "integrations" / "blender" / "gscompleter_blender.py"
SIZE = 64
CAMERA = replace(camera_at(0.02, size=SIZE), near=None, far=None)
TURNED = replace(camera_at(0.1, z=0.1, yaw=10, size=SIZE), near=None, far=None)


def load_add_on(bpy, name):
    """Import the file of the add-on with a module `bpy`."""
    spec = importlib.util.spec_from_file_location(name, ADD_ON)
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setitem(sys.modules, "bpy", bpy)
        spec.loader.exec_module(module)
    return module


ADDON = load_add_on(stand_in_bpy.make_module(), "gscompleter_blender_maths")


@pytest.fixture(scope="module")
def result(tmp_path_factory) -> Path:
    """Return a result: a splat of a room with labels, and the cameras of its targets."""
    folder = tmp_path_factory.mktemp("blender") / "OUT"
    folder.mkdir()
    scene = gaussians_of(view_of(Room(), camera_at(size=SIZE)))
    labels = torch.zeros(len(scene), dtype=torch.uint8)
    labels[::5] = 1
    gsc.save_ply(folder / "completed.ply", replace(scene, generated=labels))
    write_cameras(folder / "targets.json", [CAMERA, TURNED])
    return folder


def test_points_are_those_of_the_file(result):
    points = ADDON.read_points(result / "completed.ply")
    scene = gsc.load_ply(result / "completed.ply")
    assert np.array_equal(points["position"], scene.means.numpy())
    assert np.array_equal(points["generated"], scene.generated.numpy())
    assert np.abs(points["opacity"] - scene.opacities.numpy()).max() < 1e-5
    shown = (0.5 + ADDON.SH_0 * scene.sh[:, 0]).clamp(0, 1).numpy()
    assert np.abs(points["color"] - shown).max() < 1e-6


def test_lens_and_intrinsics_are_inverse():
    frame = {"fl_x": 70.0, "fl_y": 70.0, "cx": 30.0, "cy": 25.0, "w": 80, "h": 60}
    lens = ADDON.compute_lens(frame)
    shift = (lens["shift_x"], lens["shift_y"])
    back = ADDON.compute_intrinsics(lens["lens"], (36.0, 24.0), "HORIZONTAL", shift, (80, 60))
    assert back == pytest.approx(frame)


@pytest.mark.parametrize(
    ("fit", "size", "focal"),
    [
        ("AUTO", (80, 60), 50 / 36 * 80),
        ("AUTO", (60, 80), 50 / 36 * 80),
        ("HORIZONTAL", (60, 80), 50 / 36 * 60),
        ("VERTICAL", (80, 60), 50 / 24 * 60),
    ],
)
def test_the_sensor_fits_as_blender_says(fit, size, focal):
    found = ADDON.compute_intrinsics(50.0, (36.0, 24.0), fit, (0.0, 0.0), size)
    assert found["fl_x"] == pytest.approx(focal)
    assert (found["cx"], found["cy"]) == (size[0] / 2, size[1] / 2)


def test_a_camera_in_blender_goes_back_to_the_frame_of_the_file():
    # Down in the file is -z in Blender, and forward is +y.
    assert (ADDON.FROM_FILE @ [0, 1, 0, 0]).tolist() == [0, 0, -1, 0]
    assert (ADDON.FROM_FILE @ [0, 0, 1, 0]).tolist() == [0, 1, 0, 0]
    local = np.eye(4)
    local[:3, 3] = [1.0, 2.0, 3.0]
    frame = ADDON.FROM_FILE.copy()
    frame[:3, :3] *= 2.5
    frame[:3, 3] = [4.0, 0.0, -1.0]
    assert np.allclose(ADDON.move_to_file(frame @ local, frame), local)
    with pytest.raises(ADDON.GscompleterError, match="stretched or mirrored"):
        ADDON.move_to_file(local, np.diag([1.0, 2.0, 1.0, 1.0]))
    with pytest.raises(ADDON.GscompleterError, match="stretched or mirrored"):
        ADDON.move_to_file(local, np.diag([-1.0, 1.0, 1.0, 1.0]))


def test_a_path_in_the_window_becomes_a_mask_of_the_image(tmp_path):
    corners = np.array([[100.0, 50.0], [300.0, 150.0]])
    path = [(150, 125), (200, 125), (200, 100), (150, 100)]
    points = ADDON.move_to_image(path, corners, (40, 20))
    assert points.tolist() == [[10, 5], [20, 5], [20, 10], [10, 10]]
    mask = ADDON.fill_polygon(points, (40, 20))
    rows, columns = np.nonzero(mask)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (5, 9, 10, 19)
    assert mask.sum() == 50
    ADDON.write_mask(tmp_path / "mask.png", mask)
    with Image.open(tmp_path / "mask.png") as image:
        assert np.array_equal(np.array(image), np.where(mask, 255, 0))


@pytest.mark.parametrize("content", [b"ply\nformat ascii 1.0\nend_header\n", b"no splat"])
def test_another_kind_of_file_is_a_sentence(tmp_path, content):
    (tmp_path / "other.ply").write_bytes(content)
    with pytest.raises(ADDON.GscompleterError, match=r"other\.ply is no plain \.ply of Gaussians"):
        ADDON.read_points(tmp_path / "other.ply")


def test_a_camera_that_was_written_is_read_by_the_commands(tmp_path):
    frame = ADDON.compute_intrinsics(40.0, (36.0, 24.0), "AUTO", (0.1, -0.05), (64, 48))
    matrix = ADDON.move_to_file(np.eye(4), ADDON.FROM_FILE)
    ADDON.write_camera(tmp_path / "camera.json", {**frame, "transform_matrix": matrix.tolist()})
    (camera,) = load_cameras(tmp_path / "camera.json")
    assert (camera.width, camera.height) == (64, 48)
    # A new camera of Blender looks down, which is +y in the file.
    assert torch.allclose(camera.c2w[:3, 2], torch.tensor([0.0, 1.0, 0.0]), atol=1e-6)


# --------------------------------------------------------------------------- in Blender itself


@pytest.fixture
def blender():
    """Return `bpy` of an empty file with the add-on, and the add-on."""
    bpy = pytest.importorskip("bpy", reason="needs the package bpy, which is Blender itself")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    add_on = load_add_on(bpy, "gscompleter_blender")
    add_on.register()
    yield bpy, add_on
    add_on.unregister()


def test_blender_shows_the_points_where_its_cameras_see_them(blender, result):
    bpy, add_on = blender
    path = str(result / "completed.ply")
    assert bpy.ops.gscompleter.import_result(filepath=path) == {"FINISHED"}
    scene = bpy.context.scene
    root = scene.gscompleter_splat
    (points,) = [thing for thing in root.children if thing.type == "MESH"]
    first, second = [thing for thing in root.children if thing.type == "CAMERA"]
    assert scene.camera == first
    given = gsc.load_ply(result / "completed.ply")
    assert len(points.data.vertices) == len(given)
    labels = np.empty(len(given), np.int32)
    points.data.attributes["generated"].data.foreach_get("value", labels)
    assert np.array_equal(labels, given.generated.numpy())

    # Up is up: the floor of the room, which is largest in y, is lowest in z.
    lowest = points.matrix_world @ points.data.vertices[int(given.means[:, 1].argmax())].co
    assert lowest.z == pytest.approx(-given.means[:, 1].max().item(), rel=1e-5)

    # Blender projects a point to where the camera of the file does.
    from bpy_extras.object_utils import world_to_camera_view

    pixels, z = project(given.means, TURNED)
    seen = is_inside(pixels, z, TURNED).nonzero()[::97, 0].tolist()
    assert len(seen) > 20
    for row in seen:
        world = points.matrix_world @ points.data.vertices[row].co
        x, y, _ = world_to_camera_view(scene, second, world)
        assert x * SIZE == pytest.approx(pixels[row, 0].item(), abs=0.01)
        assert (1 - y) * SIZE == pytest.approx(pixels[row, 1].item(), abs=0.01)

    # What is drawn is a cloud of points with their colours.
    drawn_things = bpy.context.evaluated_depsgraph_get().object_instances
    (drawn,) = [one.object.data for one in drawn_things if one.object.type == "POINTCLOUD"]
    assert len(drawn.points) == len(given)
    assert drawn.attributes[add_on.SHOWN].domain == "POINT"


def test_blender_renders_the_points_in_their_colours(blender, result, tmp_path):
    bpy, _ = blender
    bpy.ops.gscompleter.import_result(filepath=str(result / "completed.ply"))
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 16, False
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = str(tmp_path / "rendered.png")
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    with Image.open(tmp_path / "rendered.png") as image:
        rendered = torch.from_numpy(np.array(image.convert("RGB"), np.float32)) / 255
    expected = gsc.load_renderer("cpu").render(gsc.load_ply(result / "completed.ply"), CAMERA)
    # Points leave gaps between them, which are black, and darken pixels in part.
    shown = rendered.amax(dim=-1) > 0.8 * expected.image.amax(dim=-1)
    assert shown.float().mean() > 0.2
    assert (rendered - expected.image).abs()[shown].median() < 0.1 * expected.image.max()


def test_what_is_marked_in_blender_is_repaired(blender, result, tmp_path, monkeypatch):
    bpy, add_on = blender
    bpy.ops.gscompleter.import_result(filepath=str(result / "completed.ply"))
    scene = bpy.context.scene
    # Moved and scaled as a whole, which changes nothing for the file.
    scene.gscompleter_splat.scale = (2.0, 2.0, 2.0)
    scene.gscompleter_splat.location = (1.0, 2.0, 3.0)
    bpy.context.view_layer.update()
    square = add_on.fill_polygon(np.array([[30, 26], [44, 26], [44, 38], [30, 38]]), (SIZE, SIZE))
    add_on.add_to_mask(square)
    scene.gscompleter_folder = str(tmp_path / "marked")
    words = shlex.split(add_on.write_repair(bpy.context))
    (camera,) = load_cameras(tmp_path / "marked" / "camera.json")
    assert (camera.c2w - CAMERA.c2w).abs().max() < 1e-5
    assert (camera.K - CAMERA.K).abs().max() < 1e-3 * CAMERA.K.max()
    marks = read_marks(tmp_path / "marked" / "mask.png", camera)
    assert np.array_equal(marks.numpy(), square)
    assert words[:3] == ["gscompleter", "repair", str(result / "completed.ply")]
    assert run(monkeypatch, *words[1:], "--quiet") == 0
    repaired = tmp_path / "marked" / "repaired" / "completed.ply"
    assert bpy.ops.gscompleter.import_result(filepath=str(repaired)) == {"FINISHED"}


def test_blender_refuses_with_a_sentence(blender, result, tmp_path):
    bpy, add_on = blender
    with pytest.raises(RuntimeError, match="No splat is chosen"):
        bpy.ops.gscompleter.write()
    bpy.ops.gscompleter.import_result(filepath=str(result / "completed.ply"))
    with pytest.raises(RuntimeError, match="Nothing is marked"):
        bpy.ops.gscompleter.write()
    bpy.context.scene.camera.data.type = "ORTHO"
    with pytest.raises(RuntimeError, match="not perspective"):
        bpy.ops.gscompleter.write()
    (tmp_path / "other.ply").write_bytes(b"ply\n")
    with pytest.raises(RuntimeError, match="no plain"):
        bpy.ops.gscompleter.import_result(filepath=str(tmp_path / "other.ply"))
    bpy.context.scene.camera.data.type = "PERSP"
    add_on.add_to_mask(np.ones((8, 8), bool))
    with pytest.raises(RuntimeError, match="size of the output changed"):
        bpy.ops.gscompleter.write()
    bpy.ops.gscompleter.clear()
    assert bpy.data.images.get(add_on.MASK) is None
    add_on.add_to_mask(np.ones((SIZE, SIZE), bool))
    with pytest.raises(RuntimeError, match="The scene has no file yet"):
        bpy.ops.gscompleter.write()


def mark_square(add_on, first) -> int:
    """Mark ten by ten pixels; returns how many are marked then."""
    marked = np.zeros((SIZE, SIZE), bool)
    marked[first : first + 10, 10:20] = True
    add_on.add_to_mask(marked)
    return int(add_on.read_mask((SIZE, SIZE)).sum())


def test_undo_takes_back_one_mark_after_the_other(blender, result):
    bpy, add_on = blender

    def step(operator):
        assert operator() == {"FINISHED"}
        return int(add_on.read_mask((SIZE, SIZE)).sum())

    bpy.ops.ed.undo_push(message="empty")
    bpy.ops.gscompleter.import_result(filepath=str(result / "completed.ply"))
    bpy.ops.ed.undo_push(message="imported")
    for first, count in ((0, 100), (20, 200)):
        assert mark_square(add_on, first) == count
        bpy.ops.ed.undo_push(message="marked")
    undo, redo = bpy.ops.ed.undo, bpy.ops.ed.redo
    assert [step(undo) for _ in range(3)] == [100, 0, 0]
    assert (len(bpy.data.objects), bpy.context.scene.gscompleter_splat) == (0, None)
    assert [step(redo) for _ in range(3)] == [0, 100, 200]
    assert bpy.context.scene.gscompleter_splat.type == "EMPTY"


def test_the_file_of_the_scene_keeps_splat_mask_and_folder(blender, result, tmp_path):
    bpy, add_on = blender
    bpy.ops.gscompleter.import_result(filepath=str(result / "completed.ply"))
    mark_square(add_on, 20)
    file = str(tmp_path / "scene.blend")
    bpy.ops.wm.save_as_mainfile(filepath=file)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=file)
    assert bpy.ops.gscompleter.write() == {"FINISHED"}
    (camera,) = load_cameras(tmp_path / "gscompleter" / "camera.json")
    assert (camera.c2w - CAMERA.c2w).abs().max() < 1e-5
    with Image.open(tmp_path / "gscompleter" / "mask.png") as image:
        assert np.array(image)[20:30, 10:20].min() == 255
        assert np.count_nonzero(image) == 100


def test_a_path_is_drawn_where_the_camera_shows_it(blender, result):
    """The window stands in: without a screen there is none, but its maths is Blender's own."""
    bpy, add_on = blender
    bpy.ops.gscompleter.import_result(filepath=str(result / "completed.ply"))
    scene = bpy.context.scene
    camera = scene.camera
    camera.data.shift_x, camera.data.shift_y = 0.1, -0.05
    scene.gscompleter_splat.scale = (2.0, 2.0, 2.0)
    bpy.context.view_layer.update()
    view = camera.matrix_world.normalized().inverted()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    projection = camera.calc_matrix_camera(depsgraph, x=200, y=200)
    context = SimpleNamespace(
        scene=scene,
        region=SimpleNamespace(width=200, height=200),
        region_data=SimpleNamespace(perspective_matrix=projection @ view),
    )
    assert add_on.find_frame(context) == pytest.approx(np.array([[0, 0], [200, 200]]), abs=0.01)


def test_the_file_installs_as_an_add_on(result, tmp_path):
    """Blender copies it among its add-ons, and switches it on and off more than once."""
    pytest.importorskip("bpy", reason="needs the package bpy, which is Blender itself")
    # In a process of its own, since Blender asks where its add-ons lie when it is imported.
    code = f"""
import bpy
bpy.ops.preferences.addon_install(filepath={str(ADD_ON)!r})
for _ in range(2):
    bpy.ops.preferences.addon_enable(module={ADD_ON.stem!r})
    bpy.ops.gscompleter.import_result(filepath={str(result / "completed.ply")!r})
    bpy.ops.preferences.addon_disable(module={ADD_ON.stem!r})
    assert not hasattr(bpy.types.Scene, "gscompleter_splat")
"""
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.rglob(ADD_ON.name))) == 1

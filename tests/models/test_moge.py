"""MoGe-2: tiny networks with the signature of the published export take the place of the file."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace

import pytest
import torch

pytest.importorskip("onnx", reason="needs the extra `test`")
pytest.importorskip("onnxruntime", reason="needs gscompleter[onnx]")

import onnx
from onnx import TensorProto, helper

from command import run
from gscompleter import InputError, load_ply, load_reconstructor
from gscompleter.models.diffusion.source_depth import load_source_depth
from gscompleter.models.moge import load_moge
from gscompleter.models.weights.published import PUBLISHED
from known_room import known_room
from scenes import Room, camera_at, photographed, view_of

FLOAT = TensorProto.FLOAT
NODES = [
    helper.make_node("Transpose", ["image"], ["points"], perm=[0, 2, 3, 1]),
    helper.make_node("Identity", ["points"], ["normal"]),
    helper.make_node("ReduceMax", ["image"], ["largest"], axes=[1], keepdims=0),
    helper.make_node("Sigmoid", ["largest"], ["mask"]),
    helper.make_node("Cast", ["num_tokens"], ["tokens"], to=FLOAT),
    helper.make_node("Constant", [], ["most"], value_float=900.0),
    helper.make_node("Div", ["tokens", "most"], ["scale"]),
]
"""The points are the colours, the mask their largest channel; 1800 tokens give a scale of 2."""


def save(path, nodes=NODES, names=("image", "num_tokens"), outputs=4):
    """Save an ONNX graph that reads an image and a number of tokens."""
    maps = {"points": [1, "h", "w", 3], "normal": [1, "h", "w", 3], "mask": [1, "h", "w"]}
    shapes = list((maps | {"scale": []}).items())[:outputs]
    graph = helper.make_graph(
        nodes,
        "tiny",
        [
            helper.make_tensor_value_info(names[0], FLOAT, [1, 3, "h", "w"]),
            helper.make_tensor_value_info(names[1], TensorProto.INT64, []),
        ],
        [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in shapes],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, str(path))
    return path


def paint_points(view, shift):
    """Paint the points of a view as its colours, with `shift` taken from their depth."""
    camera = view.camera
    x = (torch.arange(camera.width) + 0.5 - camera.width / 2) / camera.K[0, 0]
    y = (torch.arange(camera.height) + 0.5 - camera.height / 2) / camera.K[1, 1]
    rays = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    depth = view.depth[..., None]
    return replace(view, image=torch.cat([depth * rays, depth - shift], dim=-1))


@pytest.mark.parametrize("shift", [-0.5, 0.0, 0.6])
def test_depth_is_metric_once_the_shift_along_the_axis_is_undone(shift, tmp_path):
    view = view_of(Room(), camera_at(size=80))
    found = load_moge("moge-2", save(tmp_path / "model.onnx"))(paint_points(view, shift))
    assert found.valid.all()
    assert (found.depth / view.depth - 2).abs().max() < 2e-3


def test_what_the_mask_leaves_out_has_no_depth(tmp_path):
    view = paint_points(view_of(Room(), camera_at(size=80)), 0.0)
    view.image[:20] = -1.0
    found = load_moge("moge-2", save(tmp_path / "model.onnx"))(view)
    assert torch.equal(found.valid, (view.image >= 0).any(dim=-1))
    assert (found.depth > 0).all()
    view.image[:] = -1.0
    assert not load_moge("moge-2", tmp_path / "model.onnx")(view).valid.any()


def test_other_files_are_refused_with_one_sentence(tmp_path):
    def load(path):
        return load_reconstructor("plane-sweep", depth="moge-2", depth_weights=path)

    renamed = [helper.make_node("Identity", ["photo"], ["image"]), *NODES]
    wrong = save(tmp_path / "renamed.onnx", renamed, names=("photo", "num_tokens"))
    for path in (wrong, save(tmp_path / "few.onnx", outputs=3)):
        with pytest.raises(InputError, match="is no MoGe-2 network: its inputs are"):
            load(path)
    (tmp_path / "cut.onnx").write_bytes(wrong.read_bytes()[:200])
    with pytest.raises(InputError, match="cannot be read as an ONNX network"):
        load(tmp_path / "cut.onnx")
    (tmp_path / "page.onnx").write_text("<html>not here</html>")
    with pytest.raises(InputError):
        load(tmp_path / "page.onnx")
    with pytest.raises(
        InputError, match="There is no depth 'nobody'; choose one of none, .*moge-2,"
    ):
        load_reconstructor("plane-sweep", depth="nobody")


def test_a_network_that_answers_in_another_shape_is_refused(tmp_path):
    turned = [helper.make_node("Transpose", ["image"], ["points"], perm=[0, 3, 2, 1]), *NODES[1:]]
    predict = load_moge("moge-2", save(tmp_path / "model.onnx", turned))
    with pytest.raises(InputError, match=r"an image of \(60, 80\) by points of"):
        predict(view_of(Room(), replace(camera_at(size=80), height=60)))


def test_a_mask_in_another_shape_is_told_as_that(tmp_path):
    nodes = [
        helper.make_node("Transpose", ["largest"], ["turned"], perm=[0, 2, 1]),
        helper.make_node("Sigmoid", ["turned"], ["mask"]),
    ]
    predict = load_moge("moge-2", save(tmp_path / "model.onnx", [*NODES[:3], *nodes, *NODES[4:]]))
    with pytest.raises(InputError, match=r"a mask of \(1, 80, 60\)"):
        predict(view_of(Room(), replace(camera_at(size=80), height=60)))


def test_points_too_few_to_tell_the_shift_have_no_depth(tmp_path):
    """Taken for 0, the shift would be half of the nearest depth off, and nothing would say so."""
    view = paint_points(view_of(Room(), camera_at(size=200)), 0.6)
    sees = torch.zeros(200, 200, dtype=torch.bool)
    sees[100, 100:102] = True
    view.image[~sees] = -1.0
    assert not load_moge("moge-2", save(tmp_path / "model.onnx"))(view).valid.any()


@pytest.mark.slow
def test_a_scene_is_completed_with_its_help(tmp_path, monkeypatch, capsys):
    cameras = [camera_at(x, size=64) for x in (-0.3, 0.1, 0.5)]
    scene = photographed(tmp_path / "scene", cameras)
    words = ("complete", scene, "--context", "0", "1", "--target", "2", "--out", tmp_path / "out")
    words += ("--depth", "moge-2", "--depth-weights", save(tmp_path / "model.onnx"))
    assert run(monkeypatch, *words) == 0
    assert len(load_ply(tmp_path / "out" / "completed.ply")) > 0
    settings = json.loads((tmp_path / "out" / "summary.json").read_text())["settings"]
    assert settings["depth_weights"] == str(tmp_path / "model.onnx")
    words += ("--overwrite", "--reconstructor", "mapanything")
    assert run(monkeypatch, *words) == 2


def test_pe_field_takes_it_as_the_depth_of_the_photograph(tmp_path, monkeypatch):
    monkeypatch.setenv("GSCOMPLETER_HOME", str(tmp_path))
    place = tmp_path / "weights" / "moge-2" / "model.onnx"
    place.parent.mkdir(parents=True)
    save(place)
    digest = hashlib.sha256(place.read_bytes()).hexdigest()
    monkeypatch.setitem(PUBLISHED, "moge-2", replace(PUBLISHED["moge-2"], sha256=digest))
    context = known_room()
    render = context.view_renders[0]
    found = load_source_depth("moge-2")(paint_points(context.views[0], 0.2), render)
    seen = render.alpha > 0.9
    assert ((found - context.views[0].depth) / context.views[0].depth)[seen].abs().median() < 0.02

"""MI-GAN and LaMa: tiny networks with the published signatures take the place of the files."""

from __future__ import annotations

import hashlib
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("onnx", reason="needs the extra `test`")
pytest.importorskip("onnxruntime", reason="needs gscompleter[onnx]")

import onnx
from onnx import TensorProto, helper, numpy_helper
from torch.nn.functional import conv2d

from command import run
from gscompleter import InputError, load_generator, load_ply
from gscompleter.config.generators import get_settings_class
from gscompleter.generators.warp import complete_warp
from gscompleter.models.inpainting.fill import (
    WINDOW,
    InpaintingGenerator,
    fill_windows,
    match_tone,
    place_windows,
)
from gscompleter.models.inpainting.lama import load_lama
from gscompleter.models.inpainting.migan import load_migan
from gscompleter.models.settings import FileSettings
from gscompleter.models.weights.published import PUBLISHED
from known_room import TARGET, known_room
from scenes import camera_at, photographed

WEIGHTS = torch.randn(3, 4, 3, 3, generator=torch.Generator().manual_seed(0)) / 10
HOLE = torch.zeros(40, 56, dtype=torch.bool)
HOLE[10:30, 20:] = True
IMAGE = torch.rand(40, 56, 3, generator=torch.Generator().manual_seed(1))


def save(path, kind, nodes, size=("h", "w"), inputs=("image", "mask"), output="result"):
    """Save an ONNX graph that reads an image and a mask, and writes an image."""
    shape = lambda channels: [1, channels, *size]  # noqa: E731
    graph = helper.make_graph(
        nodes,
        "tiny",
        [
            helper.make_tensor_value_info(name, kind, shape(channels))
            for name, channels in zip(inputs, (3, 1), strict=True)
        ],
        [helper.make_tensor_value_info(output, kind, shape(3))],
        [
            numpy_helper.from_array(WEIGHTS.numpy(), "weights"),
            numpy_helper.from_array(np.float32(255), "most"),
            numpy_helper.from_array(np.float32(1), "one"),
            numpy_helper.from_array(np.float32(0), "least"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, str(path))
    return path


def make_node(kind, inputs, output, **settings):
    return helper.make_node(kind, inputs.split(), [output], **settings)


@pytest.fixture(scope="module")
def migan_file(tmp_path_factory):
    """Bytes in and out; the mask is 255 where known, and known pixels are copied."""
    nodes = [
        make_node("Cast", "image", "bytes", to=TensorProto.FLOAT),
        make_node("Cast", "mask", "known_bytes", to=TensorProto.FLOAT),
        make_node("Div", "known_bytes most", "known"),
        make_node("Div", "bytes most", "colours"),
        make_node("Mul", "colours known", "seen"),
        make_node("Concat", "known seen", "both", axis=1),
        make_node("Conv", "both weights", "painted", pads=[1, 1, 1, 1]),
        make_node("Mul", "painted most", "scaled"),
        make_node("Clip", "scaled least most", "limited"),
        make_node("Sub", "one known", "unknown"),
        make_node("Mul", "limited unknown", "new"),
        make_node("Mul", "bytes known", "old"),
        make_node("Add", "new old", "whole"),
        make_node("Cast", "whole", "result", to=TensorProto.UINT8),
    ]
    folder = tmp_path_factory.mktemp("migan")
    return save(folder / "migan_pipeline_v2.onnx", TensorProto.UINT8, nodes)


LAMA_NODES = [
    make_node("Concat", "mask image", "both", axis=1),
    make_node("Conv", "both weights", "painted", pads=[1, 1, 1, 1]),
    make_node("Mul", "painted most", "output"),
]


@pytest.fixture(scope="module", params=[("h", "w"), (512, 512)], ids=["any-size", "512"])
def lama_file(request, tmp_path_factory):
    """Colours in [0, 1] and a mask that is 1 in the hole; colours out in [0, 255]."""
    path = tmp_path_factory.mktemp("lama") / "lama_fp32.onnx"
    return save(path, TensorProto.FLOAT, LAMA_NODES, request.param, output="output")


def convolve(mask, image):
    both = torch.cat([mask.float()[..., None], image], dim=-1).permute(2, 0, 1)[None]
    return conv2d(both, WEIGHTS, padding=1)[0].permute(1, 2, 0)


def test_migan_gets_bytes_and_a_mask_of_what_is_known(migan_file):
    filled = load_migan(str(migan_file)).fill(IMAGE, HOLE)
    seen = (255 * IMAGE).round() / 255 * (~HOLE)[..., None]
    expected = torch.where(HOLE[..., None], convolve(~HOLE, seen).clamp(0, 1), seen)
    assert (filled - expected).abs().max() <= 1.001 / 255  # bytes are cut, not rounded


def test_lama_gets_colours_and_a_mask_of_the_hole(lama_file):
    filled = load_lama(str(lama_file)).fill(IMAGE, HOLE)
    expected = convolve(HOLE, IMAGE)
    inner = slice(1, -1)
    assert filled.shape == IMAGE.shape
    assert (filled - expected)[inner, inner].abs().max() < 1e-5 * expected.abs().max()


@pytest.mark.parametrize("side", ["left", "right", "top", "bottom"])
def test_each_window_continues_what_is_known_whatever_side_that_is_on(side):
    hole = torch.ones(512, 1600, dtype=torch.bool)
    hole[:, :100] = False
    hole = {"left": hole, "right": hole.flip(1), "top": hole.T, "bottom": hole.T.flip(0)}[side]
    shares = []

    def fill(image, unfilled):
        shares.append(unfilled.float().mean().item())
        return torch.ones_like(image)

    filled = fill_windows(torch.zeros(*hole.shape, 3), hole, fill)
    assert max(shares) < 1
    assert torch.equal(filled[..., 0] > 0, hole)
    # Where nothing is known at all, windows are filled all the same.
    assert fill_windows(torch.zeros(*hole.shape, 3), torch.ones_like(hole), fill).all()


def test_windows_cover_the_image_and_overlap_by_half():
    for height, width in ((100, 300), (512, 513), (1200, 700)):
        count = torch.zeros(height, width)
        for at in place_windows(height, width):
            assert count[at].shape == (min(height, WINDOW), min(width, WINDOW))
            count[at] += 1
        assert count.min() >= 1
    columns = [columns.start for _, columns in place_windows(10, 1100)]
    assert columns[0] == 0
    assert columns[-1] + WINDOW == 1100
    assert max(np.diff(columns)) <= WINDOW / 2


def test_large_holes_are_filled_from_what_is_known_inwards():
    image, hole = torch.zeros(20, 1100, 3), torch.zeros(20, 1100, dtype=torch.bool)
    hole[:, 200:] = True
    calls = []

    def fill(part, missing):
        calls.append(missing.float().mean().item())
        return torch.full_like(part, len(calls) / 100)

    filled = fill_windows(image, hole, fill)
    assert (filled[~hole] == 0).all()
    assert (filled[hole] > 0).all()
    assert all(0 < share < 1 for share in calls)
    assert (filled[0, 200:, 0].diff() >= 0).all()


def test_colours_out_of_range_do_not_reach_the_next_window():
    """A network that overshoots is given what the image can show of it."""
    image, hole = torch.full((512, 900, 3), 0.5), torch.zeros(512, 900, dtype=torch.bool)
    hole[:, 300:700] = True
    seen = []

    def fill(part, missing):
        seen.append(part.aminmax())
        return torch.linspace(-3, 3, part.shape[0])[:, None, None].expand(part.shape)

    filled = fill_windows(image, hole, fill)
    assert len(seen) > 1
    assert all(least >= 0 and most <= 1 for least, most in seen)
    assert filled.aminmax() == (0, 1)
    assert torch.equal(filled[~hole], image[~hole])


def test_a_fill_takes_the_tone_of_what_is_beside_it():
    ring = torch.zeros(40, 40, dtype=torch.bool)
    ring[10:14] = True
    observed = torch.full((40, 40, 3), 0.4)
    toned = match_tone(observed + 0.3, observed, ring)
    assert (toned - 0.4).abs().max() < 0.01
    nowhere = torch.zeros_like(ring)
    assert torch.equal(match_tone(observed + 0.3, observed, nowhere), observed + 0.3)


def test_what_photographs_show_is_kept():
    context = known_room()
    nearest = context.views[1]
    warped = complete_warp(nearest, TARGET, context)
    generator = InpaintingGenerator(lambda image, hole: torch.rand(image.shape))
    image = generator(nearest, TARGET, context)
    assert torch.equal(image[warped.known], warped.image[warped.known].clamp(0, 1))
    assert ((image >= 0) & (image <= 1)).all()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_an_image_that_is_not_finite_is_refused(value):
    context = known_room()
    generator = InpaintingGenerator(lambda image, hole: torch.full_like(image, value))
    with pytest.raises(InputError, match="no finite image"):
        generator(context.views[1], TARGET, context)


def test_a_network_that_fails_is_refused_with_one_sentence(tmp_path):
    wide, hole = IMAGE.repeat(1, 2, 1), HOLE.repeat(1, 2)
    turn = [make_node("Transpose", "image", "output", perm=[0, 1, 3, 2])]
    turned = save(tmp_path / "turned.onnx", TensorProto.FLOAT, turn, output="output")
    with pytest.raises(
        InputError, match=r"an image of shape \(1, 3, 64, 128\) by \(1, 3, 128, 64\)"
    ):
        load_lama(str(turned)).fill(wide, hole)
    add = [make_node("Add", "turned image", "output")]
    failing = save(
        tmp_path / "failing.onnx",
        TensorProto.FLOAT,
        [make_node("Transpose", "image", "turned", perm=[0, 1, 3, 2]), *add],
        output="output",
    )
    with pytest.raises(InputError, match="failed on an image"):
        load_lama(str(failing)).fill(wide, hole)


@pytest.mark.parametrize("name", ["migan", "lama"])
def test_other_files_are_refused_with_one_sentence(name, migan_file, tmp_path):
    assert get_settings_class(name) is FileSettings
    published = PUBLISHED[name]

    def load(path):
        return load_generator(name, settings=FileSettings(weights=str(path)))

    other = tmp_path / "other.onnx"
    save(other, TensorProto.FLOAT, LAMA_NODES[:-1], inputs=("image", "mask"), output="painted")
    renamed = [make_node("Identity", "photo", "result")]
    save(tmp_path / "renamed.onnx", TensorProto.FLOAT, renamed, inputs=("photo", "mask"))
    small = save(tmp_path / "small.onnx", TensorProto.FLOAT, LAMA_NODES, (64, 64), output="output")
    (tmp_path / "cut.onnx").write_bytes(migan_file.read_bytes()[:200])
    (tmp_path / "pickled.onnx").write_bytes(pickle.dumps({"weights": [1.0]}))
    (tmp_path / "empty.onnx").write_bytes(b"")
    wrong = [tmp_path / "renamed.onnx", small, *([other] if name == "migan" else [migan_file])]
    for path in wrong:
        with pytest.raises(InputError, match=f"is no {published.model} network: its inputs are"):
            load(path)
    for path in ("cut.onnx", "pickled.onnx"):
        with pytest.raises(InputError, match="cannot be read as an ONNX network"):
            load(tmp_path / path)
    with pytest.raises(InputError, match="is empty"):
        load(tmp_path / "empty.onnx")
    with pytest.raises(InputError, match="There are no weights at"):
        load(tmp_path / "missing.onnx")


def test_the_published_file_is_verified(migan_file, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("GSCOMPLETER_HOME", str(tmp_path))
    place = tmp_path / "weights" / "mi-gan" / "migan_pipeline_v2.onnx"
    place.parent.mkdir(parents=True)
    place.write_bytes(migan_file.read_bytes())
    with pytest.raises(InputError, match="is not the published file"):
        load_migan()
    digest = hashlib.sha256(place.read_bytes()).hexdigest()
    assert run(monkeypatch, "models", "--download", "migan") == 2
    monkeypatch.setitem(PUBLISHED, "migan", replace(PUBLISHED["migan"], sha256=digest))
    assert load_migan().fill(IMAGE, HOLE).shape == IMAGE.shape
    assert run(monkeypatch, "models", "--download", "migan") == 0
    assert str(place) in capsys.readouterr().out
    assert run(monkeypatch, "models", "--download", "migan", "nobody") == 2
    assert "There are no weights 'nobody'" in capsys.readouterr().err


# `test_diffusion.py` completes with another model that fills holes; tests above call these.
@pytest.mark.slow
@pytest.mark.parametrize("name", ["lama", "migan"])
def test_a_scene_is_completed(name, migan_file, tmp_path, monkeypatch, capsys):
    lama = save(tmp_path / "lama_fp32.onnx", TensorProto.FLOAT, LAMA_NODES, output="output")
    weights = migan_file if name == "migan" else lama
    cameras = [camera_at(x, size=64) for x in (-0.3, 0.1, 0.5)]
    scene = photographed(tmp_path / "scene", cameras)
    words = ("complete", scene, "--context", "0", "1", "--target", "2", "--out", tmp_path / "out")
    words += ("--generator", name)
    assert run(monkeypatch, *words, "--generator-weights", weights) == 0
    assert len(load_ply(tmp_path / "out" / "completed.ply")) > 0
    assert run(monkeypatch, *words, "--overwrite", "--generator-steps", "4") == 2
    assert "has no setting steps" in capsys.readouterr().err

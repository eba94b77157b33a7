"""MoGe-3 and the monocular network of Depth Anything 3, with stand-ins."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import pytest
import torch

from gscompleter import InputError, load_reconstructor
from gscompleter.models.depth_anything import VARIANTS, Inference, MetricDepthAnything, ResizeConfig
from gscompleter.models.depth_anything.config import MetricDepthConfig, VitConfig
from gscompleter.models.depth_anything.monocular import MonocularDepth, load_monocular
from gscompleter.models.moge3 import MoGe3
from gscompleter.models.weights import PUBLISHED
from gscompleter.reconstructors.depth_predictors import load_depth_predictor, predict_depth
from gscompleter.stages.context import prepare_single
from scenes import Room, camera_at, view_of

SIZE = 48
VIEW = view_of(Room(), camera_at(0.1, size=SIZE), 0)
SMALL = MetricDepthConfig(VitConfig(32, 2, 4, (0, 1, 2, 3), None), 8, (8, 8, 8, 8))


class StandIn:
    """Knows the true depth; above the middle there is no surface."""

    def __init__(self, place: str) -> None:
        if place != "Ruicheng/moge-3-vitl" and not place.endswith("model.pt"):
            raise OSError("nothing there")

    from_pretrained = classmethod(lambda kind, place: kind(place))
    to = lambda self, device: self  # noqa: E731
    eval = lambda self: self  # noqa: E731

    def infer(self, image, *, fov_x, refine_steps):
        self.given = image, fov_x, refine_steps
        mask = torch.ones(SIZE, SIZE, dtype=torch.bool)
        mask[: SIZE // 4] = False
        return {"depth": VIEW.depth.where(mask, torch.inf), "mask": mask}


@pytest.fixture
def package(monkeypatch):
    names = ("moge", "moge.model", "moge.model.v3")
    modules = {name: ModuleType(name) for name in names}
    modules["moge"].__spec__ = ModuleSpec("moge", None)
    modules["moge.model.v3"].MoGeModel = StandIn
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)


def test_moge3_gets_the_field_of_view_and_gives_metres(package):
    predict = load_depth_predictor("moge-3-large")
    depth = predict_depth(predict, VIEW)
    image, fov_x, refine_steps = predict.model.given
    assert torch.equal(image.permute(1, 2, 0), VIEW.image)
    assert math.tan(math.radians(fov_x) / 2) == pytest.approx(0.5 / 0.9, rel=1e-6)
    assert refine_steps == 0  # refinement needs a GPU
    assert depth.valid.float().mean() == pytest.approx(0.75, abs=0.01)
    assert torch.equal(depth.depth[depth.valid], VIEW.depth[depth.valid])
    assert depth.depth.isfinite().all()


def test_moge3_serves_a_single_photograph(package, tmp_path):
    file = tmp_path / "model.pt"
    file.touch()
    psi = load_reconstructor("plane-sweep", depth="moge-3-large", depth_weights=file)
    (view,) = prepare_single(psi, [replace(VIEW, depth=None)])
    assert view.given_depth is not None
    assert torch.equal(view.given_depth > 0, psi.predict_depth(VIEW).valid)


def test_moge3_without_its_package_or_weights(package, monkeypatch, tmp_path):
    with pytest.raises(InputError, match="was not loaded from Ruicheng/moge-3-vitg"):
        load_depth_predictor("moge-3-giant")
    with pytest.raises(InputError, match="There are no weights at some/where"):
        load_depth_predictor("moge-3-large", Path("some/where"))
    with pytest.raises(InputError, match="is no file; name the file"):
        load_depth_predictor("moge-3-large", tmp_path)
    monkeypatch.setitem(sys.modules, "moge.model.v3", None)
    with pytest.raises(InputError, match="pip install git"):
        load_depth_predictor("moge-3-large")


def test_another_shape_of_moge3_is_refused():
    class Other(StandIn):
        def infer(self, image, *, fov_x, refine_steps):
            return {"depth": torch.ones(3, 3), "mask": torch.ones(3, 3, dtype=torch.bool)}

    with pytest.raises(InputError, match="answered an image of 48 x 48"):
        MoGe3(Other("model.pt"))(VIEW)


def test_the_sky_of_depth_anything_has_no_depth():
    torch.manual_seed(0)
    network = MetricDepthAnything(SMALL).eval()
    predict = MonocularDepth(network, Inference(ResizeConfig(56)))
    # A score that is sky everywhere but in the lower half of the photograph.
    forward = network.forward

    def with_sky(images):
        predicted = forward(images)
        sky = torch.zeros_like(predicted.sky)
        sky[..., : sky.shape[-2] // 2, :] = 1.0
        return replace(predicted, sky=sky)

    network.forward = with_sky
    depth = predict_depth(predict, VIEW)
    assert not depth.valid[: SIZE // 2 - 2].any()
    assert depth.valid[SIZE // 2 + 2 :].all()
    assert (depth.depth[depth.valid] > 0).all()


def test_a_file_of_depth_anything_fills_the_network(tmp_path, monkeypatch):
    safetensors = pytest.importorskip("safetensors.torch", reason="needs gscompleter[models]")
    torch.manual_seed(0)
    network = MetricDepthAnything(SMALL).eval()
    state = {f"model.{name}": tensor for name, tensor in network.state_dict().items()}
    safetensors.save_file(state, tmp_path / "model.safetensors")
    monkeypatch.setitem(VARIANTS, "da3-mono-large", SMALL)
    loaded = load_monocular("da3-mono-large", tmp_path / "model.safetensors")
    expected = replace(loaded, network=network)(VIEW)
    assert torch.equal(loaded(VIEW).depth, expected.depth)
    with pytest.raises(InputError, match="does not fit"):
        del state["model.head.scratch.output_conv1.weight"]
        safetensors.save_file(state, tmp_path / "model.safetensors")
        load_monocular("da3-mono-large", tmp_path / "model.safetensors")


def test_the_published_size_is_that_of_the_network():
    with torch.device("meta"):
        network = MetricDepthAnything(VARIANTS["da3-mono-large"])
    count = sum(parameter.numel() for parameter in network.parameters())
    assert count == PUBLISHED["da3-mono-large"].parameters


def test_all_of_them_are_depths_by_name():
    with pytest.raises(InputError, match="da3-mono-large.*moge-3-large, moge-3-giant"):
        load_depth_predictor("none-such")

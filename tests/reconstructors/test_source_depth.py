"""Source depth of PE-Field's positions: positive everywhere, in the unit of the scene."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gscompleter import InputError
from gscompleter.models.diffusion import source_depth
from gscompleter.models.diffusion.source_depth import (
    MonocularDepth,
    PredictedDepth,
    compute_context_depth,
    convert_disparity,
    load_monocular,
    load_source_depth,
    rescale_depth,
)
from gscompleter.types import DepthMap, Render
from known_room import known_room
from tiny_depth_model import tiny_model

CONTEXT = known_room()
VIEW, RENDER = CONTEXT.views[0], CONTEXT.view_renders[0]
HOLED = torch.ones(96, 96, dtype=torch.bool)
HOLED[30:60, 30:60] = False


def holed(unit: float = 1.0) -> Render:
    """Return the room with a square hole in it."""
    return Render(RENDER.image, unit * RENDER.depth * HOLED, RENDER.alpha * HOLED)


def test_the_scenes_own_depth_stays_and_its_holes_are_between_what_surrounds_them():
    depth, valid = compute_context_depth(VIEW, holed()), HOLED & (RENDER.alpha >= 0.5)
    assert torch.equal(depth[valid], RENDER.depth[valid])
    assert depth.isfinite().all()
    assert depth.min() >= RENDER.depth[valid].min() - 1e-4
    assert depth.max() <= RENDER.depth[valid].max() + 1e-4
    ring = depth[29:61, 29:61][~HOLED[29:61, 29:61]]
    assert (ring > 0).all()


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_unit_of_length_does_not_matter(unit):
    depth = compute_context_depth(VIEW, holed())
    assert torch.allclose(compute_context_depth(VIEW, holed(unit)), unit * depth, rtol=1e-4)


def test_a_guess_in_another_unit_is_brought_to_the_scenes():
    true = RENDER.depth.clamp_min(0.1)
    assert torch.allclose(rescale_depth(7.0 * true, holed()), true, rtol=1e-3)


def test_where_a_predictor_sees_no_surface_it_measures_no_scale():
    """It takes the larger part of what the scene shows for the sky."""
    true = RENDER.depth.clamp_min(1.0)
    valid = torch.zeros(96, 96, dtype=torch.bool)
    valid[:, :30] = True
    shown = replace(RENDER, depth=torch.where(valid, true, 50 * true.max()))
    predict = PredictedDepth(lambda _: DepthMap(torch.where(valid, true / 7, 1.0), valid))
    assert torch.allclose(predict(VIEW, shown)[valid], true[valid], rtol=1e-3)
    nothing = PredictedDepth(lambda _: DepthMap(true, torch.zeros_like(valid)))
    with pytest.raises(InputError, match="no surface where the scene has one"):
        nothing(VIEW, shown)


def test_a_disparity_of_unknown_scale_and_shift_is_brought_to_the_scenes_depth():
    true = RENDER.depth.clamp_min(1.0)
    guess = 40 / true + 3
    guess[:20, :20] = 200.0  # a part of it is wrong
    found = convert_disparity(guess, replace(holed(), depth=true * HOLED))
    assert ((found - true) / true).abs()[21:, 21:].max() < 0.02


def test_a_scene_nobody_sees_is_refused():
    with pytest.raises(InputError, match="sees nothing"):
        compute_context_depth(VIEW, replace(RENDER, alpha=torch.zeros(96, 96)))


def tiny_dpt(folder: Path) -> Path:
    """DPT with random weights, without the layer that it never uses, as in published files."""
    transformers = pytest.importorskip("transformers", reason="needs gscompleter[diffusion]")
    torch.manual_seed(0)
    config = transformers.DPTConfig(
        hidden_size=32,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=32,
        image_size=32,
        patch_size=16,
        backbone_out_indices=[0, 1, 2, 3],
        neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8,
        is_hybrid=False,
    )
    model = transformers.DPTForDepthEstimation(config)
    weights = model.state_dict()
    unused = [name for name in weights if "fusion_stage.layers.0.residual_layer1." in name]
    assert unused
    model.save_pretrained(
        folder, state_dict={name: v for name, v in weights.items() if name not in unused}
    )
    size = {"height": 32, "width": 32}
    transformers.DPTImageProcessorPil(size=size, do_pad=False).save_pretrained(folder)
    return folder


def tiny_glpn(folder: Path) -> Path:
    """GLPN, which gives depth in metres, with random weights."""
    transformers = pytest.importorskip("transformers", reason="needs gscompleter[diffusion]")
    torch.manual_seed(0)
    config = transformers.GLPNConfig(
        depths=[1, 1, 1, 1],
        hidden_sizes=[8, 16, 16, 32],
        num_attention_heads=[1, 1, 2, 2],
        decoder_hidden_size=8,
    )
    transformers.GLPNForDepthEstimation(config).save_pretrained(folder)
    transformers.GLPNImageProcessorPil().save_pretrained(folder)
    return folder


@pytest.mark.parametrize("tiny", [tiny_dpt, tiny_glpn])
def test_other_networks_of_transformers_are_read_as_what_they_give(tiny, tmp_path, monkeypatch):
    pytest.importorskip("diffusers", reason="needs gscompleter[diffusion]")
    calls = []
    for name in ("rescale_depth", "convert_disparity"):
        fit = getattr(source_depth, name)
        monkeypatch.setattr(
            source_depth, name, lambda *a, name=name, fit=fit: calls.append(name) or fit(*a)
        )
    depth = load_source_depth(str(tiny(tmp_path)))(VIEW, holed())
    assert calls == ["convert_disparity" if tiny is tiny_dpt else "rescale_depth"]
    assert depth.shape == (96, 96)
    assert (depth > 0).all()


def test_a_network_of_which_it_is_not_known_what_it_gives_is_refused(tmp_path, monkeypatch):
    folder = str(tiny_model(tmp_path))
    monkeypatch.setattr(source_depth, "PREDICTS_DEPTH", {"dpt": False})
    with pytest.raises(InputError, match=r"unsupported kind depth_anything; choose one of dpt"):
        load_source_depth(folder)


def test_a_network_that_lacks_a_tensor_is_refused(tmp_path):
    safetensors = pytest.importorskip("safetensors.torch", reason="needs gscompleter[models]")
    (file,) = tiny_model(tmp_path).glob("*.safetensors")
    weights = safetensors.load_file(file)
    weights.pop(sorted(weights)[0])
    safetensors.save_file(weights, file, metadata={"format": "pt"})
    with pytest.raises(InputError, match=r"its network lacks the tensor .*save_pretrained"):
        load_source_depth(str(tmp_path))


def test_a_model_of_transformers_gives_a_depth_in_the_scenes_unit(tmp_path):
    """A smoke test: random weights guess noise."""
    model = load_monocular(str(tiny_model(tmp_path)))
    assert isinstance(model, MonocularDepth)
    depth = model(VIEW, holed())
    assert depth.shape == (96, 96)
    assert (depth > 0).all()
    larger = model(VIEW, holed(1000.0))
    assert torch.allclose(larger, 1000 * depth, rtol=1e-3)

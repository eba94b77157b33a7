"""The depth that PE-Field's positions come from: positive everywhere, in the scene's unit."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gscompleter import InputError
from gscompleter.generators.diffusion.source_depth import (
    MonocularDepth,
    context_depth,
    from_disparity,
    load_monocular,
    rescaled,
)
from gscompleter.types import Render
from test_generators import known_room

CONTEXT = known_room()
VIEW, RENDER = CONTEXT.views[0], CONTEXT.at_views[0]
HOLED = torch.ones(96, 96, dtype=torch.bool)
HOLED[30:60, 30:60] = False


def holed(unit: float = 1.0) -> Render:
    """The room with a square hole in it."""
    return Render(RENDER.image, unit * RENDER.depth * HOLED, RENDER.alpha * HOLED)


def test_the_scenes_own_depth_stays_and_its_holes_are_between_what_surrounds_them():
    depth, valid = context_depth(VIEW, holed()), HOLED & (RENDER.alpha >= 0.5)
    assert torch.equal(depth[valid], RENDER.depth[valid])
    assert depth.isfinite().all()
    assert depth.min() >= RENDER.depth[valid].min() - 1e-4
    assert depth.max() <= RENDER.depth[valid].max() + 1e-4
    ring = depth[29:61, 29:61][~HOLED[29:61, 29:61]]
    assert (ring > 0).all()


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_unit_of_length_does_not_matter(unit):
    depth = context_depth(VIEW, holed())
    assert torch.allclose(context_depth(VIEW, holed(unit)), unit * depth, rtol=1e-4)


def test_a_guess_in_another_unit_is_brought_to_the_scenes():
    true = RENDER.depth.clamp_min(0.1)
    assert torch.allclose(rescaled(7.0 * true, holed()), true, rtol=1e-3)


def test_a_disparity_of_unknown_scale_and_shift_is_brought_to_the_scenes_depth():
    true = RENDER.depth.clamp_min(1.0)
    guess = 40 / true + 3
    guess[:20, :20] = 200.0  # a part of it is wrong
    found = from_disparity(guess, replace(holed(), depth=true * HOLED))
    assert ((found - true) / true).abs()[21:, 21:].max() < 0.02


def test_a_scene_nobody_sees_is_refused():
    with pytest.raises(InputError, match="sees nothing"):
        context_depth(VIEW, replace(RENDER, alpha=torch.zeros(96, 96)))


def tiny_model(folder: Path) -> Path:
    """Depth Anything with random weights."""
    transformers = pytest.importorskip("transformers", reason="needs gscompleter[diffusion]")
    pytest.importorskip("diffusers", reason="needs gscompleter[diffusion]")
    torch.manual_seed(0)
    backbone = transformers.Dinov2Config(
        hidden_size=32,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=32,
        image_size=56,
        patch_size=14,
        out_features=["stage1", "stage2", "stage3", "stage4"],
        reshape_hidden_states=False,
    )
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=32,
        neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8,
        head_hidden_size=8,
    )
    transformers.DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    size = {"height": 56, "width": 56}
    processor = transformers.DPTImageProcessorPil(size=size, ensure_multiple_of=14, do_pad=False)
    processor.save_pretrained(folder)
    return folder


def test_a_model_of_transformers_gives_a_depth_in_the_scenes_unit(tmp_path):
    """A smoke test: random weights guess noise."""
    model = load_monocular(str(tiny_model(tmp_path)))
    assert isinstance(model, MonocularDepth)
    depth = model(VIEW, holed())
    assert depth.shape == (96, 96)
    assert (depth > 0).all()
    larger = model(VIEW, holed(1000.0))
    assert torch.allclose(larger, 1000 * depth, rtol=1e-3)

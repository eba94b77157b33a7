"""The feed-forward networks and PE-Field on the fake CUDA device of `support/fake_cuda.py`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

import tiny_diffusion
from fake_cuda import Counts, fake_cuda
from gscompleter.models.depth_anything import (
    AnyViewDepth,
    DepthAnything,
    DepthAnythingConfig,
    Inference,
    ResizeConfig,
)
from gscompleter.models.depth_anything.config import VitConfig
from gscompleter.models.feed_forward import (
    DepthSplat,
    FeedForward,
    MVSplat,
    VolSplat,
    VolSplatConfig,
)
from gscompleter.models.feed_forward.depth_predictor import DepthConfig
from gscompleter.models.feed_forward.depthsplat import VARIANTS
from gscompleter.reconstructors import Reconstructor, run_reconstructor
from gscompleter.reconstructors.from_depth import FromDepth
from gscompleter.system.tensor_checks import iterate_tensors
from gscompleter.types import Render
from known_room import TARGET, known_room
from scenes import Room, answer, camera_at, view_of

pytestmark = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")


@pytest.fixture
def device() -> Iterator[Counts]:
    with fake_cuda() as counts:
        yield counts


def make_depth_anything() -> Reconstructor:
    vit = VitConfig(64, 1, 4, (0, 1, 2, 3), 1)
    network = DepthAnything(DepthAnythingConfig(vit, 32, (16,) * 4, False))
    network = network.eval().requires_grad_(False).to("cuda")
    return FromDepth(model=AnyViewDepth(network, Inference(ResizeConfig(56))))


def make_feed_forward(network: torch.nn.Module) -> Reconstructor:
    return FeedForward(network.eval().requires_grad_(False).to("cuda"))


NETWORKS = {
    "mvsplat": lambda: make_feed_forward(MVSplat()),
    "depthsplat": lambda: make_feed_forward(DepthSplat(VARIANTS["small-re10k-256x256"])),
    "volsplat": lambda: make_feed_forward(
        VolSplat(VolSplatConfig(DepthConfig("vits", 1, 4, 4), voxel_resolution=0.02))
    ),
    "depth-anything": make_depth_anything,
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name != "depth-anything"))
        for name in NETWORKS
    ],
)
def test_networks_reconstruct_on_the_device(device, name):
    torch.manual_seed(0)
    size = 56 if name == "depth-anything" else 64
    views = [view_of(Room(), camera_at(x, size=size), i) for i, x in enumerate((-0.3, 0.1))]
    found = run_reconstructor(NETWORKS[name](), [view.to("cuda") for view in views])
    tensors = dict(iterate_tensors(found, "it"))
    assert tensors
    assert [key for key, tensor in tensors.items() if not tensor.is_cuda] == []
    assert found.gaussians.means.cpu().isfinite().all()


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name != "depth-anything"))
        for name in NETWORKS
    ],
)
def test_networks_run_on_the_gpu_of_a_mac(name):
    """It has no numbers of 64 bits. The views stay on the CPU, which draws there."""
    torch.manual_seed(0)
    size = 56 if name == "depth-anything" else 64
    views = [view_of(Room(), camera_at(x, size=size), i) for i, x in enumerate((-0.3, 0.1))]
    with fake_cuda(has_doubles=False):
        found = run_reconstructor(NETWORKS[name](), views)
    assert found.gaussians.means.isfinite().all()


def move(render: Render) -> Render:
    return Render(*(part.to("cuda") for part in (render.image, render.depth, render.alpha)))


@pytest.mark.slow
def test_pe_field_paints_on_the_device(device, tmp_path):
    pytest.importorskip("diffusers")
    from gscompleter.models.diffusion.loading import load_kontext
    from gscompleter.models.diffusion.pe_field import PEField
    from gscompleter.models.diffusion.source_depth import compute_context_depth

    folder = tiny_diffusion.saved(tiny_diffusion.kontext_pipeline(), tmp_path / "kontext")
    model = load_kontext(str(folder), "cuda")
    assert model.dtype == torch.bfloat16
    context = known_room()
    context = replace(
        context,
        views=tuple(view.to("cuda") for view in context.views),
        view_renders=tuple(move(render) for render in context.view_renders),
        target_render=move(context.target_render),
    )
    generator = PEField(model, steps=1, depth=compute_context_depth, device="cuda")
    painted = answer(generator, context.views[1], TARGET.to("cuda"), context).image
    assert painted.is_cuda
    assert painted.cpu().isfinite().all()

"""Construction of reconstructors from the names of published weights."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import torch

from gscompleter.models import depth_anything
from gscompleter.models.depth_anything import (
    AnyViewDepth,
    AnyViewGaussians,
    DepthAnything,
    DepthAnythingConfig,
    Inference,
    MetricDepthAnything,
    MetricDepthConfig,
    MetricViewDepth,
    NestedConfig,
    NestedDepthAnything,
)
from gscompleter.models.feed_forward.depthsplat import VARIANTS, DepthSplat
from gscompleter.models.feed_forward.mvsplat import MVSplat
from gscompleter.models.feed_forward.reconstructor import FeedForward
from gscompleter.models.feed_forward.volsplat import VolSplat
from gscompleter.models.weights import (
    PUBLISHED,
    PublishedWeights,
    fetch,
    load_strictly,
    read_state_dict,
)
from gscompleter.models.weights.fitting import get_shapes
from gscompleter.reconstructors.from_depth import FromDepth

DepthAnythingNetwork = DepthAnything | MetricDepthAnything | NestedDepthAnything
Network = MVSplat | DepthSplat | VolSplat | DepthAnythingNetwork
LearnedReconstructor = FeedForward | FromDepth | AnyViewGaussians


@lru_cache(maxsize=1)
def build(name: str, weights: Path | None = None, device: str = "cpu") -> LearnedReconstructor:
    """Load the reconstructor with the published weights `name`; the last one is cached.

    Args:
        name: A key of `PUBLISHED` that belongs to a reconstructor.
        weights: The file, or the folder that contains it. If None, it is downloaded.
        device: Device on which the network runs.

    Raises:
        InputError: The weights are missing, damaged, or of another network.
    """
    published = PUBLISHED[name]
    path = fetch(published, weights)
    state = read_state_dict(path, published)
    network = create_network(published)
    load_strictly(network, state, path, collect_all_shapes)
    network = network.eval().requires_grad_(False).to(device)
    return wrap_network(network, depth_range=published.near_far)


def wrap_network(
    network: Network,
    dtype: torch.dtype = torch.float32,
    depth_range: tuple[float, float] | None = None,
) -> LearnedReconstructor:
    """Wrap a network as a reconstructor; any `dtype` but float32 needs a GPU.

    `depth_range` is near and far for cameras without them, in scene units. Depth Anything 3 sweeps
    no planes and takes none.
    """
    inference = Inference(dtype=dtype)
    if isinstance(network, MetricDepthAnything):
        return FromDepth(model=MetricViewDepth(network, inference))
    if isinstance(network, NestedDepthAnything):
        return AnyViewGaussians(network, inference)
    if isinstance(network, DepthAnything):
        # Depth with a head for Gaussians makes these; without one, `FromDepth` does.
        if network.gs_head is not None:
            return AnyViewGaussians(network, inference)
        return FromDepth(model=AnyViewDepth(network, inference))
    return FeedForward(network, dtype, depth_range)


def create_network(published: PublishedWeights) -> Network:
    """Create the network that fits a file of weights, with random parameters."""
    if published.name in depth_anything.VARIANTS:
        return create_depth_anything(depth_anything.VARIANTS[published.name])
    if published.model == "MVSplat":
        return MVSplat()
    if published.model == "VolSplat":
        return VolSplat()
    assert published.model == "DepthSplat", published.name
    # Published names omit a size of 256x256.
    variant = published.name.removeprefix("depthsplat-")
    return DepthSplat(VARIANTS[variant if variant in VARIANTS else f"{variant}-256x256"])


def create_depth_anything(
    config: DepthAnythingConfig | MetricDepthConfig | NestedConfig,
) -> DepthAnythingNetwork:
    """Create a Depth Anything 3 network with random parameters."""
    if isinstance(config, NestedConfig):
        return NestedDepthAnything(config)
    if isinstance(config, MetricDepthConfig):
        return MetricDepthAnything(config)
    return DepthAnything(config)


def collect_all_shapes() -> dict[str, dict[str, tuple[int, ...]]]:
    """Collect the tensor shapes of every supported network by the name of its weights."""
    # Without memory or random numbers: only the shapes are wanted.
    with torch.device("meta"):
        return {
            name: get_shapes(create_network(published).state_dict())
            for name, published in PUBLISHED.items()
            if published.is_reconstructor
        }

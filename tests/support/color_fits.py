"""What tests of colours by direction share, for two photographs and for many."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from gscompleter.evaluation.metrics.image import psnr
from gscompleter.render.loading import load_renderer
from gscompleter.types import Gaussians, View, merge
from scenes import gaussians_of


def fit_with(fit: Callable[..., Gaussians], views: Sequence[View]) -> tuple[Gaussians, Gaussians]:
    """Return the Gaussians of all photographs before and after a fit of their colours."""
    scene, renderer = merge([gaussians_of(view) for view in views]), load_renderer("cpu")
    depths = [renderer.render(scene, view.camera).depth_map() for view in views]
    return scene, fit(scene, views, depths, renderer)


def measure_covered(scene: Gaussians, view: View) -> float:
    """PSNR where the scene covers the image."""
    render = load_renderer("cpu").render(scene, view.camera)
    covered = render.alpha > 0.9
    return psnr(render.image[covered][None], view.image[covered][None])

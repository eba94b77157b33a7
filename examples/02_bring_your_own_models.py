"""Plug in your own Ψ and Φ: any callables will do.

    python examples/02_bring_your_own_models.py SCENE 0 4 8

Here Ψ is the embedded stereo with larger Gaussians, and Φ fills the hole with the mean colour of
the nearest photograph, which is the least a generator can do.
"""

import sys

import torch

import gscompleter as gsc
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.types import GeneratorInput


def mean_colour(nearest: gsc.View, target: gsc.Camera, context: GeneratorInput) -> torch.Tensor:
    """Fill holes of the rendered scene with the photograph's mean colour."""
    seen = context.target_render
    fill = nearest.image.mean(dim=(0, 1))
    return (seen.image + (1 - seen.alpha)[..., None] * fill).clamp(0, 1)


def main() -> None:
    scene, first, second, target = sys.argv[1], *map(int, sys.argv[2:5])
    views = gsc.load_views(scene, frames=[first, second], resolution=256)
    camera = gsc.load_camera(scene, frame=target, resolution=256)

    completer = gsc.GSCompleter(
        reconstructor=PlaneSweep(disc_sigma=0.7),
        generator=mean_colour,
        config=gsc.CompleterConfig.paper(),
    )
    completion = completer(views, camera)
    print(f"{len(completion.added):,} Gaussians joined {len(completion.context):,}.")
    gsc.save_ply("completed.ply", completion.scene)


if __name__ == "__main__":
    main()

"""A Φ of your own: the image at a target camera, of which only the holes are used.

    gscompleter complete SCENE --out OUT --generator examples/08_own_generator.py:paint

Here the holes get the mean colour of what is seen. `03_bring_your_own_generator.py` checks its
image against the photographs, too.
"""

import torch

import gscompleter as gsc


def paint(
    nearest: gsc.View, target: gsc.Camera, context: gsc.GeneratorInput
) -> gsc.GeneratorOutput:
    """Return the image [h, w, 3] in [0, 1] of the target, and sentences for the report."""
    seen = context.target_render
    holes = context.holes
    # Renders are over black; where they are no hole, their colour is divided by what covers it.
    colors = seen.image / seen.alpha.clamp_min(context.max_alpha)[..., None]
    known = colors[~holes] if bool((~holes).any()) else nearest.image.reshape(-1, 3)
    image = torch.where(holes[..., None], known.mean(dim=0), colors).clamp(0, 1)
    return gsc.GeneratorOutput(image, ("The holes have the mean colour of the scene.",))

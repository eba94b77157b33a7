"""Bring your own Φ, checked against the photographs and described in the report.

    python examples/03_bring_your_own_generator.py SCENE 0 4 8

Here Φ is OpenCV's inpainting over the warped photographs. A diffusion model goes in the same place.
"""

import sys
from dataclasses import dataclass

import cv2
import torch

import gscompleter as gsc
from gscompleter.generators import GeneratorOutput
from gscompleter.generators.agreement import paint_consistently
from gscompleter.generators.warp import warp_photographs
from gscompleter.types import GeneratorInput


@dataclass(frozen=True)
class Telea:
    """Φ that continues the border of a hole along its level lines."""

    radius: float = 5.0

    def __call__(
        self, nearest: gsc.View, target: gsc.Camera, context: GeneratorInput
    ) -> GeneratorOutput:
        """Return the image [h, w, 3] in [0, 1], and sentences for `notes` of the target."""
        warped = warp_photographs(nearest, target, context)
        pixels = (255 * warped.image).byte().cpu().numpy()
        hole = (~warped.known).byte().cpu().numpy()

        def paint(seed: int) -> torch.Tensor:
            filled = cv2.inpaint(pixels, hole, self.radius, cv2.INPAINT_TELEA)
            return torch.from_numpy(filled).float().to(nearest.image.device) / 255

        return paint_consistently(paint, seed=0, observed=warped)


def main() -> None:
    scene, first, second, target = sys.argv[1], *map(int, sys.argv[2:5])
    views = gsc.load_views(scene, frames=[first, second], resolution=256)
    camera = gsc.load_camera(scene, frame=target, resolution=256)
    completion = gsc.GSCompleter(generator=Telea())(views, camera)
    print(f"{len(completion.added):,} Gaussians joined {len(completion.context):,}.")
    for note in completion.targets[0].notes:
        print(note)
    gsc.save_ply("completed.ply", completion.scene)


if __name__ == "__main__":
    main()

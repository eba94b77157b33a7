"""A Ψ of your own: photographs with cameras in, Gaussians and depths out.

    gscompleter complete SCENE --out OUT --reconstructor examples/07_own_reconstructor.py:Billboards

Here each photograph becomes a flat picture in the middle of the depth range, which is the least a Ψ
can do. A network goes in the same place. All tensors stay on the device of the images.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

import gscompleter as gsc

SH_C0 = 0.28209479177387814  # colour = 0.5 + SH_C0 * harmonic


@dataclass(frozen=True)
class Billboards:
    """Ψ that paints each photograph onto a plane across its view."""

    opacity: float = 0.95

    def __call__(self, views: Sequence[gsc.View]) -> gsc.Reconstruction:
        """Reconstruct Gaussians in the frame of the cameras, and a depth map per view."""
        planes = [self.place(view) for view in views]
        depths = [make_depth(view) for view in views]
        counts = [view.image.shape[0] * view.image.shape[1] for view in views]
        device = views[0].image.device
        return gsc.Reconstruction(
            gsc.merge(planes),
            tuple(depths),
            # Optional: the view and the pixel of each Gaussian, which registration can use.
            view_index=torch.cat(
                [torch.full((n,), v, device=device) for v, n in enumerate(counts)]
            ),
            pixel_index=torch.cat([torch.arange(n, device=device) for n in counts]),
        )

    def place(self, view: gsc.View) -> gsc.Gaussians:
        """Place a disc at each pixel's depth, half a pixel in size."""
        camera = view.camera
        depth = make_depth(view).depth.flatten()
        means = camera.center + depth[:, None] * camera.z_rays().reshape(-1, 3)
        size = 0.6 * depth / camera.K[0, 0]
        facing_world = depth.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(depth), 4)
        colors = (view.image.reshape(-1, 1, 3) - 0.5) / SH_C0
        opacities = torch.full_like(depth, self.opacity)
        return gsc.make_observed(
            means, facing_world.contiguous(), size[:, None].repeat(1, 3), opacities, colors
        )


def make_depth(view: gsc.View) -> gsc.DepthMap:
    """Return one depth for the whole image: the middle of the range in inverse depth."""
    near, far = view.camera.near or 1.0, view.camera.far or 10.0
    depth = torch.full_like(view.image[..., 0], 2 / (1 / near + 1 / far))
    return gsc.DepthMap(depth, torch.ones_like(depth, dtype=torch.bool))

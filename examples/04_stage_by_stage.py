"""The four stages of the paper, one call each.

    python examples/04_stage_by_stage.py SCENE 0 4 8

SCENE is what `gscompleter complete` takes; the numbers are two context frames and the target frame.
`GSCompleter` does this with a wider target image, and checks what is added against the photographs.
"""

import sys

import torch

import gscompleter as gsc
from gscompleter import stages
from gscompleter.numerics.geometry import pad_camera
from gscompleter.render.cache import SceneRenderer


def main() -> None:
    scene, first, second, number = sys.argv[1], *map(int, sys.argv[2:5])
    psi, phi = gsc.load_reconstructor("plane-sweep"), gsc.load_generator("warp-inpaint")
    config = gsc.CompleterConfig.paper()

    # 1. Context: Gaussians of what was photographed.
    views = gsc.load_views(scene, frames=[first, second], resolution=256)
    state = gsc.GSCompleter(psi, phi, config=config).begin(views)
    print(f"context: {len(state.context):,} Gaussians")

    # 2. Anchor and lift: an image at the target, and its stereo with the best photograph.
    target = state.with_depth_range(gsc.load_camera(scene, frame=number, resolution=256))
    scenes = SceneRenderer(gsc.load_renderer("cpu"))
    view = stages.render_target(state, pad_camera(target, 0.0), scenes)
    anchor = stages.choose_anchor(view)
    (image,) = stages.synthesize(phi, [(target, stages.make_generator_input(view))])
    lifted = stages.lift(psi, image, anchor, view)
    print(f"anchor: context view {anchor.index}; {len(lifted.gaussians):,} candidates")

    # 3. Register: one affine for all depths, then each Gaussian along its ray.
    affine = stages.align_depth(lifted, anchor, view, torch.Generator().manual_seed(0))
    moved = stages.register_as_paper(lifted, affine, image, anchor, view)
    print(f"affine: {affine}")
    print(f"loss: {moved.losses[0]:.4f} to {moved.losses[-1]:.4f}")

    # 4. Integrate: what lies in the hole, with opacities that suit all images.
    added = stages.refine(stages.filter_holes(moved, view), image, view).gaussians
    left = stages.compute_hole_mask(view.frozen.composite(added).alpha)
    shares = view.empty.float().mean(), left.float().mean()
    print("holes: {:.1%} of the target's pixels, {:.1%} left".format(*shares))
    gsc.save_ply("completed.ply", gsc.merge([state.context, added]))


if __name__ == "__main__":
    main()

"""The four stages of the paper, one call each.

    python examples/05_stage_by_stage.py SCENE 0 4 8

SCENE is what `gscompleter complete` takes; the numbers are two context frames and the target frame.
`GSCompleter` does this with a wider target image, and checks what is added against the photographs.
"""

import sys
from dataclasses import replace

import torch

import gscompleter as gsc
from gscompleter.stages.context import find_depth_range, init_context
from gscompleter.stages.filter_holes import compute_hole_mask, filter_holes
from gscompleter.stages.refine import refine_opacities
from gscompleter.stages.select_anchor import lift, select_anchor, synthesize
from gscompleter.stages.slide_along_rays import register
from gscompleter.types import GeneratorInput


def main() -> None:
    scene, first, second, number = sys.argv[1], *map(int, sys.argv[2:5])
    psi, phi = gsc.load_reconstructor("plane-sweep"), gsc.load_generator("warp-inpaint")
    renderer = gsc.load_renderer("cpu")

    views = gsc.load_views(scene, frames=[first, second], resolution=256)
    near, far = find_depth_range(views, None, renderer)
    views = gsc.load_views(scene, frames=[first, second], resolution=256, near=near, far=far)
    target = gsc.load_camera(scene, frame=number, resolution=256, near=near, far=far)

    # 1. Context: Gaussians of what was photographed.
    context, _ = init_context(psi, views)
    print(f"context: {len(context):,} Gaussians, depths from {near:.3g} to {far:.3g}")

    # 2. Anchor and lift: an image at the target, and its stereo with the best photograph.
    at_target = renderer.freeze(context, target)
    at_views = [renderer.freeze(context, view.camera) for view in views]
    seen = tuple(frozen.render for frozen in at_views)
    reference = synthesize(phi, target, GeneratorInput(tuple(views), seen, at_target.render))
    choice = select_anchor(target, views)
    anchor = views[choice.index].camera
    lifted = lift(psi, reference, views[choice.index])
    print(f"anchor: context view {choice.index}; {len(lifted.gaussians):,} candidates")

    # 3. Register: one affine for all depths, then each Gaussian along its ray.
    rng = torch.Generator().manual_seed(0)
    registered = register(lifted, at_target, seen[choice.index], reference, anchor, renderer, rng)
    print(f"affine: {registered.affine}")
    print(f"loss: {registered.losses[0]:.4f} to {registered.losses[-1]:.4f}")

    # 4. Integrate: what lies in the hole, with opacities that suit all images.
    holes = compute_hole_mask(at_target.render.alpha)
    added = filter_holes(registered.gaussians, lifted.pixel_index, holes, target)
    planned = [view.vary_opacities(added) for view in at_views]
    added, _ = refine_opacities(added, at_target.vary_opacities(added), reference, planned, views)
    left = compute_hole_mask(at_target.composite(added).alpha)
    print(
        f"holes: {holes.float().mean():.1%} of the target's pixels, {left.float().mean():.1%} left"
    )

    added = replace(added, generated=torch.ones_like(added.generated))
    gsc.save_ply("completed.ply", gsc.merge([context, added]))


if __name__ == "__main__":
    main()

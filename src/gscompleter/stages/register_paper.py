"""Registration of the lifted Gaussians as the paper has it: Eq. 9 to 11 (Sec. III-E).

The affine of Eq. 8 is given (`align_paper.py`). `register.py` is our registration, which departs
from the paper where measurements favour another choice. `docs/paper.md` lists how we read what the
paper leaves open; comments here say "our reading" at these places.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.config import PaperRegistrationConfig
from gscompleter.numerics.adam import Adam
from gscompleter.numerics.geometry import compute_z_depths, slide
from gscompleter.render.redraw import composite_beside
from gscompleter.stages.select_anchor import Anchor
from gscompleter.stages.target_view import TargetView
from gscompleter.system.progress import track
from gscompleter.system.threads import use_one_torch_thread
from gscompleter.system.timing import timed_stage
from gscompleter.types import Camera, DepthAffine, DepthMap, Gaussians, Lift, Registration, View

PAPER_ADAM_BETAS = (0.9, 0.999)
"""Adam's usual decay rates; the paper names neither the optimizer nor its rates."""


@timed_stage("register")
@use_one_torch_thread()
def register_as_paper(
    lifted: Lift, affine: DepthAffine, reference: View, anchor: Anchor, view: TargetView
) -> Registration:
    """Align all Gaussians by one affine of depth, then each along its own ray.

    With `paper()` these are all of G_tgt: the paper filters by holes only afterwards. `reference`
    is the synthesized image Ĩ_t at the target camera.
    """
    initial = initialize_distances(lifted.gaussians, affine, reference.camera)
    if len(initial) == 0 or view.state.config.paper_registration.iterations == 0:
        # Nothing was lifted, or the ablation without RC (Table IV): the affine alone counts. The
        # paper's text calls that row "unconstrained optimization"; our reading is that of its name.
        return Registration(initial, lifted.pixel_index, ())
    registered, losses = optimize_paper_distances(initial, reference, anchor, view)
    return Registration(registered, lifted.pixel_index, losses)


def initialize_distances(lifted: Gaussians, affine: DepthAffine, camera: Camera) -> Gaussians:
    """Move Gaussians along their rays to z-depth `s D + t` of the target (Eq. 9).

    The equation divides z-depth by `r · v`, the cosine between ray and principal axis, which is the
    same before and after the move. So the ratio of z-depths is the ratio of distances d_i. Our
    reading: the paper samples D at the projection u_i of a Gaussian, and we take the z-depth of its
    mean, which is that value for pixel-aligned Gaussians. Scales stay: the paper names no change.
    Nor does it bound distances: a negative t may push near Gaussians behind the camera, where the
    target does not see them (`register.apply_affine` stops them in front of it).
    """
    predicted = compute_z_depths(lifted.means, camera)
    aligned = affine.scale * predicted + affine.shift
    return slide(lifted, camera, aligned / predicted, "fixed")


def optimize_paper_distances(
    initial: Gaussians, reference: View, anchor: Anchor, view: TargetView
) -> tuple[Gaussians, tuple[float, ...]]:
    """Minimize Eq. 11 over the distances; also return its value at each iteration.

    Rotations, scales, opacities and colours are frozen, as all but positions. Our reading: the
    paper names no optimizer and no unit of its learning rate; we take Adam and scene units.
    """
    config = view.state.config.paper_registration
    target = reference.camera
    # D_ctx^tgt and D_ctx^anc are rendered from G_ctx once, since G_ctx is frozen. It contains what
    # earlier targets added.
    context_at_target = view.depth
    context_at_anchor = anchor.depth
    move = MOTIONS[config.degrees_of_freedom]

    # Adam changes δ_i, beginning with 0, in d_i = d_i^init + δ_i (scene units). Its steps depend on
    # gradients alone, so that they are those of optimizing d_i. For 3-DoF, δ_i is a vector.
    offsets = torch.zeros(
        (len(initial), config.degrees_of_freedom),
        device=initial.means.device,
        requires_grad=True,
    )
    optimizer = Adam([(offsets, config.learning_rate)], PAPER_ADAM_BETAS)
    losses = []
    for _ in track(range(config.iterations), "Registering"):
        moved = move(initial, offsets, target)

        # \hat{D}_tgt and \hat{I}_tgt are of the composite scene, G_ctx with G_tgt, and \hat{D}_anc
        # is of the target Gaussians G_tgt alone.
        composite, alone_at_anchor = composite_beside(
            view.frozen, moved, view.scenes.renderer, anchor.view.camera
        )

        l_depth = compute_depth_error(composite.depth_map(), context_at_target)
        l_stereo = compute_depth_error(alone_at_anchor.depth_map(), context_at_anchor)
        l_rgb = (composite.image - reference.image).abs().mean()
        loss = weigh_losses(l_depth, l_stereo, l_rgb, config)

        optimizer.step(loss)
        losses.append(loss.detach())
    with torch.no_grad():
        registered = move(initial, offsets, target)
    # Read together at the end: a GPU would have to finish each step before the next begins.
    return registered, tuple(torch.stack(losses).tolist())


def move_on_rays(initial: Gaussians, offsets: Float[Tensor, "n 1"], camera: Camera) -> Gaussians:
    """Place Gaussians at `c_tgt + d_i r_i`, with `d_i = d_i^init + offset` (Eq. 10)."""
    # As a multiple of the initial vector d_i^init r_i, which needs no normalized ray.
    distances = (initial.means - camera.center).norm(dim=1)
    return slide(initial, camera, 1 + offsets[:, 0] / distances, "fixed")


def move_freely(initial: Gaussians, offsets: Float[Tensor, "n 3"], camera: Camera) -> Gaussians:
    """Move Gaussians in all three directions: the ablation "3-DoF" of Table VII."""
    return replace(initial, means=initial.means + offsets, encoded=None)


MOTIONS = {1: move_on_rays, 3: move_freely}
"""Motion by degrees of freedom."""


def compute_depth_error(rendered: DepthMap, context: DepthMap) -> Float[Tensor, ""]:
    """Compute the L1 error of depth where both show a surface, averaged over the whole image.

    Our reading: the paper writes a norm ‖·‖_1 over the image, and neither a mean nor a mask. A
    render shows a surface where its alpha is at least 0.5.
    """
    error = (rendered.depth - context.depth).abs()
    return torch.where(rendered.valid & context.valid, error, 0.0).mean()


def weigh_losses(
    l_depth: Float[Tensor, ""],
    l_stereo: Float[Tensor, ""],
    l_rgb: Float[Tensor, ""],
    config: PaperRegistrationConfig,
) -> Float[Tensor, ""]:
    """Compute `λ_d L_depth + λ_s L_stereo + λ_c L_rgb` (Eq. 11)."""
    return (
        config.rgb_weight * l_rgb + config.depth_weight * l_depth + config.stereo_weight * l_stereo
    )

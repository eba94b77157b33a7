"""Stage 4 where the scene is covered, but not trusted: recolour by direction (not in the paper).

In a trained splat the wrong parts of an image are opaque Gaussians seen from a new side. Colour is
all that depends on the side, so their spherical harmonics are fitted to the synthesized image in
the direction of the target, and held in the directions of photographs and of earlier targets.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.config import RecolorConfig
from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.parts import PartOrigin
from gscompleter.render.protocols import ColorErrors, FrozenScene, Renderer
from gscompleter.render.spherical_harmonics import evaluate_sh_basis
from gscompleter.stages.synthesize import GeneratedView
from gscompleter.stages.target_view import TargetView
from gscompleter.state import Completion
from gscompleter.system.threads import use_one_torch_thread
from gscompleter.system.timing import timed_stage
from gscompleter.trust import HeldViews
from gscompleter.types import Camera, Gaussians, View, merge

UNSEEN_WEIGHT = 1e-3
"""Summed weight, in pixels, up to which a Gaussian is not seen."""
CHUNK = 4096
"""Gaussians that are solved for at a time, which bounds the memory."""


@dataclass(frozen=True)
class Recolored:
    """The scene after recolouring."""

    state: Completion
    view: TargetView
    """The scene before, at the padded target."""
    rows: Int64[Tensor, "c"]
    """Rows of the rendered Gaussians with new colours."""

    @cached_property
    def frozen(self) -> FrozenScene:
        """The scene frozen at the padded target."""
        if len(self.rows) == 0:
            return self.view.frozen
        return self.view.frozen.repaint(self.rows, self.state.rendered_context[self.rows])


@timed_stage("integrate")
def recolor(reference: GeneratedView, view: TargetView, origin: PartOrigin) -> Recolored:
    """Recolour what covers the target without being trusted, and trust it from there on.

    A true photograph may recolour all that it shows, since other photographs hold what they show;
    an image that is inconsistent with them recolours nothing. Recoloured Gaussians get the label
    of the `origin` of their colours.
    """
    state = view.state
    camera = view.camera.padded
    context = state.rendered_context
    unchanged = Recolored(state, view, torch.empty(0, dtype=torch.int64))
    # Under full trust no pixel is distrusted; a GPU need not be asked.
    if view.alpha is view.render.alpha and not reference.is_photograph:
        return unchanged
    weight = torch.ones_like(view.alpha) if reference.is_photograph else view.distrust
    if reference.is_inconsistent or not weight.any():
        return unchanged
    rows, delta = fit_image_colors(
        merge(state.parts),
        context.sh.shape[1],
        view.frozen,
        reference,
        weight,
        state.trust.held,
        view.scenes.renderer,
        state.config.recolor,
    )
    if len(rows) == 0:
        return unchanged

    recolored = replace(
        context,
        sh=context.sh.index_add(0, rows, delta),
        generated=context.generated.index_fill(0, rows, origin.label),
    )
    # Trusted at later targets: otherwise targets in a row compound their errors (decision 038).
    trust = state.trust.accept(view.frozen, camera, rows)
    return Recolored(replace(state, rendered_context=recolored, trust=trust), view, rows)


def fit_image_colors(
    scene: Gaussians,
    num_sh: int,
    frozen: FrozenScene,
    reference: View,
    weight: Float[Tensor, "h w"],
    held: HeldViews,
    renderer: Renderer,
    config: RecolorConfig = RecolorConfig(),
) -> tuple[Int64[Tensor, "c"], Float[Tensor, "c k 3"]]:
    """Fit colours towards `reference`; return rows of `scene` and the change of their harmonics.

    `frozen` is `scene` at the camera of `reference`. Only the m Gaussians of the context, which are
    the first of `scene`, may change, as far as the `held` views allow; they have k = `num_sh`
    coefficients per channel, where additions may have more. Where `weight`, in [0, 1], is low, the
    render of `scene` is wanted instead. Equations: "Recolouring" in docs/method.md.
    """
    # Gaussians are open to change if they show in a pixel that wants another colour. Three
    # channels are backprojected at once: all pixels, wanting pixels, and nothing.
    layers = torch.stack([torch.ones_like(weight), weight, torch.zeros_like(weight)], dim=-1)
    sums, open_sums, _ = frozen.backproject(layers).unbind(-1)
    is_open = open_sums > UNSEEN_WEIGHT
    num_context = held.sums.shape[1]
    is_open[num_context:] = False
    rows = torch.nonzero(is_open)[:, 0]
    sh = scene.sh[rows, :num_sh]
    if len(rows) == 0 or config.iterations == 0:
        return rows[:0], sh[:0]

    # A Gaussian has k coefficients per channel, of which the target sees one combination, bᵀ sh. Of
    # all changes of that colour, A⁻¹ b is the one that costs the held views least. So one number s
    # per channel is left, and the colour changes by γ s.
    means = scene.means[rows]
    basis, change = solve_directions(
        means, num_sh, rows, sums[rows], reference.camera, held, config.ridge
    )
    colors = 0.5 + torch.einsum("nk,nkc->nc", basis, sh.double())
    gains = (basis * change).sum(dim=1, keepdim=True)  # γ = bᵀ A⁻¹ b

    wanted = torch.lerp(frozen.render.image, reference.image, weight[..., None])
    errors = renderer.freeze(scene.hide(is_open), reference.camera).vary_colors(scene[rows])
    steps = fit_steps(errors, wanted, colors, gains, config.iterations)

    # Changes that nobody sees would only mark Gaussians as generated. Leaving them out changes a
    # fifth as many, for the same gain (decision 038).
    is_changed = (gains * steps).abs().amax(dim=1) > config.min_change
    delta = change[is_changed, :, None] * steps[is_changed, None]
    return rows[is_changed], delta.to(sh)


def solve_directions(
    means: Float[Tensor, "c 3"],
    k: int,
    rows: Int64[Tensor, "c"],
    sums: Float[Tensor, "c"],
    camera: Camera,
    held: HeldViews,
    ridge: float,
) -> tuple[Float64[Tensor, "c k"], Float64[Tensor, "c k"]]:
    """Return the basis b at `camera` and the cheapest change of k harmonics, A⁻¹ b, of some rows.

    A = Σ_v weight_v sum_v b_v b_vᵀ + ridge (sum + Σ_v sum_v) I over the held views v, where sums
    are the compositing weights of a Gaussian in an image; `sums` [c] are those at `camera`.
    """
    centers = torch.cat([held.centers, camera.center.to(held.centers)[None]])

    def solve(
        places: Float[Tensor, "_ 3"], chunk: Int64[Tensor, "_"], own: Float[Tensor, "_"]
    ) -> Float64[Tensor, "2 _ k"]:
        # In float64, since views beside each other have nearly equal b, and A is close to singular.
        rays = normalize(places[:, None].double() - centers.double(), dim=-1)
        basis = evaluate_sh_basis(rays.flatten(0, 1), k).unflatten(0, rays.shape[:2])
        held_basis = basis[:, :-1]
        target_basis = basis[:, -1]
        held_sums = held.sums[:, chunk].double().T
        cost = held_basis.mT @ (held_basis * (held_sums * held.weights)[..., None])
        # The ridge grows with all weights, so that the result does not depend on image sizes.
        cost.diagonal(dim1=1, dim2=2).add_(ridge * (own + held_sums.sum(dim=1))[:, None])
        change = torch.cholesky_solve(target_basis[..., None], torch.linalg.cholesky(cost))
        return torch.stack([target_basis, change[..., 0]])

    with use_one_torch_thread():
        parts = (means.split(CHUNK), rows.split(CHUNK), sums.split(CHUNK))
        chunks = map_in_parallel(solve, *parts)
    basis, change = torch.cat(chunks, dim=1)
    return basis, change


def fit_steps(
    errors: ColorErrors,
    wanted: Float[Tensor, "h w 3"],
    colors: Float64[Tensor, "c 3"],
    gains: Float64[Tensor, "c 1"],
    iterations: int,
) -> Float64[Tensor, "c 3"]:
    """Minimize Σ (wanted - image)² + gains s² over s; Gaussians have the colours + gains s.

    Each iteration minimizes an upper bound in which every s stands alone.
    """
    steps = torch.zeros_like(colors)
    for _ in range(iterations):
        # The residual at the current colours, and the weights, summed over the pixels of each
        # Gaussian.
        residual, sums = errors((colors + gains * steps).to(wanted), wanted)
        # The weights w_i of a pixel sum to at most 1. So (Σ_i w_i x_i)² <= Σ_i w_i x_i², which
        # replaces the square of the sum of all changes by a sum of squares: the minimum over each s
        # is a division.
        stiffness = sums[:, None] * gains
        steps = (residual + stiffness * steps) / (1 + stiffness)
    return steps

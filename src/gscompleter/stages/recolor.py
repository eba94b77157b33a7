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
from gscompleter.render.cache import Parts, SceneRenderer
from gscompleter.render.protocols import ColorErrors, FrozenScene
from gscompleter.render.spherical_harmonics import evaluate_sh_basis
from gscompleter.stages.synthesize import GeneratedView
from gscompleter.stages.target_view import TargetView
from gscompleter.state import Completion
from gscompleter.system.files.mapping import change_rows, release_pages, select_rows
from gscompleter.system.threads import use_one_torch_thread
from gscompleter.system.timing import timed_stage
from gscompleter.trust import HeldViews
from gscompleter.types import Camera, Gaussians, View

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
        state.parts,
        view.frozen,
        reference,
        weight,
        state.trust.held,
        view.scenes,
        state.config.recolor,
    )
    if len(rows) == 0:
        return unchanged

    # Trusted at later targets: otherwise targets in a row compound their errors (decision 038).
    trust = state.trust.accept(view.frozen, camera, rows)
    recolored = replace(
        context,
        sh=change_rows(context.sh, rows, delta.add_(select_rows(context.sh, rows))),
        generated=context.generated.index_fill(0, rows, origin.label),
    )
    return Recolored(replace(state, rendered_context=recolored, trust=trust), view, rows)


def fit_image_colors(
    parts: Parts,
    frozen: FrozenScene,
    reference: View,
    weight: Float[Tensor, "h w"],
    held: HeldViews,
    scenes: SceneRenderer,
    config: RecolorConfig = RecolorConfig(),
) -> tuple[Int64[Tensor, "c"], Float[Tensor, "c k 3"]]:
    """Fit colours towards `reference`; return rows of the context and how their harmonics change.

    `parts` are the context, whose Gaussians alone may change, as far as the `held` views allow, and
    what was added to it; `frozen` are these at the camera of `reference`. The context has k
    coefficients per channel, where additions may have more. Where `weight`, in [0, 1], is low, the
    render of `parts` is wanted instead. Equations: "Recolouring" in docs/method.md.
    """
    # Gaussians are open to change if they show in a pixel that wants another colour. Three
    # channels are backprojected at once: all pixels, wanting pixels, and nothing.
    context, *added = parts
    layers = torch.stack([torch.ones_like(weight), weight, torch.zeros_like(weight)], dim=-1)
    sums, open_sums, _ = frozen.backproject(layers)[: held.sums.shape[1]].unbind(-1)
    is_open = open_sums > UNSEEN_WEIGHT
    rows = torch.nonzero(is_open)[:, 0]
    if len(rows) == 0 or config.iterations == 0:
        return rows[:0], context.sh[:0]

    # A Gaussian has k coefficients per channel, of which the target sees one combination, bᵀ sh. Of
    # all changes of that colour, A⁻¹ b is the one that costs the held views least. So one number s
    # per channel is left, and the colour changes by γ s.
    change, colors, gains = solve_directions(
        context, rows, sums[rows], reference.camera, held, config.ridge
    )

    # Colours are given in each step, so that harmonics, most of the memory, are not copied.
    opened = context.drop_colors()[rows]
    wanted = torch.lerp(frozen.render.image, reference.image, weight[..., None])
    others = scenes.freeze((context.hide(is_open), *added), reference.camera)
    errors = others.vary_colors(opened)
    steps = fit_steps(errors, wanted, colors, gains, config.iterations)

    # Changes that nobody sees would only mark Gaussians as generated. Leaving them out changes a
    # fifth as many, for the same gain (decision 038).
    is_changed = (gains * steps).abs().amax(dim=1) > config.min_change
    change = change[is_changed]
    steps = steps[is_changed]
    delta = context.means.new_empty((*change.shape, 3))
    # In blocks, as a product of all in float64 takes twice what harmonics do.
    for start in range(0, len(delta), CHUNK):
        block = slice(start, start + CHUNK)
        delta[block] = change[block, :, None] * steps[block, None]
    return rows[is_changed], delta


def solve_directions(
    context: Gaussians,
    rows: Int64[Tensor, "c"],
    sums: Float[Tensor, "c"],
    camera: Camera,
    held: HeldViews,
    ridge: float,
) -> tuple[Float64[Tensor, "c k"], Float64[Tensor, "c 3"], Float64[Tensor, "c 1"]]:
    """Return the cheapest change of the k harmonics, A⁻¹ b, of the context at c ascending `rows`.

    Also returns their colours bᵀ sh at `camera`, and the gains γ = bᵀ A⁻¹ b, for the basis b there.
    A = Σ_v weight_v sum_v b_v b_vᵀ + ridge (sum + Σ_v sum_v) I over the held views v, where sums
    are the compositing weights of a Gaussian in an image; `sums` [c] are those at `camera`.
    """
    centers = torch.cat([held.centers, camera.center.to(held.centers)[None]])
    k = context.sh.shape[1]
    # Chunks are written where they belong: joined at the end they would take the memory twice.
    change = context.means.new_empty((len(rows), k), dtype=torch.float64)
    colors = change.new_empty((len(rows), 3))
    gains = change.new_empty((len(rows), 1))

    def solve(start: int) -> None:
        # In float64, since views beside each other have nearly equal b, and A is close to singular.
        chunk = slice(start, start + CHUNK)
        opened = rows[chunk]
        means = context.means[opened]
        rays = normalize(means[:, None].double() - centers.double(), dim=-1)
        basis = evaluate_sh_basis(rays.flatten(0, 1), k).unflatten(0, rays.shape[:2])
        held_basis = basis[:, :-1]
        target_basis = basis[:, -1]
        held_sums = held.sums[:, opened].double().T
        cost = held_basis.mT @ (held_basis * (held_sums * held.weights)[..., None])
        # The ridge grows with all weights, so that the result does not depend on image sizes.
        own = sums[chunk] + held_sums.sum(dim=1)
        cost.diagonal(dim1=1, dim2=2).add_(ridge * own[:, None])
        solved = torch.cholesky_solve(target_basis[..., None], torch.linalg.cholesky(cost))[..., 0]
        change[chunk] = solved
        colors[chunk] = 0.5 + torch.einsum(
            "nk,nkc->nc", target_basis, select_rows(context.sh, opened).double()
        )
        gains[chunk] = (target_basis * solved).sum(dim=1, keepdim=True)

    # One chunk after the other on a GPU, which gains nothing by several, and holds one.
    map_chunks = map if rows.is_cuda else map_in_parallel
    with use_one_torch_thread():
        for _ in map_chunks(solve, range(0, len(rows), CHUNK)):
            pass
    release_pages(held.sums)
    return change, colors, gains


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

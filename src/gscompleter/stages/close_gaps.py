"""After a target: close the thin gaps that cameras beside it would see (not in the paper).

Two surfaces that adjoin at the target lie at different depths. A camera beside it sees the dark
between them, and so it does where a surface of the context is half transparent at its edge. No
network is needed for that: a gap is a few pixels wide, and the farther of both surfaces goes on
behind the nearer one. Nor is Ψ: the depth is that of this surface (decision 057).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from gscompleter.config import GapConfig
from gscompleter.numerics.geometry import adapt_to_mode, measure_baseline, pad_camera
from gscompleter.numerics.image_ops import dilate
from gscompleter.numerics.smooth import continue_smoothly
from gscompleter.reconstructors.plane_sweep.gaussians import DISC_SIGMA, compute_normals, make_discs
from gscompleter.render.cache import SceneRenderer
from gscompleter.stages.select_anchor import find_nearest_view
from gscompleter.stages.synthesize import GeneratedView
from gscompleter.stages.target_view import TargetView, render_target
from gscompleter.state import Completion
from gscompleter.system.timing import timed_stage
from gscompleter.types import Camera, Gaussians, View

GAP_RIM = 1
"""Pixels around a gap that are covered as well, and whose mixed colours and depths do not count."""
GAP_REACH = 16
"""Radius in pixels around a known pixel within which the farthest surface is looked for."""
DEPTH_SHARPNESS = 16
"""Power of the depth of a pixel, relative to the largest one there, by which it weighs in a gap."""
SIDE_MOVES = (0.75, 1.25)
"""Moves to a side, relative to the one away from the photograph. A crack that is wide from afar is
thin from nearby, and what is closed from there opens again further on."""
MIN_MOVED = 0.01
"""Distance of a photograph from a target, relative to the mean one of all, below which it was taken
at the target, as those are at which something was removed."""
MIN_SHARE = 1e-4
"""Share of an image from which on its gaps are closed, seven pixels of 256 x 256: fewer are hardly
seen, and guards would take as long for them as for many."""


def displace_camera(
    target: Camera, views: Sequence[View], displacement: float
) -> tuple[Camera, ...]:
    """Return five cameras beside a target, none of which is turned.

    The first is moved by `displacement`, relative to the baseline of the target and its nearest
    photograph, away from that photograph, where the gaps of parallax between the known and the
    completed part open widest. The others stand to the right and to the left, near ones first: a
    gap that one side opens is hidden from the other. Photographs at the target itself do not count,
    and if there are no others, nothing tells how far a camera may move: there is none then.
    """
    distances = [measure_baseline(target, view.camera) for view in views]
    least = MIN_MOVED * sum(distances) / len(distances)
    beside = [view for view, distance in zip(views, distances, strict=True) if distance > least]
    if not beside:
        return ()
    nearest = beside[find_nearest_view(target, beside)].camera
    baseline = target.center - nearest.center
    right = baseline.norm() * target.c2w[:3, 0]
    moves = [baseline, *(side * move for move in SIDE_MOVES for side in (right, -right))]
    cameras = []
    for move in moves:
        c2w = target.c2w.clone()
        c2w[:3, 3] = target.center + displacement * move
        cameras.append(replace(target, c2w=c2w))
    return tuple(cameras)


@timed_stage("integrate")
def view_gaps(
    state: Completion, camera: Camera, scenes: SceneRenderer, config: GapConfig
) -> TargetView:
    """Render the scene of a completed target at a camera beside it.

    Holes begin at a higher alpha there than at a target, since gaps at the edges of surfaces are
    half transparent.
    """
    holes = replace(state.config.holes, max_alpha=config.max_alpha, dilation=GAP_RIM)
    strict = replace(state, config=replace(state.config, holes=holes))
    return render_target(strict, pad_camera(camera, 0.0), scenes)


def are_worth_closing(gaps: Bool[Tensor, "h w"]) -> bool:
    """Return True if gaps cover at least MIN_SHARE of the image."""
    return gaps.float().mean().item() >= MIN_SHARE


@timed_stage("integrate")
def continue_surfaces(
    view: TargetView, gaps: Bool[Tensor, "h w"]
) -> tuple[GeneratedView, Gaussians]:
    """Continue the farther surfaces beside gaps into them.

    Return the image with closed gaps, and a Gaussian for each pixel of a gap and of its rim. No
    Gaussian is returned if no pixel of the image is known.
    """
    camera = view.camera.padded
    layers, known = collect_layers(view)

    # Of two surfaces that adjoin a gap the farther one goes on in it. Nearer pixels weigh less by a
    # power of their depth. A limit of depth would not do: most steps between two surfaces are small
    # and a slanted surface has as large ones of its own.
    depths = layers[..., 3].exp().where(known, 0.0)
    side = 2 * GAP_REACH + 1
    farthest = max_pool2d(depths[None, None], side, stride=1, padding=GAP_REACH)[0, 0]
    weight = (depths / farthest.where(known, 1.0)) ** DEPTH_SHARPNESS
    filled = continue_smoothly(layers.cpu(), weight.cpu()).to(layers)

    # Known pixels keep their colours, from which those of the additions are blended.
    image = layers[..., :3].where(known[..., None], filled[..., :3]).clamp(0, 1)
    reference = GeneratedView(image, camera)
    depth = filled[..., 3].exp()
    discs = make_discs(reference, depth, compute_normals(depth, reference), DISC_SIGMA)

    chosen = dilate(gaps, GAP_RIM).flatten() & known.any()
    added = adapt_to_mode(view.state.rendered_context, discs[chosen], camera)
    return reference, added


def collect_layers(view: TargetView) -> tuple[Float[Tensor, "h w 4"], Bool[Tensor, "h w"]]:
    """Collect the colour and the logarithm of the depth of each pixel, and tell which are known.

    Pixels beside a hole show a part of what lies behind it, and are not known. The values of those
    that are not known mean nothing.
    """
    render = view.render
    max_alpha = view.state.config.holes.max_alpha
    known = (render.alpha >= max_alpha) & ~dilate(view.empty, GAP_RIM)
    # The render is over black: its colours are divided by alpha.
    colors = render.image / render.alpha.clamp_min(max_alpha)[..., None]
    depth = render.depth.where(known, 1.0)
    return torch.cat([colors, depth.log()[..., None]], dim=-1), known

"""Tone and lines go on beyond what is known, and what an object hid is the background."""

import pytest
import torch

from gscompleter.evaluation.metrics.image import psnr
from gscompleter.generators.lines import continue_lines
from gscompleter.generators.warp import WarpedImage, continue_image, fill_background_first
from gscompleter.numerics.smooth import average_trusted, fit_membrane
from gscompleter.types import GeneratorInput, Render, View
from scenes import camera_at

W = 96
RED, GREEN, BLUE = torch.eye(3)
TARGET = camera_at(0.0, size=W)


def continued(image, known, depth, shown_depth=None):
    """Continue an image; a photograph from the target's place shows `shown_depth` if given."""
    shown = Render(torch.zeros(W, W, 3), torch.full((W, W), shown_depth or 1.0), torch.ones(W, W))
    views = (View(torch.zeros(W, W, 3), TARGET),) if shown_depth else ()
    context = GeneratorInput(views, (shown,) * len(views), shown)
    warped = WarpedImage(image, known, depth, torch.ones(0, 3))
    return continue_image(fill_background_first(warped), TARGET, context)


def test_a_line_goes_on_through_a_hole():
    """A dark diagonal bar crosses a bright image whose middle is unknown."""
    y, x = torch.meshgrid(torch.arange(W), torch.arange(W), indexing="ij")
    bar = (x - y).abs() <= 3
    image = torch.where(bar, 0.1, 0.8)[..., None].expand(W, W, 3).contiguous()
    known = torch.ones(W, W, dtype=torch.bool)
    known[40:56, 40:56] = False
    tone, lines, weight = continued(image, known, torch.ones(W, W))
    hole = ~known
    filled = torch.lerp(tone, lines, weight)
    assert psnr(filled[hole][None], image[hole][None]) > 20
    assert (lines - image)[bar & hole & (weight[..., 0] > 0.5)].abs().max() < 0.2
    assert (weight[bar & hole] > 0.2).all()
    assert torch.equal(filled[known], image[known])


def test_no_line_is_believed_without_direction():
    noise = torch.rand(W, W, 3, generator=torch.Generator().manual_seed(0))
    known = torch.ones(W, W, dtype=torch.bool)
    known[:, 64:] = False
    weight = continue_lines(noise, known)[1]
    assert (weight[known] == 0).all()
    assert weight[:, 72:].mean() < 0.2


def test_the_sky_does_not_flow_over_the_grass_beyond_the_frame():
    """Left half known: blue sky at depth 100 above green grass at depth 5; nothing hides."""
    top = (torch.arange(W) < W // 2)[:, None].expand(W, W)
    image = torch.where(top[..., None], BLUE, GREEN).contiguous()
    depth = torch.where(top, 100.0, 5.0).contiguous()
    known = (torch.arange(W) < W // 2).expand(W, W).contiguous()
    tone, lines, weight = continued(image, known, depth)
    for filled in (tone, torch.lerp(tone, lines, weight)):
        assert (filled[W // 2 + 12 :, :, 1] - filled[W // 2 + 12 :, :, 2]).min() > 0.1
        assert (filled[: W // 2 - 12, :, 2] - filled[: W // 2 - 12, :, 1]).min() > 0.1
    far = fill_background_first(WarpedImage(image, known, depth, torch.ones(0, 3))).image
    assert far[-8:, -8:, 2].max() > 0.5


def test_what_an_object_hid_is_the_background():
    """A red object at depth 1, a gap, a blue wall at depth 4; a photograph shows the object."""
    image = torch.zeros(W, W, 3)
    image[:, :40] = RED
    image[:, 56:] = BLUE
    known = torch.ones(W, W, dtype=torch.bool)
    known[:, 40:56] = False
    depth = torch.where(torch.arange(W) < 48, 1.0, 4.0).expand(W, W).contiguous()
    tone, lines, weight = continued(image, known, depth, shown_depth=1.0)
    middle = torch.lerp(tone, lines, weight)[:, 48:56]
    assert middle[..., 0].max() < 0.2
    assert middle[..., 2].min() > 0.8
    unhidden = continued(image, known, depth)[0]
    assert unhidden[W // 2, 48, 0] > 0.3


@pytest.mark.parametrize(("h", "w"), [(64, 96), (61, 77), (3, 5), (1, 40), (200, 300)])
def test_a_constant_image_stays_constant(h, w):
    known = torch.rand(h, w, generator=torch.Generator().manual_seed(0)) < 0.3
    known[0, 0], known[-1, -1] = True, False
    image = torch.full((h, w, 3), 0.3)
    lines, weight = continue_lines(image, known)
    for filled in (fit_membrane(image, known.float()), torch.lerp(image, lines, weight[..., None])):
        assert (filled - 0.3).abs().max() < 1e-5


def test_a_membrane_runs_straight_between_two_borders_and_follows_the_weights():
    values = torch.linspace(0, 1, W)[None, :, None].expand(W, W, 1).contiguous()
    known = (torch.arange(W) - W / 2).abs().expand(W, W) > 24
    ramp = fit_membrane(values * known[..., None], known.float())
    assert (ramp - values)[:, 8:-8].abs().max() < 0.03
    middle = torch.zeros(W, W)
    middle[:, W // 2 - 4 : W // 2 + 4] = 1
    for weight, nearest in ((1e-4, 0.5), (1.0, 1.0)):
        pulled = fit_membrane(
            torch.where(middle[..., None] > 0, 1.0, values), known + weight * middle
        )
        assert abs(pulled[W // 2, W // 2, 0].item() - nearest) < 0.2


@pytest.mark.parametrize("trust", [0.0, 1.0])
def test_trusted_colours_reach_over_all_of_the_image(trust):
    """A strip at the border has a colour; at the other side it has a tiny weight."""
    alpha = (torch.arange(W) < 4).float().expand(W, W)
    render = Render(0.8 * alpha[..., None].expand(W, W, 3), torch.ones(W, W), alpha)
    mean = average_trusted(render, torch.full((W, W), trust))
    assert (mean - 0.8).abs().max() < 1e-4

"""What is kept of a splat, seen from cameras that decided nothing."""

from dataclasses import replace

import pytest
import torch

from gscompleter import GSCompleter
from gscompleter.apps.report.plain_words import describe_kept
from gscompleter.config import CompleterConfig
from gscompleter.evaluation.verdict.kept import measure_kept
from gscompleter.parts import PartOrigin, make_part
from gscompleter.render.loading import load_renderer
from gscompleter.state import Completion
from gscompleter.virtual_capture.render_views import render_views
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 48
RENDERER = load_renderer("cpu")


@pytest.fixture(scope="module")
def begun() -> Completion:
    scene = gaussians_of(view_of(Room(), camera_at(size=SIZE)))
    views = render_views(scene, [camera_at(size=SIZE)], RENDERER)
    return GSCompleter(config=CompleterConfig.bare()).begin(views, scene)


def test_nothing_added_keeps_all_and_a_veil_is_named(begun):
    camera = camera_at(0.1, size=SIZE)
    kept = measure_kept(begun, [camera], RENDERER)
    assert (kept.cameras, kept.worst_psnr) == (1, 100.0)
    assert "stays as it was" in describe_kept(kept)

    # White dots half-way before what the camera sees.
    veil = begun.context[::40]
    veil = replace(veil, means=0.5 * veil.means, sh=torch.full_like(veil.sh, 1.7))
    covered = replace(begun, added_parts=(make_part(PartOrigin("target", 1), veil),))
    kept = measure_kept(covered, [camera, camera_at(0.1, yaw=180, size=SIZE)], RENDERER)
    # Nothing of the splat is behind the camera, so that one camera counts.
    assert kept.cameras == 1
    assert kept.worst_psnr < 30
    assert "additions hide a part of what the splat showed" in describe_kept(kept)


def test_without_a_camera_that_sees_it_nothing_is_claimed(begun):
    assert measure_kept(begun, [camera_at(yaw=180, size=SIZE)], RENDERER) is None
    assert "may get worse" in describe_kept(None)

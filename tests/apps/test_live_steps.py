"""Fill the holes that a step of a session is about, also after removals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter import GSCompleter
from gscompleter.apps.live.session import Action, Session, SessionStep, apply_step, save_camera
from gscompleter.apps.live.steps import fill_region, find_holes
from gscompleter.config import CompleterConfig
from gscompleter.numerics.geometry import project
from gscompleter.parts import Part, PartOrigin
from gscompleter.state import Completion
from gscompleter.system.progress import notify_of_stages
from gscompleter.trust import Trust
from gscompleter.trust.photometric import PhotometricTrust
from gscompleter.types import Camera, merge
from live_marks import make_mark
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 48
CAMERAS = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in ((-0.3, 0), (0.1, 0), (0.4, 4))]
RIGHT = camera_at(0.7, 0.1, 0.05, yaw=14, size=SIZE)
LEFT = camera_at(-0.7, yaw=-16, size=SIZE)
"""Cameras at holes of the room, which are at the right and the left border of their images."""
mark = partial(make_mark, SIZE)
SPOT = mark(slice(18, 30), slice(8, 20))
"""Marks at `RIGHT`, whose place `LEFT` sees in columns from 40 on; its own hole ends at 22."""
BORDER = mark(slice(0, SIZE), slice(0, 3))
UPPER, LOWER = (mark(slice(row, row + 8), slice(38, 46)) for row in (6, 32))
"""Marks at `RIGHT` in its hole."""


def do(
    session: Session, action: Action, camera: Camera, mask: bytes | None = None
) -> tuple[Session, str]:
    """Do a step, and return the session with what is said."""
    return apply_step(session, SessionStep(action, save_camera(session, camera), mask))


@pytest.fixture(scope="module")
def begun() -> Session:
    """Begin with a splat and its photographs."""
    views = [view_of(Room(), camera) for camera in CAMERAS]
    completer = GSCompleter(config=CompleterConfig.splat().for_photographs())
    scene = merge([gaussians_of(view) for view in views])
    first = completer.begin(views[:2], scene, views[2:])
    return Session(completer, (first,), np.eye(4), np.zeros(3))


@pytest.fixture(scope="module")
def removed(begun) -> Session:
    return do(begun, "remove", RIGHT, SPOT)[0]


@pytest.fixture(scope="module")
def completed(begun) -> Session:
    return do(begun, "complete", RIGHT)[0]


def list_new_pixels(before: Session, after: Session) -> Float[Tensor, "n 2"]:
    """List where the steps since `before` added something, in pixels x, y of their camera."""
    results = after.latest.targets[len(before.latest.targets) :]
    assert sum(len(result.added) for result in results) > 0
    return torch.cat([project(result.added.means, result.target)[0] for result in results])


def test_after_a_removal_marks_fill_another_hole(removed):
    filled, text = do(removed, "fill", LEFT, BORDER)
    assert "are added in a hole" in text
    columns = list_new_pixels(removed, filled)[:, 0]
    assert len(columns) > 300
    assert columns.max() < 28
    # Its place is filled only where marks touch it, by its own settings.
    place, _ = do(removed, "fill", LEFT, mark(slice(20, 24), slice(42, 46)))
    assert list_new_pixels(removed, place)[:, 0].min() > 36
    assert place.latest.config == removed.latest.config


def test_marks_on_both_kinds_of_hole_fill_both(removed):
    both, _ = do(removed, "fill", LEFT, mark(slice(20, 24), slice(0, SIZE)))
    columns = list_new_pixels(removed, both)[:, 0]
    assert (columns < 20).sum() > 300
    assert (columns > 40).sum() > 30


def test_all_holes_are_completed_that_a_camera_sees_after_a_removal(removed):
    both, text = do(removed, "complete", LEFT)
    assert text.count("are added in a hole") == 2
    columns = list_new_pixels(removed, both)[:, 0]
    assert (columns < 20).sum() > 300
    assert (columns > 40).sum() > 30
    # Each target has a camera in the file of the targets.
    assert len(both.latest.targets) == len(both.cameras) == 2
    assert {int(result.target_id) for result in both.latest.targets} == {1, 2}
    assert both.latest.config == removed.latest.config
    # Nothing is left there.
    again, text = do(both, "complete", LEFT)
    pixels = [result.hole_mask for result in again.latest.targets[2:]]
    assert sum(int(mask.sum()) for mask in pixels) < 0.1 * SIZE**2


def test_elsewhere_the_trust_in_a_splat_outlives_a_removal(begun, removed):
    assert type(removed.latest.trust) is Trust
    before, after = begun.latest.trust, removed.latest.trust_elsewhere
    assert isinstance(before, PhotometricTrust)
    assert isinstance(after, PhotometricTrust)
    left = ~removed.latest.source.gone_mask
    assert torch.equal(after.observations.agreement, before.observations.agreement[:, left])
    # So what no photograph confirms is recoloured there.
    both, _ = do(removed, "complete", LEFT)
    assert both.latest.targets[0].num_recolored == 0
    assert both.latest.targets[1].num_recolored > 0
    trust = both.latest.trust_elsewhere
    assert isinstance(trust, PhotometricTrust)
    assert trust.is_recolored.any()
    assert type(both.latest.trust) is Trust


def test_removing_additions_alone_leaves_all_settings(completed):
    left, _ = do(completed, "remove", RIGHT, UPPER)
    assert not left.latest.source.gone_mask.any()
    assert len(left.latest.added) < len(completed.latest.added)
    for name in ("config", "trust", "photos"):
        assert getattr(left.latest, name) is getattr(completed.latest, name)


def test_additions_that_are_repaired_are_replaced_in_the_marks_alone(completed):
    upper, _ = do(completed, "remove", RIGHT, UPPER)
    lower, text = do(upper, "repair", RIGHT, LOWER)
    assert "are added in a hole" in text
    rows = list_new_pixels(upper, lower)[:, 1]
    assert rows.min() > 26


def test_a_repair_fills_no_place_of_an_earlier_removal(begun):
    first, _ = do(begun, "remove", CAMERAS[1], mark(slice(18, 28), slice(2, 12)))
    repaired, _ = do(first, "repair", CAMERAS[1], mark(slice(18, 30), slice(24, 36)))
    columns = list_new_pixels(first, repaired)[:, 0]
    assert len(columns) > 30
    assert columns.min() > 16


def test_an_addition_before_a_surface_is_repaired_by_what_it_hid(begun):
    camera = begun.latest.views[1].camera
    blob = gaussians_of(view_of(Room(), CAMERAS[1]))
    xy, _ = project(blob.means, camera)
    blob = blob[((xy - 24).abs() < 5).all(dim=1)]
    near = 0.5 * (blob.means + camera.center)
    blob = replace(blob, means=near, scales=0.5 * blob.scales, opacities=blob.opacities + 9)
    parts = (Part(PartOrigin("target", 1), blob),)
    session = replace(begun, completions=(replace(begun.latest, added_parts=parts),))
    repaired, text = do(session, "repair", CAMERAS[1], mark(slice(21, 28), slice(21, 28)))
    assert text.endswith("Gaussians are removed. That leaves no hole: what stands behind is shown.")
    assert len(repaired.latest.added) < 0.7 * len(blob)
    assert not repaired.latest.source.gone_mask.any()
    assert repaired.latest.targets == ()


@dataclass(frozen=True)
class FillingNothing(GSCompleter):
    """A completer of whose Gaussians no guard accepts any."""

    def advance(self, state: Completion, target: Camera, reference=None) -> Completion:
        (result,) = super().advance(state, target, reference).targets
        return replace(state, targets=(replace(result, added=result.added[:0]),))


def test_a_region_that_stays_empty_is_reported_as_that_region(begun):
    completer = FillingNothing(config=begun.completer.config)
    region = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    region[: SIZE // 4] = True
    holes, _ = find_holes(completer, begun.latest, RIGHT)
    assert (holes & region).any()
    assert (holes & ~region).any()
    completed = fill_region(completer, begun.latest, RIGHT, region)
    assert torch.equal(completed.targets[-1].hole_mask, holes & region)


def test_marks_beside_every_hole_are_told_before_anything_is_generated(begun, removed):
    for session in (begun, removed):
        heard: list[str] = []
        with notify_of_stages(heard.append):
            same, text = do(session, "fill", LEFT, mark(slice(2, 6), slice(28, 34)))
        assert same is session
        assert text == "The marks touch no hole."
        assert "generate" not in heard

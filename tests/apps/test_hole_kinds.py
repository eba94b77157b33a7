"""Holes of a splat alone, and what a user marked: in any unit, and in the words of the user."""

from dataclasses import replace

import pytest
import torch

from gscompleter.apps.inputs.hole_kinds import mark_selected, read_marks
from gscompleter.data.mask_reading import MaskReading
from gscompleter.render.loading import load_renderer
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import write_image
from gscompleter.types import Camera
from scenes import Room, camera_at, gaussians_of, scaled, view_of

SIZE = 32


def make_camera(unit: float = 1.0) -> Camera:
    """Return a camera without a depth range, in a scene of this unit of length."""
    return replace(camera_at(0.1, size=SIZE, unit=unit), near=None, far=None)


def test_a_selection_is_marked_in_any_unit():
    scene = gaussians_of(view_of(Room(), camera_at(size=SIZE)))
    chosen = torch.arange(len(scene)) < len(scene) // 4
    renderer = load_renderer("cpu")
    expected, found = (
        mark_selected(scaled(scene, unit), chosen, [make_camera(unit)], renderer)[0]
        for unit in (1.0, 1e-3)
    )
    assert 0.2 < expected.float().mean() < 0.4
    assert (found == expected).float().mean() > 0.99


@pytest.mark.parametrize(
    ("color", "is_inverted", "sentence"),
    [
        (0.0, False, "marks nothing of its target; paint white what is wrong"),
        (1.0, True, "marks nothing of its target; paint black what is wrong"),
        (0.0, True, "marks all of its target; paint black what is wrong"),
    ],
)
def test_a_mask_without_a_mark_is_refused_in_the_colours_that_are_read(
    tmp_path, color, is_inverted, sentence
):
    path = tmp_path / "mask.png"
    write_image(path, torch.full((SIZE, SIZE), color))
    with pytest.raises(InputError, match=sentence):
        read_marks(path, make_camera(), MaskReading(is_inverted))
